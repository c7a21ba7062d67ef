"""Photographs of one view with several exposures become one picture of radiance.

The camera's response is recovered after Debevec and Malik, "Recovering High Dynamic Range Radiance
Maps from Photographs" (1997): with Z the stored code, t the exposure and E what falls on the
sensor, f(E t) = Z and g = ln f^-1, the g (256 numbers) and all E are found that fit
g(Z) = ln E + ln t best, g smooth. Here g is monotone too, because no camera's is not. E is then the
mean over all exposures that neither clip nor drown, weighed by how exactly their codes tell it.
Everything is known up to one factor, the same for all pictures of one response.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter, uniform_filter
from scipy.optimize import nnls

from usdbrdf import calibration
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Bool, Byte, Double, Float, Int

T = TypeVar("T", bound=np.generic)
# Codes beyond which a channel is dark or bright, and not how much; JPEG moves codes near its ends.
DARK_CODE, BRIGHT_CODE = 4, 250
_MIDDLE = 128
_SMOOTH = calibration.number("brackets.smooth")
_GHOST = calibration.number("brackets.ghost")
_SPREAD = calibration.number("brackets.spread")
# Pixels of each code that one bracket gives to the fit, and rounds of its reweighting.
_PER_CODE, _ROUNDS = 12, 3
# Share of a pixel and its eight neighbours that noise alone reaches.
_ALONE = 2.5 / 9
# Codes over which errors are taken together.
_AROUND = 9
# How far brackets are shifted, at most, as a power of two, in pixels.
_LEVELS = 6
# Codes between which the threshold of a bitmap is chosen, and those around it that say nothing.
_CLEAR, _UNDECIDED = (16, 239), 4
# Pixels by which the parts of a shifted picture may disagree, if so many more of their bits fit.
_NEAR, _BETTER = 1.5, 0.01


class Response(NamedTuple):
    """What a camera's codes mean.

    logarithm  (3, 256) float64, of the exposure E t of each channel's codes, 0 at code 128; never
               decreasing
    error      (3, 256), its standard deviation: noise, rounding to codes, compression
    """

    logarithm: Double
    error: Double


class Merged(NamedTuple):
    """One picture: radiance (H, W, 3) float32, NaN where the exposures contradict each other or
    none tells; a channel that clips in all exposures is ``saturation`` or more, one that is dark in
    all lies below ``noise_floor``.

    clipped, ghost  shares of the pixels
    """

    radiance: Float
    saturation: float
    noise_floor: float
    clipped: float
    ghost: float


def response_from_brackets(
    brackets: list[Byte], exposures: list[Double], *, smooth: float = _SMOOTH
) -> Response:
    """The response of the camera that took some brackets.

    brackets   each (K, H, W, 3) uint8, aligned
    exposures  each (K,), in one unit
    smooth     Debevec and Malik's lambda

    Raises InputRefused where no bracket has two exposures of which both tell something.
    """
    rows, errors = [], []
    for channel in range(3):
        codes = [_samples(b[..., channel]) for b in brackets]
        logs = [np.log(e) for e in exposures]
        if not any(_tells(c).sum(axis=0).max(initial=0) > 1 for c in codes):
            raise InputRefused(
                "brackets: no pixel is well exposed in two of them, so that no response can be "
                "told. Take exposures at most four stops apart. [brackets.response]"
            )
        rows.append(_logarithm(codes, logs, smooth))
        errors.append(_errors(rows[-1], codes, logs))
    return Response(np.array(rows), np.array(errors))


def _tells(codes: Byte) -> Bool:
    return np.asarray((codes >= DARK_CODE) & (codes <= BRIGHT_CODE), np.bool_)


def _samples(stack: Byte) -> Byte:
    """(K, P) codes of some pixels of (K, H, W): of each exposure's codes the same number, those in
    the evenest places, which a shift by a part of a pixel does not change."""
    edge = np.zeros(stack.shape[1:])
    for picture in stack.astype(np.float64):
        across, down = np.gradient(picture)
        edge += np.hypot(across, down)
    order = np.argsort(edge.ravel(), kind="stable")
    flat = stack.reshape(len(stack), -1)[:, order]
    chosen = [
        np.flatnonzero(exposure == code)[:_PER_CODE]
        for exposure in flat
        for code in range(DARK_CODE, BRIGHT_CODE + 1)
    ]
    return flat[:, np.unique(np.concatenate(chosen))]


def _logarithm(codes: list[Byte], logs: list[Double], smooth: float) -> Double:
    """g (256,), from the codes (K, P) and log exposures (K,) of each bracket.

    The radiances are eliminated: of each pixel only the differences between its exposures count.
    g grows by increments of 0 or more, for which the normal equations are solved.
    """
    hat = np.minimum(np.arange(256) - DARK_CODE, BRIGHT_CODE - np.arange(256)) + 1.0
    hat = np.maximum(hat, 0) / hat.max()
    g, result = np.zeros(256), np.zeros(256)
    steps = np.diff(np.log(np.arange(256) + 1.0))
    bend = np.diff(np.diff(np.eye(256), axis=0) / steps[:, None], axis=0)
    curve = smooth * bend / np.sqrt((steps[1:] + steps[:-1]) / 2)[:, None]
    grows = np.tril(np.ones((256, 256)))[:, 1:]
    for attempt in range(_ROUNDS):
        normal, said = curve.T @ curve, np.zeros(256)
        for z, log in zip(codes, logs, strict=True):
            weight = hat[z]
            if attempt:
                off = _around_mean(g[z] - log[:, None], weight)
                weight = weight * np.minimum(1, _SPREAD / np.maximum(np.abs(off), 1e-9))
            _add(normal, said, z, log, weight)
        # x' A x - 2 b' x with x = grows d, d >= 0, as a least squares problem.
        values, vectors = np.linalg.eigh(grows.T @ normal @ grows)
        values = np.maximum(values, 1e-12 * values.max())
        root = np.sqrt(values)[:, None] * vectors.T
        rises = nnls(root, (vectors.T @ (grows.T @ said)) / np.sqrt(values), maxiter=20_000)[0]
        result = grows @ rises
        g = result - result[_MIDDLE]
    return g


def _errors(g: Double, codes: list[Byte], logs: list[Double]) -> Double:
    """(256,) how far off the other exposures' mean the logarithm of each code is, as a standard
    deviation; never less than that of rounding to codes."""
    least = np.hypot(_SPREAD, np.gradient(g) / np.sqrt(12))
    error = least
    for _ in range(_ROUNDS):
        sizes: list[Double] = []
        numbers: list[Int] = []
        for z, log in zip(codes, logs, strict=True):
            value, weight = g[z] - log[:, None], _tells(z) / error[z] ** 2
            total = weight.sum(axis=0) - weight
            others = ((weight * value).sum(axis=0) - weight * value) / np.maximum(total, 1e-12)
            # Whoever is told more exactly than by the code in question judges it.
            compared = _tells(z) & (total >= weight)
            sizes.append(np.abs(value - others)[compared])
            numbers.append(z[compared].astype(np.int32))
        size, code = np.concatenate(sizes), np.concatenate(numbers)
        own = [size[code == c] for c in range(256)]
        known = np.array([c for c in range(256) if len(own[c])] or [_MIDDLE])
        found = [float(np.median(own[c])) if len(own[c]) else 0.0 for c in known]
        each = np.interp(np.arange(256), known, 1.4826 * np.array(found))
        error = np.maximum(median_filter(each, _AROUND, mode="nearest"), least)
    return np.asarray(error, np.float64)


def _around_mean(value: Double, weight: Double) -> Double:
    """Of each column (K, P): how far off its weighted mean."""
    total = np.maximum(weight.sum(axis=0), 1e-12)
    return np.asarray(value - (weight * value).sum(axis=0) / total)


def _add(normal: Double, said: Double, codes: Byte, log: Double, weight: Double) -> None:
    """Add the equations of one bracket, codes (K, P): w (g(Z) - log - mean of these) = 0."""
    total = np.maximum(weight.sum(axis=0), 1e-12)
    np.add.at(normal, (codes, codes), weight)
    np.add.at(
        said, codes, weight * _around_mean(np.broadcast_to(log[:, None], codes.shape), weight)
    )
    for one in range(len(codes)):
        for other in range(len(codes)):
            np.add.at(normal, (codes[one], codes[other]), -weight[one] * weight[other] / total)


def merge(stack: Byte, exposures: Double, response: Response) -> Merged:
    """One picture of radiance from a bracket, (K, H, W, 3) uint8, aligned, exposed (K,).

    What is further off the mean than ``brackets.ghost`` of its errors contradicts the others.
    """
    channel = np.arange(3)
    logs = response.logarithm[channel, stack] - np.log(exposures)[:, None, None, None]
    error = response.error[channel, stack]
    tells = _tells(stack)
    weight = tells / error**2
    total = weight.sum(axis=0)
    known = total > 0
    mean = (weight * logs).sum(axis=0) / np.where(known, total, 1)
    against = (tells & (np.abs(logs - mean) > _GHOST * error)).any(axis=0)
    ends = response.logarithm[:, [DARK_CODE, BRIGHT_CODE]]
    # What clips in an exposure, or is dark in it, is a bound on what the others say.
    reach = _GHOST * response.error[:, [DARK_CODE, BRIGHT_CODE]]
    exposed = mean + np.log(exposures)[:, None, None, None]
    against |= known & ((stack > BRIGHT_CODE) & (exposed < (ends - reach)[:, 1])).any(axis=0)
    against |= known & ((stack < DARK_CODE) & (exposed > (ends + reach)[:, 0])).any(axis=0)
    floor = float(np.exp(ends[:, 0].max() - np.log(exposures.max())))
    ceiling = float(np.exp(ends[:, 1].min() - np.log(exposures.min())))
    radiance = np.where(known, np.exp(mean), np.nan)
    clipped, dark = (stack > BRIGHT_CODE).all(axis=0), (stack < DARK_CODE).all(axis=0)
    radiance = np.where(clipped, 2 * ceiling, np.where(dark, 0, radiance))
    # What moves covers more than a pixel; what noise does is alone.
    ghost = uniform_filter(against.any(axis=2).astype(np.float32), 3) > _ALONE
    radiance[ghost] = np.nan
    return Merged(
        radiance=radiance.astype(np.float32),
        saturation=ceiling,
        noise_floor=floor,
        clipped=float((radiance >= ceiling).any(axis=2).mean()),
        ghost=float(ghost.mean()),
    )


def aligned(stack: Byte, names: list[str]) -> tuple[Byte, Int]:
    """A hand-held bracket, (K, H, W, 3) by exposure, shifted by whole pixels onto its middle
    exposure; where nothing is known after that the code is 0 in all. And the shifts (K, 2).

    Bitmaps above and below a rank are compared, coarse to fine (Ward, "Fast, robust image
    registration", 2003). Raises InputRefused, with ``names``, where parts of a picture have moved
    differently: it was turned, or something near was seen from elsewhere.
    """
    grey = stack.astype(np.float32).mean(axis=3).astype(np.uint8)
    middle = len(stack) // 2
    shifts = np.zeros((len(stack), 2), np.int32)
    for k in [*range(middle + 1, len(stack)), *range(middle - 1, -1, -1)]:
        near = k - 1 if k > middle else k + 1
        step = _shift(grey[near], grey[k], _LEVELS)
        rows, columns = (n // 2 for n in grey.shape[1:])
        corners = [
            (slice(a, a + rows), slice(b, b + columns)) for a in (0, rows) for b in (0, columns)
        ]
        moved = _moved(grey[k], step)
        if any(_moves_on(grey[near][c], moved[c]) for c in corners):
            raise InputRefused(
                f"{names[k]}: its parts have moved by different amounts against {names[near]}, "
                "which no shift undoes. Use a tripod, or leave it out. [brackets.moved]"
            )
        shifts[k] = shifts[near] + step
    whole = np.ones(grey.shape[1:], np.bool_)
    result = np.empty_like(stack)
    for k, shift in enumerate(shifts):
        result[k] = _moved(stack[k], shift)
        whole &= _moved(np.ones_like(whole), shift)
    result[:, ~whole] = 0
    return result, shifts


def _moved(picture: npt.NDArray[T], shift: Int) -> npt.NDArray[T]:
    """The picture down and right by ``shift``; 0 comes in."""
    down, right = (int(n) for n in shift)
    height, width = picture.shape[:2]
    moved = np.zeros_like(picture)
    to = slice(max(0, down), height + min(0, down)), slice(max(0, right), width + min(0, right))
    start = (
        slice(max(0, -down), height + min(0, -down)),
        slice(max(0, -right), width + min(0, -right)),
    )
    moved[to] = picture[start]
    return moved


def _shift(fixed: Byte, other: Byte, levels: int) -> Int:
    """By how many pixels, down and right, ``other`` (H, W) is to be moved onto ``fixed``."""
    best = np.zeros(2, np.int32)
    levels = min(levels, max(0, int(np.log2(max(min(fixed.shape), 1) / 16))))
    rank = _common_rank(fixed, other)
    if rank is None:
        return best
    for level in range(levels, -1, -1):
        one, two = fixed[:: 1 << level, :: 1 << level], other[:: 1 << level, :: 1 << level]
        if level:
            one, two = _reduced(fixed, level), _reduced(other, level)
        bits = _bitmap(one, rank), _bitmap(two, rank)
        best = 2 * best
        tries = [best + np.array(d, np.int32) for d in np.ndindex(3, 3)]
        tries = [t - 1 for t in tries]
        best = min(tries, key=lambda t: (_differing(*bits, t), int(np.abs(t).sum())))
    return best


def _moves_on(fixed: Byte, other: Byte) -> bool:
    """Whether these parts of two pictures fit clearly better shifted by more than a pixel."""
    shift, rank = _shift(fixed, other, 3), _common_rank(fixed, other)
    if rank is None or np.abs(shift).max() <= _NEAR:
        return False
    bits = _bitmap(fixed, rank), _bitmap(other, rank)
    return _differing(*bits, np.zeros(2, np.int32)) > _BETTER + _differing(*bits, shift)


def _reduced(picture: Byte, level: int) -> Byte:
    """Means of squares of 2^level pixels to a side."""
    side = 1 << level
    height, width = (n // side * side for n in picture.shape)
    parts = picture[:height, :width].reshape(height // side, side, width // side, side)
    return np.asarray(parts.mean(axis=(1, 3)), np.uint8)


def _common_rank(one: Byte, other: Byte) -> float | None:
    """A share of the pixels below a code that is clear of the ends in either picture, nearest to
    one half; None where there is none."""
    ranks = np.arange(1, 50) / 50
    low, high = _CLEAR
    codes = np.array([np.quantile(picture, ranks) for picture in (one, other)])
    clear = ranks[((codes >= low) & (codes <= high)).all(axis=0)]
    return float(clear[np.abs(clear - 0.5).argmin()]) if len(clear) else None


def _bitmap(picture: Byte, rank: float) -> tuple[Bool, Bool]:
    """(H, W): above the code of that rank, and clearly above or below it."""
    threshold = np.quantile(picture, rank)
    return picture > threshold, np.abs(picture - threshold) > _UNDECIDED


def _differing(one: tuple[Bool, Bool], other: tuple[Bool, Bool], shift: Int) -> float:
    """Share of the decided pixels whose bits differ, ``other`` moved."""
    above, decided = _moved(other[0], shift), _moved(other[1], shift)
    both = one[1] & decided
    return float((both & (one[0] != above)).sum() / max(int(both.sum()), 1))
