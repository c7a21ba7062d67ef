"""What a capture holds, lacks, and would be refused for; nothing is written."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from usdbrdf.capture.inspection import Inspection
from usdbrdf.capture.inspection import inspect as inspect_capture
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.options import AUTO, InspectOptions
from usdbrdf.tasks.objects import segmented
from usdbrdf.tasks.photometry import agreement_of_frames


def inspect(
    capture: Path, options: InspectOptions, adapter: str | None = None, *, plugins: bool = True
) -> Inspection:
    """``capture.inspection``, and whether poses, mesh and frames agree."""
    found = inspect_capture(capture, options, adapter, plugins=plugins)
    if found.mesh is None or found.frames is None or not found.could_be_read:
        return found
    if any(found.frames.photographs):  # not resampled out of these yet
        return found
    try:
        read = partial(read_frame, found.frames)
        agrees = agreement_of_frames(found.mesh, found.frames, read, capture)
        if options.objects == AUTO:
            mesh, objects, _ = segmented(found.mesh, None, found.frames, read)
            found = replace(found, mesh=mesh, objects=objects)
    except InputRefused as refusal:
        return replace(found, refusals=(*found.refusals, refusal))
    return replace(found, agreement=agrees and agrees.ratio)
