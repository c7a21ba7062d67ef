"""Frames that stand elsewhere than they say, that contradict each other about how bright things
are, vignetting and drift of the white balance: told, and vignetting divided out on demand."""

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
from usdbrdf.texturing.response import contradiction_of_frames, doubts_about_response, is_curve
from usdbrdf.transport.rays import RayScene

# Frames that are asked, at least and at most, and pixels of all, if they are more than the least,
# which take seconds to read; and how many frames are named.
_FEWEST_ASKED, _MOST_ASKED, _MOST_PIXELS, _LISTED = 32, 128, 1 << 25, 6


def asked_of_its_optics(
    scan: Scan,
    surface: MeshPoints,
    rays: RayScene,
    read: Read,
    *,
    estimate: bool,
    exposures_estimated: bool = False,
    in_place: bool = True,
) -> tuple[Scan, dict[str, Any], list[str]]:
    """The scan, its frames' vignetting to be divided out if ``estimate``; what was found: stops
    that corners are darker by, and that the balance of red or blue to green is off by in the worst
    frame; and a sentence for the user on each of them that is much, on frames astray, and on those
    that are brighter or darker than others, which is left to ``exposures_estimated`` where that
    cures it. Where frames are known not to be ``in_place``, brightness and balance seem to differ
    by that alone, and balance where they have another transfer curve: nothing is said of it."""
    frames = scan.frames
    most = _MOST_PIXELS // max(1, int(frames.resolution.prod(axis=1, dtype=np.int64).max()))
    asked = spread_evenly(len(frames), min(max(most, _FEWEST_ASKED), _MOST_ASKED))
    images = read_frames(read, asked)
    read_so = progress(images, total=len(asked), label="optics", unit="frames")
    columns = [samples_in_frame(surface, rays, frames.camera(i), pixels) for i, pixels in read_so]
    logarithm, radius2 = (np.stack(each, axis=1) for each in zip(*columns, strict=True))
    astray = frames_astray(logarithm.mean(axis=2))
    names = [frames.image_paths[i].name for i in asked]
    logarithm[:, astray] = np.nan  # of whose lens and colours nothing is known
    compared = frames.at(asked)
    # By green: where red or blue alone is off, the balance is.
    green = logarithm[..., 1]
    unlike = contradiction_of_frames(green, surface.point, compared) if in_place else None
    # Under another curve frames that share little seem to show other things.
    doubts = [] if is_curve(unlike) else [*doubts_about_places(astray, names, scan.source)]
    doubts += doubts_about_response(unlike, compared, scan.source, estimated=exposures_estimated)
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
    if drift is not None and drifts(drift).any() and in_place and not is_curve(unlike):
        off = [names[k] for k in np.flatnonzero(drifts(drift))]
        doubts.append(
            f"{scan.source.name}: the white balance of {len(off)} of {len(asked)} frames is off "
            f"that of the others, by {drift.max():.2f} stops at most: {first_of(off, _LISTED)}. "
            "Develop all frames with one balance. [capture.balance]"
        )
    return scan, told, doubts
