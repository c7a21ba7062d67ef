"""Which frames do not show what the others do where their poses say, while these agree about it?

A frame with the pose of another shows, at every point of the mesh, what has nothing to do with what
the others show there. Its white balance or its exposure then seem off; its pose is. What was moved,
or lamps that were switched, between frames can look so too: pixels alone do not tell which it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from usdbrdf import calibration
from usdbrdf.errors import first_of
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.texturing.exposures import gains_of_frames

_LEAST = calibration.number("astray.least")
_UNRELATED = calibration.number("astray.unrelated")
_STANDING_OUT = calibration.number("astray.standing_out")
# Points that a frame shares with two others, without which it is not judged.
_FEWEST = 50
_LISTED, _SEED = 6, 0


def frames_astray(logarithm: Float) -> Bool:
    """(N,) frames whose samples have next to nothing to do with what others show of the same
    points, and differ from these far more than these do from each other: a mirror looks different
    in all of them, and a white wall hardly in any. Where the others show much the same at all
    points there is nothing to be unrelated to: there a highlight or noise makes frames differ.
    Where about half of the frames are astray, none is found.

    logarithm  (P, N) of what frames show of points, NaN where they do not
    """
    known = np.isfinite(logarithm)
    known &= (known.sum(axis=1) > 2)[:, None]
    rows = known.any(axis=1)
    astray = np.zeros(logarithm.shape[1], np.bool_)
    if not rows.any():
        return astray
    known = known[rows]
    value = np.where(known, logarithm[rows], np.nan).astype(np.float64)
    # What frames are brighter or darker by would pass for a difference between points.
    value = value - gains_of_frames(logarithm[rows]).logarithm
    usual = np.nanmedian(value, axis=1)
    # Of n samples the median is near each of them by itself, by about (n - 1) / n.
    number = known.sum(axis=1)
    off = (value - usual[:, None]) * np.sqrt(number / (number - 1))[:, None]
    among_others = np.nanmedian(np.abs(off), axis=1)
    rng = np.random.default_rng(_SEED)
    for i in range(len(astray)):
        own = np.flatnonzero(known[:, i])
        if len(own) >= _FEWEST:
            far = _scatter(off[own, i])
            by_chance = _scatter(value[rng.permutation(own), i] - usual[own])
            others = float(among_others[own].mean())
            # What has nothing to do with it differs by about as much as there is to differ by.
            varied = far < 2 * _scatter(usual[own])
            astray[i] = varied and far > max(_LEAST, _UNRELATED * by_chance, _STANDING_OUT * others)
    return astray


def _scatter(off: Double) -> float:
    """Mean distance from the middle."""
    return float(np.abs(off - np.median(off)).mean())


def doubts_about_places(astray: Bool, names: Sequence[str], source: Path | None) -> Iterator[str]:
    """A sentence that names the frames that are ``astray`` of those that were compared."""
    off = [name for name, wrong in zip(names, astray.tolist(), strict=True) if wrong]
    if not off:
        return
    place = f"{source.name}: " if source else ""
    yield (
        f"{place}{len(off)} of {len(names)} frames that were compared show other things than the "
        f"rest do at the same points of the mesh: {first_of(off, _LISTED)}. Likely they "
        "have the poses of other frames, or something was moved, or lamps were switched, between "
        "frames. Correct the poses, leave these frames out, or make a capture of each state. "
        "[capture.astray]"
    )
