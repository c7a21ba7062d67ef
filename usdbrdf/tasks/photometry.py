"""What is asked of a scan's pixels before it is written: do its frames show the same things at the
same points of the mesh, and how bright is each beside the others?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.native import own_faces
from usdbrdf.files.frames import Read, read_frame, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.capture import Scan
from usdbrdf.model.upright import as_captured, upright
from usdbrdf.options import AUTO, IngestOptions
from usdbrdf.tasks.agreement import agreement_of_frames
from usdbrdf.tasks.objects import segmented
from usdbrdf.tasks.optics import asked_of_its_optics
from usdbrdf.tasks.poses import with_refined_poses
from usdbrdf.tasks.registration import doubts_about_registration, doubts_about_steps
from usdbrdf.tasks.task import warned
from usdbrdf.tasks.turned import refuse_turned
from usdbrdf.texturing.agreement import (
    MeshPoints,
    doubts_about_agreement,
    logarithms_in_frame,
    surface_and_rays,
)
from usdbrdf.texturing.astray import frames_astray
from usdbrdf.texturing.exposures import doubts_about_exposures, with_estimated_exposures
from usdbrdf.transport.rays import RayScene


def asked_of_its_pixels(
    scan: Scan, images: Sequence[Path], options: IngestOptions
) -> tuple[Scan, dict[str, Any]]:
    """The scan, whose frames lie in ``images`` now, its exposures estimated if that is wanted, and
    what was found, for the record: under "warnings" what the user has been warned of."""
    scan = as_captured(scan)  # whose conventions the sentences name
    read = partial(read_frame, replace(scan.frames, image_paths=tuple(images)))
    surface, rays = surface_and_rays(scan.mesh)
    refuse_turned(surface, rays, scan.frames, scan.turned_images, read, scan.source)
    asked = agreement_of_frames(surface, rays, scan.frames, read, scan.source)
    agrees, astray = asked.agreement, frames_astray(asked.shown)
    disagree = warned(doubts_about_agreement(agrees, asked.shown, scan.source))
    metres = scan.meters_per_unit
    misplaced = warned(
        doubts_about_registration(scan.mesh, rays, asked, astray, scan.source, metres)
    )
    warnings = disagree + misplaced
    if not warnings and not options.refine_poses:
        warnings += warned(doubts_about_steps(scan.mesh, rays, asked, astray, scan.source))
    estimate = options.vignetting == "estimate"
    scan, told, doubts = asked_of_its_optics(
        scan,
        surface,
        rays,
        read,
        estimate=estimate,
        exposures_estimated=options.exposure == "estimate",
        in_place=not (disagree or misplaced),
    )
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
