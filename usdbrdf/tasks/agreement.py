"""Whether the frames of a scan show the same things at the same points of its mesh, under its poses
as they are given or under another reading of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.capture.conventions import CONVENTIONS, FLIPS, UNITS, with_reversed_pixels
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import Read, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.agreement import (
    Agreement,
    MeshPoints,
    agreement,
    is_doubtful,
    logarithms_in_frame,
    other_convention,
)
from usdbrdf.texturing.pose_samples import logarithms
from usdbrdf.texturing.registration.joint_change import FINEST
from usdbrdf.transport.rays import RayScene

ASKED = 16  # frames that are asked whether they agree
_AS_GIVEN = ""
_CONVERTED: dict[str, Callable[[Double], Double]] = {
    _AS_GIVEN: lambda pose: pose,
    **CONVENTIONS,
    **UNITS,
}
# Poses that a list has some frames later, of a capture whose frames and poses were paired anew.
_SHIFTED = {
    f"those of the frames {abs(by)} {'after' if by > 0 else 'before'} them in the list": by
    for by in (1, -1, 2, -2)
}
_READINGS = (*_CONVERTED, *_SHIFTED, *FLIPS)
# Of the points every so many are looked up under other readings at first.
_STRIDE = 4


class Asked(NamedTuple):
    """Of N frames that were asked: how far they agree, None where they see too few points in
    common; logarithms of what they show of the points, (P, N); their cameras; and ``logarithms`` of
    all that they show, small."""

    agreement: Agreement | None
    shown: Float
    cameras: list[Camera]
    pictures: list[Float]


def agreement_of_frames(
    surface: MeshPoints,
    rays: RayScene,
    frames: Frames,
    read: Read,
    source: Path,
    of_all: tuple[Double, Sequence[int]] | None = None,
) -> Asked:
    """What some frames, spread evenly, show. Of much the user is to be told by
    ``doubts_about_agreement``.

    of_all  poses of all frames of the capture, and the numbers of ``frames`` among them; None where
            these are all

    Raises InputRefused, in the name of ``source``, where they hardly do and would under another
    reading of the poses.
    """
    asked = spread_evenly(len(frames), ASKED)
    cameras = [frames.camera(i) for i in asked]
    pictures: dict[int, Float] = {}
    poses, numbers = of_all or (frames.world_from_camera, range(len(frames)))

    def read_as(name: str, i: int) -> Camera:
        own = (numbers[i] + _SHIFTED.get(name, 0)) % len(poses)
        pose = _CONVERTED.get(name, _CONVERTED[_AS_GIVEN])(poses[own])
        return with_reversed_pixels(replace(frames.camera(i), world_from_camera=pose), name)

    def looked_up(steps: Mapping[str, int]) -> dict[str, Float]:
        """What the frames show, under some readings, at every so many points."""
        some = {step: surface.every(step) for step in steps.values()}
        found: dict[str, list[Float]] = {name: [] for name in steps}
        images = read_frames(read, asked)
        for i, pixels in progress(images, total=len(asked), label="agreement", unit="frames"):
            if i not in pictures:  # which are halved further where the frames' sizes differ
                pictures[i] = logarithms(pixels, max(1, pixels.valid.shape[1] // (2 * FINEST)))
            for name, step in steps.items():
                found[name].append(logarithms_in_frame(some[step], rays, read_as(name, i), pixels))
        return {name: np.stack(columns, axis=1) for name, columns in found.items()}

    # Under wrong readings frames may agree as well, where most of a scene is one colour; but less.
    shown = looked_up(dict.fromkeys(_READINGS, _STRIDE) | {_AS_GIVEN: 1})
    rows = shown[_AS_GIVEN]
    given, shown[_AS_GIVEN] = agreement(rows), rows[::_STRIDE]
    found = {name: agreement(some) for name, some in shown.items()}
    told = found.pop(_AS_GIVEN)
    if told and not is_doubtful(given) and not other_convention(told, found):
        return Asked(given, rows, cameras, [*pictures.values()])
    every = {name: 1 for name in _READINGS if name != _AS_GIVEN}
    found = {name: agreement(some) for name, some in looked_up(every).items()}
    better = found.get(name := other_convention(given, found))
    if better is not None:
        differ = f"differ by {given.ratio:.0%} of what any two pixels do" if given else "share none"
        cure = "Pair frames and poses anew" if name in _SHIFTED else "Convert the poses"
        what, cure = ("frames", "Save the frames anew") if name in FLIPS else ("poses", cure)
        raise InputRefused(
            f"{source}: the frames do not show the same things at the same points of the mesh "
            f"({differ}); with the {what} read as {name} they would differ by {better.ratio:.0%}. "
            f"{cure}. [capture.convention]"
        )
    return Asked(given, rows, cameras, [*pictures.values()])
