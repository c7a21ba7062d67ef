"""Photographs that EXIF data turn: do their poses belong to the pixels as they are stored?

What makes poses differs in this, and by its version: COLMAP takes pixels as stored, as they are
used here, other programs turn them first, and few drop the tag that turned them. So pixels decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import FramePixels, Read, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Array
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.agreement import MeshPoints, agreement, logarithms_in_frame, other_convention
from usdbrdf.transport.rays import RayScene

# So many of the images that EXIF data turn are compared, with so many others.
ASKED = 16
# What is to be done with pixels as stored to have them upright, by EXIF's number.
_SAVED_UPRIGHT: dict[int, Callable[[Array], Array]] = {
    2: lambda stored: stored[:, ::-1],
    3: lambda stored: stored[::-1, ::-1],
    4: lambda stored: stored[::-1],
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: stored[::-1, ::-1].swapaxes(0, 1),
    8: lambda stored: np.rot90(stored),
}


def frames_to_compare(frames: Frames, turned: Mapping[Path, int]) -> list[int]:
    """The numbers of some frames whose photographs are ``turned``, and of some others."""
    of_turned = [i for i in range(len(frames)) if _photograph(frames, i) in turned]
    others = sorted({*range(len(frames))} - {*of_turned})
    some = [rows[k] for rows in (of_turned, others) for k in spread_evenly(len(rows), ASKED)]
    return sorted(some)


def refuse_turned(
    surface: MeshPoints,
    rays: RayScene,
    frames: Frames,
    turned: Mapping[Path, int],
    read: Read,
    source: Path,
) -> None:
    """InputRefused, in the name of ``source``, unless frames whose photographs EXIF data turn agree
    with the others about the mesh as they are stored, and clearly less so upright.

    turned  those photographs of which nothing but pixels tells, and how, as ``Scan`` has them
    """
    asked = frames_to_compare(frames, turned)
    how = [turned.get(_photograph(frames, i), 1) for i in asked]
    if set(how) <= {1}:
        return
    stored, upright = [], []
    images = progress(read_frames(read, asked), total=len(asked), label="turned", unit="frames")
    for (i, pixels), orientation in zip(images, how, strict=True):
        camera = frames.camera(i)
        stored.append(logarithms_in_frame(surface, rays, camera, pixels))
        upright.append(
            logarithms_in_frame(surface, rays, *_upright(camera, pixels, orientation))
            if orientation > 1
            else stored[-1]
        )
    judged = np.array(how) > 1
    as_stored = agreement(np.stack(stored, axis=1), judged)
    as_upright = agreement(np.stack(upright, axis=1), judged)
    if other_convention(as_upright, {"stored": as_stored}):
        return
    first = next(_photograph(frames, i) for i, o in zip(asked, how, strict=True) if o > 1)
    said = (
        f"{source}: EXIF data turn {len(turned)} images, first {first.name!r} (orientation "
        f"{turned[first]}), and "
    )
    if as_upright is not None and other_convention(as_stored, {"upright": as_upright}):
        differ = f"differ by {as_stored.ratio:.0%}" if as_stored else "cannot be compared"
        raise InputRefused(
            f"{said}the poses are those of upright ones: with these, what frames show at the same "
            f"points of the mesh differs by {as_upright.ratio:.0%} of what any two pixels do, and "
            f"as stored they {differ}. Save the images upright (mogrify -auto-orient), and state "
            "their size as it is then. [capture.orientation]"
        )
    raise InputRefused(
        f"{said}neither sizes nor pixels tell whether the poses are those of upright images. Save "
        "them upright if they are (mogrify -auto-orient), else remove the tag (exiftool "
        "-Orientation=). [capture.orientation]"
    )


def _photograph(frames: Frames, i: int) -> Path:
    given = frames.photographs[i] if frames.photographs else None
    return given or frames.image_paths[i]


def _upright(camera: Camera, pixels: FramePixels, orientation: int) -> tuple[Camera, FramePixels]:
    """As if the image had been saved upright and the camera were that of such an image."""
    turn = _SAVED_UPRIGHT[orientation]
    shown = FramePixels(
        radiance=turn(pixels.radiance),
        valid=turn(pixels.valid),
        clipped=turn(pixels.clipped),
        dark=turn(pixels.dark),
        unknown=turn(pixels.unknown),
        transparent=turn(pixels.transparent),
        num_clamped=pixels.num_clamped,
    )
    height, width = shown.valid.shape
    return replace(camera, width=width, height=height), shown
