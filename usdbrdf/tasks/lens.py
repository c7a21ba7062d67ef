"""Whether the lens of a scan's frames, as it is told, is the one that they were taken with."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.files.frames import Read, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.tasks.agreement import ASKED
from usdbrdf.texturing.lens_check import FINEST, doubts_about_lens, lens_of_frames
from usdbrdf.texturing.pose_samples import logarithms
from usdbrdf.transport.rays import RayScene


def asked_of_its_lens(
    mesh: ScanMesh, rays: RayScene, frames: Frames, read: Read, source: Path, astray: Bool
) -> list[str]:
    """A sentence for the user, or none; from the frames that ``agreement_of_frames`` asks, but
    those of them that are ``astray``, in its order."""
    asked = [i for i, off in zip(spread_evenly(len(frames), ASKED), astray, strict=True) if not off]
    images = read_frames(read, asked)
    shown = progress(images, total=len(asked), label="lens", unit="frames")
    # Pictures are halved further where the frames' sizes differ.
    pictures = [
        logarithms(pixels, max(1, pixels.valid.shape[1] // (2 * FINEST))) for _, pixels in shown
    ]
    found = lens_of_frames(mesh, rays, [frames.camera(i) for i in asked], pictures)
    return list(doubts_about_lens(found, source))
