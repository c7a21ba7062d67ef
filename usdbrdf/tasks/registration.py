"""Whether the lens of a scan's frames, as it is told, is the one that they were taken with, and
whether their poses as a whole belong to its mesh."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from usdbrdf.model.arrays import Bool
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.tasks.agreement import Asked
from usdbrdf.texturing.registration.lens import lens_of_frames, said_of_lens
from usdbrdf.texturing.registration.similarity import said_of_similarity, similarity_of_frames
from usdbrdf.transport.rays import RayScene


def doubts_about_registration(
    mesh: ScanMesh, rays: RayScene, asked: Asked, astray: Bool, source: Path, metres: float
) -> Iterator[str]:
    """A sentence for the user, or none, on what explains the frames that were asked best, but those
    of them that are ``astray``, in their order.

    metres  of a unit of the mesh
    """
    some = [i for i, off in enumerate(astray) if not off]
    cameras = [asked.cameras[i] for i in some]
    pictures = [asked.pictures[i] for i in some]
    lens = lens_of_frames(mesh, rays, cameras, pictures)
    poses = similarity_of_frames(mesh, rays, cameras, pictures)
    if poses and poses.is_clear and (lens is None or poses.found.left < lens.left):
        yield said_of_similarity(poses, source, 1000 * metres)
    elif lens and lens.is_clear:
        yield said_of_lens(lens, source)
