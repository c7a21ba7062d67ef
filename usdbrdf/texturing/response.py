"""Do frames contradict each other about how bright things are, and what would explain it?

Each frame's gain beside the others is told by the same points of the mesh; how far that can be
trusted, by leaving parts of the mesh out in turn (the delete-group jackknife). Where exposures
vary, a wrong transfer curve makes gains that follow the exposures, as do exposures that were not
divided out, or twice: read rightly, the same frames agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.errors import first_of
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.agreement import spread_in_frames
from usdbrdf.texturing.exposures import CONTRADICTING, FEWEST, gains_of_frames

_TOLD = calibration.number("response.told") * math.log(2)
_STANDING_OUT = calibration.number("response.standing_out")
_BETTER = calibration.number("response.better")
# Parts of the mesh along each axis, how many groups of them are left out in turn, and how many of
# a part's points, and of such parts, tell of a frame.
_ALONG, _GROUPS, _OF_PART, _PARTS = (4, 4, 4), 8, 5, 5
# Frames of which a pattern is told.
_OF_PATTERN = 5
# Standard deviations of a normal distribution for each median distance from the middle.
_OF_MEDIAN = 1.4826
_LISTED = 6

CODED, DECODED, UNDIVIDED, DIVIDED_TWICE = "coded", "decoded", "undivided", "divided twice"


class Judged(NamedTuple):
    """Of N frames, each (N,): natural logarithm of the gain, and its standard error, infinite where
    too few parts of the mesh tell."""

    gain: Double
    error: Double

    def off(self, least: float) -> Bool:
        """(N,) which frames are off by ``least`` or more, beyond what chance does."""
        return np.asarray(np.abs(self.gain) > np.maximum(least, _STANDING_OUT * self.error))


def parts_of_mesh(point: Double) -> Int:
    """(P,) int32 in which of the boxes, which hold as many each, a point (P, 3) lies."""
    part = np.zeros(len(point), np.int32)
    for axis, count in enumerate(_ALONG):
        slab = np.zeros_like(part)
        for one in np.unique(part):
            own = np.flatnonzero(part == one)
            rank = point[own, axis].argsort(kind="stable").argsort()
            slab[own] = rank * count // len(own)
        part = part * count + slab
    return part


def judged_gains(logarithm: Float, part: Int, least: float = 0.0) -> Judged:
    """How much brighter each frame shows the same points than the others do.

    logarithm  (P, N) of what frames show of points, NaN where they do not
    part       (P,) as of ``parts_of_mesh``
    least      where no gain is larger, nobody asks how well they are known: errors are 0
    """
    found = gains_of_frames(logarithm)
    if (np.abs(found.logarithm) <= least).all():
        return Judged(found.logarithm, np.zeros(len(found.logarithm)))
    without = [gains_of_frames(some).logarithm for some in _without_parts(logarithm, part)]
    error = np.sqrt((_GROUPS - 1) * np.var(without, axis=0))
    for i, brighter in enumerate(found.brighter.T):
        shown = np.flatnonzero(np.isfinite(brighter))
        own, off = part[shown], brighter[shown]
        parts = [off[own == k] for k in np.unique(own)]
        told = np.array([np.median(some) for some in parts if len(some) >= _OF_PART])
        if len(told) < _PARTS or len(shown) < FEWEST:
            error[i] = np.inf
            continue
        middle = _OF_MEDIAN * np.median(np.abs(told - np.median(told)))
        error[i] = max(error[i], middle / math.sqrt(len(told)))
    return Judged(found.logarithm, error)


def _without_parts(logarithm: Float, part: Int) -> Iterator[Float]:
    """The same, of the points outside of a group of parts, for each group."""
    for group in range(_GROUPS):
        yield logarithm[part % _GROUPS != group]


def better_reading(logarithm: Float, part: Int, frames: Frames, off: Bool, least: float) -> str:
    """The reading of the pixels under which frames contradict each other far less than as they are
    given, and most of those that are ``off`` (N,), by ``least`` or more, are no longer; "" where
    there is none, as ever where all exposures are equal.

    logarithm  (P, N) of the radiance as it is read now, divided by the exposure times of ``frames``
    part       (P,) as of ``parts_of_mesh``
    """
    full, time = frames.saturation_radiance, frames.exposure_time
    if len(time) < _OF_PATTERN or np.ptp(time) == 0:
        return ""
    top = np.log(full)
    if not np.isfinite(top).all():  # the brightest that any frame shows is about full
        top = np.nanmax(logarithm + np.log(time)) - np.log(time)
    readings: dict[str, Callable[[Double], Double]] = {
        CODED: lambda x: _log_decoded(x - top) + top,
        DECODED: lambda x: _log_encoded(x - top) + top,
    }
    if frames.radiometric:  # photographs are divided here
        readings[UNDIVIDED] = lambda x: np.asarray(x - np.log(time))
        readings[DIVIDED_TWICE] = lambda x: np.asarray(x + np.log(time))
    # Every other point tells as well, in half of the time.
    some = [*_without_parts(logarithm[::2], part[::2])]
    given = np.array([_contradiction(own) for own in some])
    sound: dict[str, float] = {}
    for name, read in readings.items():
        read_so = [read(own.astype(np.float64)).astype(np.float32) for own in some]
        other = np.array([_contradiction(one) for one in read_so])
        if (other < _BETTER * given).all():
            sound[name] = float(other.mean())
    if not sound:
        return ""
    best = min(sound, key=lambda name: sound[name])
    left = judged_gains(readings[best](logarithm.astype(np.float64)).astype(np.float32), part)
    return best if 2 * int(left.off(least).sum()) < int(off.sum()) else ""


def _contradiction(logarithm: Float) -> float:
    """Mean gain of frames, as a share of how much what each shows differs: curves stretch both."""
    found = gains_of_frames(logarithm)
    compared = found.samples >= FEWEST
    if not compared.any():
        return 0.0
    variety = max(spread_in_frames(logarithm[:, compared]), 1e-6)
    return float(np.abs(found.logarithm[compared]).mean()) / variety


def _log_decoded(code: Double) -> Double:
    """Logarithm of the linear value of sRGB's code (both 1 at the top), of the code's logarithm."""
    value = np.exp(code)
    curve = ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.asarray(np.log(np.where(value <= 0.04045, value / 12.92, curve)))


def _log_encoded(linear: Double) -> Double:
    """The inverse of ``_log_decoded``."""
    value = np.exp(linear)
    curve = 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055
    return np.asarray(np.log(np.where(value <= 0.0031308, 12.92 * value, curve)))


class Contradiction(NamedTuple):
    """Frames that contradict the others: factor of each by the number of the frame, worst first; by
    how many stops frames become brighter from the first to the last, 0 where that does not explain
    them; and the ``better_reading`` of their pixels."""

    factor: dict[int, float]
    drift: float
    reading: str


def is_curve(found: Contradiction | None) -> bool:
    """Whether frames contradict each other for their transfer curve is another one."""
    return found is not None and found.reading in (CODED, DECODED)


def contradiction_of_frames(
    logarithm: Float, point: Double, frames: Frames
) -> Contradiction | None:
    """What is to be told of N frames' exposures and transfer curve; None where they agree.

    logarithm  (P, N) of what ``frames`` show of ``point`` (P, 3), NaN where they do not
    """
    least = _TOLD if frames.radiometric else CONTRADICTING
    part = parts_of_mesh(point)
    judged = judged_gains(logarithm, part, least)
    off = judged.off(least)
    if not off.any():
        return None
    reading = better_reading(logarithm, part, frames, off, least)
    worst = sorted(np.flatnonzero(off).tolist(), key=lambda i: -abs(judged.gain[i]))
    drift = _drift(judged)
    over = judged._replace(gain=judged.gain - drift * _places(len(off)))
    explained = 2 * int(over.off(least).sum()) < int(off.sum())
    factor = {i: round(math.exp(judged.gain[i]), 2) for i in worst}
    return Contradiction(factor, drift / math.log(2) if explained else 0.0, reading)


def _places(count: int) -> Double:
    """(N,) of frames along their list, from -0.5 to 0.5."""
    return np.linspace(-0.5, 0.5, count)


def _drift(judged: Judged) -> float:
    """By how much frames become brighter along their list, in all; 0 of few."""
    from scipy import stats  # takes a fifth of the time in which programs start that need none

    known = np.isfinite(judged.error)
    if np.count_nonzero(known) < _OF_PATTERN:
        return 0.0
    place = _places(len(judged.gain))
    return float(stats.theilslopes(judged.gain[known], place[known]).slope)


def doubts_about_response(
    found: Contradiction | None, frames: Frames, source: Path, *, estimated: bool = False
) -> Iterator[str]:
    """A sentence on frames that contradict each other about how bright the same points are.

    estimated  whether exposures are to be estimated, which leaves nothing but a curve to be told
    """
    if found is None or (estimated and not is_curve(found)):
        return
    names = [frames.image_paths[i].name for i in found.factor]
    named = [f"{name} ({x:.2f} x)" for name, x in zip(names, found.factor.values(), strict=True)]
    what = (
        f"{source.name}: {len(named)} of {len(frames)} frames that were compared show the same "
        f"points of the mesh brighter or darker than the others do, {first_of(named, _LISTED)}"
    )
    if found.reading:
        rule = "curve" if is_curve(found) else "exposure"
        yield f"{what}. {_said_of_reading(found.reading, frames.radiometric)} [capture.{rule}]"
    elif found.drift:
        yield (
            f"{what}: they drift by {found.drift:+.2f} stops from the first frame to the last. "
            "Take them with one exposure, and in light that does not change, or run ingest with "
            "--exposure estimate, which divides out what each is off by. [capture.exposure]"
        )
    else:
        curve = "" if frames.radiometric else ", or the camera applied a tone curve"
        yield (
            f"{what}. Their exposures are not what they pass for{curve}: correct them, leave these "
            "frames out, or run ingest with --exposure estimate, which divides out what each is "
            "off by. [capture.exposure]"
        )


def _said_of_reading(reading: str, radiometric: bool) -> str:
    """What the pixels are, and what to do."""
    if reading == UNDIVIDED:
        return (
            "They agree once the exposure times that are stated are divided out of the pixels: do "
            "that, or run ingest with --exposure estimate."
        )
    if reading == DIVIDED_TWICE:
        return (
            "They agree if the exposure times that are stated are not divided out of the pixels: "
            "state those of these images, or none, or run ingest with --exposure estimate."
        )
    if reading == CODED and radiometric:
        said = "they hold sRGB's codes, though they pass for linear: export them scene-linear, or "
        said += "leave out an --input-space that says they are linear"
    elif reading == CODED:
        said = "they were encoded as sRGB twice: export them once"
    elif radiometric:
        said = "they were decoded from sRGB though they were linear: export them as they were"
    else:
        said = "they hold linear values, though they pass for sRGB's codes: export them as EXR, or "
        said += "as PNG or TIFF of 16 bits with --input-space lin_rec709_scene"
    return f"They agree under another transfer curve: {said}. --exposure estimate does not cure it."
