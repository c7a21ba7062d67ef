"""What a capture holds, lacks, and would be refused for; nothing is written."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.capture.develop import developed_in
from usdbrdf.capture.inspection import Inspection
from usdbrdf.capture.inspection import inspect as inspect_capture
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.options import AUTO, InspectOptions
from usdbrdf.tasks.objects import frames_that_tell_colours, segmented
from usdbrdf.tasks.photometry import ASKED, agreement_of_frames, doubts_about_agreement


def inspect(
    capture: Path, options: InspectOptions, adapter: str | None = None, *, plugins: bool = True
) -> Inspection:
    """``capture.inspection``, and whether poses, mesh and frames agree."""
    found = inspect_capture(capture, options, adapter, plugins=plugins)
    if found.mesh is None or found.frames is None or not found.could_be_read:
        return found
    try:
        with TemporaryDirectory(prefix="usdbrdf-") as folder:
            asked = spread_evenly(len(found.frames), ASKED)
            views = [found.views[i] for i in asked] if found.views else []
            frames = developed_in(found.frames.at(asked), views, Path(folder))
            read = partial(read_frame, frames)
            agrees = agreement_of_frames(found.mesh, frames, read, capture)
            doubts = tuple(doubts_about_agreement(agrees, capture))
            found = replace(found, warnings=(*found.warnings, *doubts))
            if options.objects == AUTO:
                asked = frames_that_tell_colours(found.mesh, len(found.frames))
                views = [found.views[i] for i in asked] if found.views else []
                frames = developed_in(found.frames.at(asked), views, Path(folder))
                read = partial(read_frame, frames)
                mesh, objects, _ = segmented(found.mesh, found.own_faces, frames, read)
                found = replace(found, mesh=mesh, objects=objects)
    except InputRefused as refusal:
        return replace(found, refusals=(*found.refusals, refusal))
    return replace(found, agreement=agrees and agrees.ratio)
