"""Do the frames agree how bright the same surfaces are?

A frame whose exposure was not divided out, or which is not linear, shows everything brighter or
darker than the others do, by about one factor. With x the logarithm of a sample, g its frame's
gain and r its texel's radiance, x = g + r + error: least squares with Huber's weights, in which
highlights lose theirs, and from which the radiances are eliminated. What all gains have in common
cannot be known; their median is 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from usdbrdf import calibration
from usdbrdf.errors import InputRefused
from usdbrdf.job.progress import warn
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames

# Texels whose samples are kept, at most, and samples in all: of many frames it is fewer texels.
_MOST_TEXELS, _MOST_SAMPLES = 4096, 1 << 21
CONTRADICTING = calibration.number("exposures.contradicting") * math.log(2)
_STANDING_OUT = calibration.number("exposures.standing_out")
_MOST = calibration.number("exposures.most")
_OUTLYING = calibration.number("exposures.outlying")
# Of a surface that is asked about its frame, and of those that must agree.
_OF_SURFACE = calibration.number("exposures.of_surface")
_AGREEING = calibration.number("exposures.agreeing")
# Samples of texels that other frames show too, without which a frame is not judged.
FEWEST = 24
# Steps of the reweighting.
_STEPS = 8
# Frames that are named.
_LISTED = 6
# What draws a gain to 0 that nothing else decides, in samples.
_TIE = 1e-3


class Probes(NamedTuple):
    """Samples of every so many texels, in all frames.

    every      the texels are those whose number this divides
    first      the first of their numbers, by ``every``
    logarithm  (P, N) float32, of the mean of R, G and B; NaN where the frame has no sample
    """

    every: int
    first: int
    logarithm: Float

    @classmethod
    def empty(cls, num_texels: int, num_frames: int, part: slice | None = None) -> Probes:
        """Of the texels of ``part`` (None: all) of so many, no sample."""
        every = _every(num_texels, num_frames)
        start, stop = (part.start, part.stop) if part else (0, num_texels)
        first, end = -(-start // every), -(-stop // every)
        return cls(every, first, np.full((end - first, num_frames), np.nan, np.float32))

    def of(self, part: slice) -> Probes:
        """Those of the texels of ``part``, which are among these."""
        first, end = -(-part.start // self.every), -(-part.stop // self.every)
        own = self.logarithm[first - self.first : end - self.first]
        return Probes(self.every, first, own)

    def add(self, frame: int, texel: Int, radiance: Float) -> None:
        """Keep what is needed of one frame's samples: texel (M,), radiance (M, 3)."""
        own = np.flatnonzero(texel % self.every == 0)
        level = radiance[own].mean(axis=1)
        own, level = own[level > 0], level[level > 0]
        self.logarithm[texel[own] // self.every - self.first, frame] = np.log(level)


def probed_texels(num_texels: int, num_frames: int) -> Long:
    """(P,) the numbers of the texels that the rows of all ``Probes`` are of."""
    return np.arange(0, num_texels, _every(num_texels, num_frames))


def _every(num_texels: int, num_frames: int) -> int:
    return -(-num_texels // min(_MOST_TEXELS, max(1, _MOST_SAMPLES // num_frames)))


class Gains(NamedTuple):
    """Of N frames: logarithm of the gain, scatter (as a standard deviation) of the frame's samples
    around it, and number of its samples that other frames can be held against, each (N,); and by
    what each sample is brighter than the others of its texel, (P, N), NaN where none compare."""

    logarithm: Double
    scatter: Double
    samples: Double
    brighter: Double


def gains_of_frames(logarithm: Float) -> Gains:
    """How much brighter each frame shows the same texels than the others do.

    logarithm  (P, N) as in ``Probes``
    """
    known = np.isfinite(logarithm)
    known &= (known.sum(axis=1) > 1)[:, None]
    weight = known.astype(np.float64)
    value = np.where(known, logarithm, 0).astype(np.float64)
    gain = np.zeros(value.shape[1])
    for _ in range(_STEPS):
        gain = _least_squares(value, weight, gain)
        radiance = _mean(value - gain, weight)
        off = value - gain - radiance[:, None]
        weight = known * np.minimum(1, _OUTLYING / np.maximum(np.abs(off), 1e-9))
    count = known.sum(axis=0).astype(np.float64)
    spreads = [
        np.median(np.abs(o[k])) if k.any() else 0 for o, k in zip(off.T, known.T, strict=True)
    ]
    enough = count >= FEWEST
    usual = np.median(gain[enough]) if enough.any() else 0.0
    # Beside what the others show: a sample's own share in its texel's mean would hide half of it.
    others = weight.sum(axis=1)[:, None] - weight
    alone = (value - gain - _mean(value - gain, weight)[:, None]) * (1 + weight / others.clip(1e-9))
    brighter = np.where(known & (others > 1e-3), alone + gain - usual, np.nan)
    return Gains(gain - usual, 1.4826 * np.array(spreads, np.float64), count, brighter)


def _least_squares(value: Double, weight: Double, start: Double) -> Double:
    """The gains (N,) that fit values (P, N) best, each row with a radiance of its own."""
    own, total = weight.sum(axis=0) + _TIE, np.maximum(weight.sum(axis=1), 1e-12)

    def normal(gain: Double) -> Double:
        return np.asarray(own * gain - weight.T @ ((weight @ gain) / total))

    said = (weight * (value - _mean(value, weight)[:, None])).sum(axis=0)
    equations = LinearOperator((len(own), len(own)), matvec=normal, dtype=np.float64)
    gain: Double = cg(equations, said, x0=start, rtol=1e-3, maxiter=200)[0]
    return gain


def _mean(value: Double, weight: Double) -> Double:
    """(P,) weighted means of the rows."""
    return np.asarray((weight * value).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12))


def surfaces_agree(brighter: Double, gain: Double, owner: Int) -> Bool:
    """(N,) frames whose surfaces agree on their gain: of those with enough samples, the others
    being taken as one, most are off by half of it at least. What one surface alone is off by is its
    gloss, or a wrong shape; one that is off the other way says nothing. A frame that shows too
    little does not agree.

    brighter  (P, N) by what samples are brighter than others of their points, NaN where unknown
    gain      (N,) what a frame is off by
    owner     (P,) the surface that a point is of
    """
    surface = np.unique(owner, return_inverse=True)[1]
    agree = np.zeros(len(gain), np.bool_)
    for i in range(len(gain)):
        shown = np.flatnonzero(np.isfinite(brighter[:, i]))
        if len(shown) < FEWEST or gain[i] == 0:
            continue
        own, off = surface[shown], brighter[shown, i] / gain[i]
        own = np.where(np.bincount(own)[own] >= _OF_SURFACE, own, -1)
        parts = [off[own == k] for k in np.unique(own)]
        told = np.array([np.median(part) for part in parts if len(part) >= _OF_SURFACE])
        told = told[told > -0.5]
        agree[i] = len(told) > 0 and (told >= 0.5).mean() >= _AGREEING
    return agree


def with_estimated_exposures(frames: Frames, logarithm: Float) -> tuple[Frames, dict[str, float]]:
    """The frames as if each had been exposed as its pixels say, and image and gain of those that
    contradicted the others. Frames that share too little with others stay as they are.

    logarithm  (P, N) as in ``Probes``
    """
    found = gains_of_frames(logarithm)
    known = found.samples >= FEWEST
    gain = np.where(known, np.exp(found.logarithm), 1.0)
    off = np.flatnonzero(known & _stands_out(found))
    changed = replace(
        frames,
        exposure_time=frames.exposure_time * gain,
        saturation_radiance=frames.saturation_radiance / gain,
        noise_floor_radiance=frames.noise_floor_radiance / gain,
        gain=gain * (1.0 if frames.gain is None else frames.gain) if frames.radiometric else None,
    )
    return changed, {frames.image_paths[i].name: round(float(gain[i]), 2) for i in off}


def doubts_about_exposures(off: Mapping[str, float], count: int, source: Path) -> Iterator[str]:
    """A sentence where some of so many frames contradicted the others, by image their gains, which
    were divided out."""
    if off:
        named = ", ".join(f"{name} ({gain:.2f} x)" for name, gain in off.items())
        yield (
            f"{source.name}: {len(off)} of {count} frames contradicted the others, "
            f"{named}; what all are off by was divided out. [capture.exposure]"
        )


def _stands_out(gains: Gains) -> Bool:
    size = np.abs(gains.logarithm)
    return np.asarray((size > CONTRADICTING) & (size > _STANDING_OUT * gains.scatter), np.bool_)


def contradicting_frames(frames: Frames, logarithm: Float, owner: Int) -> dict[str, float]:
    """Image and gain of the frames that show the same texels brighter or darker than the others do,
    by a quarter of a stop or more, and most of their surfaces so; the user is told.

    logarithm  (P, N) as in ``Probes``
    owner      (P,) the surface that a texel is of

    Raises InputRefused where more than a fifth do and the images are said to be radiance.
    """
    gains = gains_of_frames(logarithm)
    compared = gains.samples >= FEWEST
    off = np.flatnonzero(compared & _stands_out(gains))
    off = off[surfaces_agree(gains.brighter[:, off], gains.logarithm[off], owner)]
    factor = {frames.image_paths[i].name: round(math.exp(gains.logarithm[i]), 2) for i in off}
    if not factor:
        return {}
    names = [f"{name} ({gain:.2f} x)" for name, gain in factor.items()]
    what = (
        f"{len(off)} of {int(compared.sum())} frames show the same surfaces brighter or darker "
        f"than the other frames do, {', '.join(names[:_LISTED])}"
        f"{f' and {len(names) - _LISTED} more' if len(names) > _LISTED else ''}"
    )
    cause = (
        "Likely their exposure_time was not divided out of the pixels, or the images are not linear"
    )
    if frames.radiometric and len(off) > _MOST * compared.sum():
        raise InputRefused(
            f"{what} (limits: a quarter of a stop, {_MOST:.0%} of the frames). {cause}. "
            "Export radiance in one unit for all frames, or run ingest with --exposure estimate. "
            "[texturing.exposure]"
        )
    warn(
        f"{what}. {cause}. Correct them, leave them out, or use --exposure estimate. "
        "[texturing.exposure]"
    )
    return factor
