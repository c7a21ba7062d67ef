"""What is asked of a scan's pixels before it is written: do its frames show the same things at the
same points of the mesh, and how bright is each beside the others?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.capture.conventions import CONVENTIONS, UNITS
from usdbrdf.capture.native import own_faces
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import Read, read_frame, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.upright import as_captured, upright
from usdbrdf.options import AUTO, IngestOptions
from usdbrdf.tasks.objects import segmented
from usdbrdf.tasks.optics import asked_of_its_optics
from usdbrdf.tasks.poses import with_refined_poses
from usdbrdf.tasks.task import warned
from usdbrdf.tasks.turned import refuse_turned
from usdbrdf.texturing.agreement import (
    Agreement,
    MeshPoints,
    agreement,
    doubts_about_agreement,
    is_doubtful,
    logarithms_in_frame,
    other_convention,
    surface_and_rays,
)
from usdbrdf.texturing.exposures import doubts_about_exposures, with_estimated_exposures
from usdbrdf.transport.rays import RayScene

ASKED = 16  # frames that are asked whether they agree
_AS_GIVEN = ""
_READINGS: dict[str, Callable[[Double], Double]] = {
    _AS_GIVEN: lambda pose: pose,
    **CONVENTIONS,
    **UNITS,
}
# Of the points every so many are looked up under other readings at first.
_STEP = 4


def asked_of_its_pixels(
    scan: Scan, images: Sequence[Path], options: IngestOptions
) -> tuple[Scan, dict[str, Any]]:
    """The scan, whose frames lie in ``images`` now, its exposures estimated if that is wanted, and
    what was found, for the record: under "warnings" what the user has been warned of."""
    scan = as_captured(scan)  # whose conventions the sentences name
    read = partial(read_frame, replace(scan.frames, image_paths=tuple(images)))
    surface, rays = surface_and_rays(scan.mesh)
    refuse_turned(surface, rays, scan.frames, scan.turned_images, read, scan.source)
    agrees = agreement_of_frames(surface, rays, scan.frames, read, scan.source)
    warnings = warned(doubts_about_agreement(agrees, scan.source))
    estimate = options.vignetting == "estimate"
    scan, told, doubts = asked_of_its_optics(scan, surface, rays, read, estimate=estimate)
    warnings += warned(doubts)
    told |= {"agreement": agrees and agrees.ratio, "warnings": warnings}
    read = partial(read_frame, replace(scan.frames, image_paths=tuple(images)))
    if options.refine_poses:
        scan, told["refined_poses"] = with_refined_poses(scan, read)
    if options.exposure == "estimate":
        scan, off = estimated_exposures(scan, surface, rays, read)
        told["estimated_exposures"] = off
        warnings += warned(doubts_about_exposures(off, len(scan.frames), scan.source))
        read = partial(read_frame, replace(scan.frames, image_paths=tuple(images)))
    if options.objects == AUTO:
        mesh, objects, found = segmented(scan.mesh, own_faces(scan), scan.frames, read)
        scan, told["segmentation"] = replace(scan, mesh=mesh, objects=objects), found
    return upright(scan), told


def agreement_of_frames(
    surface: MeshPoints, rays: RayScene, frames: Frames, read: Read, source: Path
) -> Agreement | None:
    """How far some frames agree; None where they see too few points in common. Of much the user
    is to be told by ``doubts_about_agreement``.

    Raises InputRefused, in the name of ``source``, where they hardly do and would under another
    reading of the poses.
    """
    asked = spread_evenly(len(frames), ASKED)

    def looked_up(steps: Mapping[str, int]) -> dict[str, Float]:
        """What the frames show, under some readings, at every so many points."""
        some = {step: surface.every(step) for step in steps.values()}
        found: dict[str, list[Float]] = {name: [] for name in steps}
        images = read_frames(read, asked)
        for i, pixels in progress(images, total=len(asked), label="agreement", unit="frames"):
            camera = frames.camera(i)
            for name, step in steps.items():
                pose = _READINGS[name](camera.world_from_camera)
                other = replace(camera, world_from_camera=pose)
                found[name].append(logarithms_in_frame(some[step], rays, other, pixels))
        return {name: np.stack(columns, axis=1) for name, columns in found.items()}

    # Under wrong readings frames may agree as well, where most of a scene is one colour; but less.
    shown = looked_up(dict.fromkeys(_READINGS, _STEP) | {_AS_GIVEN: 1})
    given = agreement(shown[_AS_GIVEN])
    shown[_AS_GIVEN] = shown[_AS_GIVEN][::_STEP]
    found = {name: agreement(rows) for name, rows in shown.items()}
    told = found.pop(_AS_GIVEN)
    if told and not is_doubtful(given) and not other_convention(told, found):
        return given
    every = {name: 1 for name in _READINGS if name != _AS_GIVEN}
    found = {name: agreement(rows) for name, rows in looked_up(every).items()}
    better = found.get(name := other_convention(given, found))
    if better is not None:
        differ = f"differ by {given.ratio:.0%} of what any two pixels do" if given else "share none"
        raise InputRefused(
            f"{source}: the frames do not show the same things at the same points of the mesh "
            f"({differ}); with the poses read as {name} they would differ by {better.ratio:.0%}. "
            "Convert the poses. [capture.convention]"
        )
    return given


def estimated_exposures(
    scan: Scan, surface: MeshPoints, rays: RayScene, read: Read
) -> tuple[Scan, dict[str, float]]:
    """The scan with its frames exposed as their pixels say; image and gain of those that
    contradicted the others by much."""
    frames = scan.frames
    images = read_frames(read, range(len(frames)))
    seen = progress(images, total=len(frames), label="exposures", unit="frames")
    columns = [logarithms_in_frame(surface, rays, frames.camera(i), p) for i, p in seen]
    frames, off = with_estimated_exposures(frames, np.stack(columns, axis=1))
    return replace(scan, frames=frames), off
