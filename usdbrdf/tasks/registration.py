"""Whether the lens of a scan's frames, as it is told, is the one that they were taken with, and
whether their poses belong to its mesh, as a whole and each by itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.tasks.agreement import Asked
from usdbrdf.texturing.registration.lens import lens_of_frames, said_of_lens
from usdbrdf.texturing.registration.own_steps import own_steps_of_frames, said_of_own_steps
from usdbrdf.texturing.registration.similarity import said_of_similarity, similarity_of_frames
from usdbrdf.transport.rays import RayScene


def doubts_about_registration(
    mesh: ScanMesh, rays: RayScene, asked: Asked, astray: Bool, source: Path, metres: float
) -> Iterator[str]:
    """A sentence for the user, or none, on what explains the frames that were asked best, but those
    of them that are ``astray``, in their order.

    metres  of a unit of the mesh
    """
    cameras, pictures = _of_others(asked, astray)
    lens = lens_of_frames(mesh, rays, cameras, pictures)
    poses = similarity_of_frames(mesh, rays, cameras, pictures)
    if poses and poses.is_clear and (lens is None or poses.found.left < lens.left):
        # Of poses that tremble some similarity fits best by chance: it explains less than half of
        # what a step of each does.
        moved = [poses.found.change.camera(camera) for camera in cameras]
        steps = own_steps_of_frames(mesh, rays, moved, pictures)
        if steps and steps.is_clear and 2 * (1 - poses.found.left) < 1 - steps.left:
            return
        yield said_of_similarity(poses, source, 1000 * metres)
    elif lens and lens.is_clear:
        yield said_of_lens(lens, source)


def doubts_about_steps(
    mesh: ScanMesh, rays: RayScene, asked: Asked, astray: Bool, source: Path
) -> Iterator[str]:
    """The same on poses each of which is off by itself; to be asked where nothing that all frames
    share is off, for then each seems to be."""
    cameras, pictures = _of_others(asked, astray)
    found = own_steps_of_frames(mesh, rays, cameras, pictures)
    if found and found.is_clear:
        widths = {camera.width for camera in cameras}
        yield said_of_own_steps(found, source, widths.pop() if len(widths) == 1 else None)


def _of_others(asked: Asked, astray: Bool) -> tuple[list[Camera], list[Float]]:
    """Cameras and pictures of the frames that were asked, but those that are ``astray``."""
    some = [i for i, off in enumerate(astray) if not off]
    return [asked.cameras[i] for i in some], [asked.pictures[i] for i in some]
