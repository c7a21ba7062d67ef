"""Frames that stand elsewhere than they say, vignetting and drift of the white balance: told, and
vignetting divided out on demand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import first_of
from usdbrdf.files.frames import Read, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.capture import Scan
from usdbrdf.texturing.agreement import MeshPoints
from usdbrdf.texturing.astray import doubts_about_places, frames_astray
from usdbrdf.texturing.optics import (
    Samples,
    balance_drift,
    drifts,
    falloff_of_frames,
    samples_in_frame,
)
from usdbrdf.transport.rays import RayScene

# Frames that are asked, and how many are named.
_ASKED, _LISTED = 32, 6


def asked_of_its_optics(
    scan: Scan,
    surface: MeshPoints,
    rays: RayScene,
    read: Read,
    *,
    estimate: bool,
    in_place: bool = True,
) -> tuple[Scan, dict[str, Any], list[str]]:
    """The scan, its frames' vignetting to be divided out if ``estimate``; what was found: stops
    that corners are darker by, and that the balance of red or blue to green is off by in the worst
    frame; and a sentence for the user on each of them that is much, and on frames astray. Where
    frames are known not to be ``in_place``, their balance seems to drift by that alone, and nothing
    is said of it."""
    frames = scan.frames
    asked = spread_evenly(len(frames), _ASKED)
    images = read_frames(read, asked)
    shown = progress(images, total=len(asked), label="optics", unit="frames")
    columns = [samples_in_frame(surface, rays, frames.camera(i), pixels) for i, pixels in shown]
    logarithm, radius2 = (np.stack(each, axis=1) for each in zip(*columns, strict=True))
    astray = frames_astray(logarithm.mean(axis=2))
    names = [frames.image_paths[i].name for i in asked]
    doubts = list(doubts_about_places(astray, names, scan.source))
    logarithm[:, astray] = np.nan  # of whose lens and colours nothing is known
    samples = Samples(logarithm, radius2)
    falloff, drift = falloff_of_frames(samples), balance_drift(samples, surface.owner)
    told: dict[str, Any] = {"vignetting_stops": falloff and round(falloff.stops, 3)}
    told["white_balance_drift_stops"] = None if drift is None else round(float(drift.max()), 3)
    if falloff is not None and falloff.is_clear:
        done = "that was divided out" if estimate else "--vignetting estimate divides it out"
        doubts.append(
            f"{scan.source.name}: all frames are {falloff.stops:.2f} stops darker in their corners "
            f"than in the middle (error {falloff.error:.2f}); {done}. [capture.vignetting]"
        )
        if estimate:
            scan = replace(scan, frames=replace(frames, vignetting=falloff.coefficients))
    if drift is not None and drifts(drift).any() and in_place:
        off = [names[k] for k in np.flatnonzero(drifts(drift))]
        doubts.append(
            f"{scan.source.name}: the white balance of {len(off)} of {len(asked)} frames is off "
            f"that of the others, by {drift.max():.2f} stops at most: {first_of(off, _LISTED)}. "
            "Develop all frames with one balance. [capture.balance]"
        )
    return scan, told, doubts
