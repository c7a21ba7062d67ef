"""What a capture holds, lacks, and would be refused for; nothing is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.capture.develop import developed_in
from usdbrdf.capture.inspection import Inspection
from usdbrdf.capture.inspection import inspect as inspect_capture
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.model.capture import Frames
from usdbrdf.options import AUTO, InspectOptions
from usdbrdf.tasks.agreement import ASKED, agreement_of_frames
from usdbrdf.tasks.capture_inputs import no_asset
from usdbrdf.tasks.objects import frames_that_tell_colours, segmented
from usdbrdf.tasks.registration import doubts_about_registration, doubts_about_steps
from usdbrdf.tasks.turned import frames_to_compare, refuse_turned
from usdbrdf.texturing.agreement import doubts_about_agreement, surface_and_rays
from usdbrdf.texturing.astray import doubts_about_places, frames_astray
from usdbrdf.texturing.response import contradiction_of_frames, doubts_about_response, is_curve


def inspect(
    capture: Path, options: InspectOptions, adapter: str | None = None, *, plugins: bool = True
) -> Inspection:
    """``capture.inspection``, and whether poses, mesh and frames agree."""
    try:
        no_asset(capture)
    except InputRefused as refusal:
        return Inspection(source=capture, refusals=(refusal,))
    found = inspect_capture(capture, options, adapter, plugins=plugins)
    mesh, every = found.mesh, found.frames
    if mesh is None or every is None or not found.could_be_read:
        return found

    def developed_frames(numbers: Sequence[int], folder: Path) -> Frames:
        views = [found.views[i] for i in numbers] if found.views else []
        return developed_in(every.at(numbers), views, folder)

    try:
        with scratch_folder() as folder:
            surface, rays = surface_and_rays(mesh)
            if found.turned_images:
                numbers = frames_to_compare(every, found.turned_images)
                frames = developed_frames(numbers, folder)
                read = partial(read_frame, frames)
                refuse_turned(surface, rays, frames, found.turned_images, read, capture)
            numbers = spread_evenly(len(every), ASKED)
            frames = developed_frames(numbers, folder)
            read = partial(read_frame, frames)
            of_all = every.world_from_camera, numbers
            asked = agreement_of_frames(surface, rays, frames, read, capture, of_all)
            names = [path.name for path in frames.image_paths]
            doubts = [*doubts_about_agreement(asked.agreement, asked.shown, capture)]
            astray = frames_astray(asked.shown)
            metres = found.meters_per_unit or 1.0
            doubts += doubts_about_registration(mesh, rays, asked, astray, capture, metres)
            misplaced = bool(doubts)
            if not misplaced:
                doubts += doubts_about_steps(mesh, rays, asked, astray, capture)
            shown = np.where(astray, np.nan, asked.shown)
            # Of frames that do not stand where they say it seems so by that alone.
            unlike = None if misplaced else contradiction_of_frames(shown, surface.point, frames)
            if not is_curve(unlike):
                doubts += doubts_about_places(astray, names, capture)
            doubts += doubts_about_response(unlike, frames, capture)
            objects = found.objects
            if options.objects == AUTO:
                frames = developed_frames(frames_that_tell_colours(mesh, len(every)), folder)
                read = partial(read_frame, frames)
                mesh, objects, _ = segmented(mesh, found.own_faces, frames, read)
    except InputRefused as refusal:
        return replace(found, refusals=(*found.refusals, refusal))
    warnings, agrees = (*found.warnings, *doubts), asked.agreement
    return replace(
        found, mesh=mesh, objects=objects, warnings=warnings, agreement=agrees and agrees.ratio
    )
