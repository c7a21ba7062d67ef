"""Photographs of one view with several exposures become one picture of radiance.

The camera's response is recovered after Debevec and Malik, "Recovering High Dynamic Range Radiance
Maps from Photographs" (1997): with Z the stored code, t the exposure and E what falls on the
sensor, f(E t) = Z and g = ln f^-1, the g (256 numbers) and all E are found that fit
g(Z) = ln E + ln t best, g smooth. Here g is monotone too, because no camera's is not. E is then the
mean over all exposures that neither clip nor drown, weighed by how exactly their codes tell it.
Everything is known up to one factor, the same for all pictures of one response.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter, uniform_filter
from scipy.optimize import nnls

from usdbrdf import calibration
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Bool, Byte, Double, Float, Int

# Codes beyond which a channel is dark or bright, and not how much; JPEG moves codes near its ends.
DARK_CODE, BRIGHT_CODE = 4, 250
_MIDDLE = 128
_SMOOTH = calibration.number("brackets.smooth")
_GHOST = calibration.number("brackets.ghost")
_SPREAD = calibration.number("brackets.spread")
_VAGUE = calibration.number("brackets.vague")
_KEPT = calibration.number("brackets.kept")
_FLICKER = calibration.number("brackets.flicker")
# Samples that two exposures must both tell before they are held against each other.
_ENOUGH = 200
# Pixels of each code that one bracket gives to the fit, and rounds of its reweighting.
_PER_CODE, _ROUNDS = 24, 3
# Share of a pixel and its eight neighbours that noise alone reaches.
_ALONE = 2.5 / 9
# Codes over which errors are taken together.
_AROUND = 9


class Response(NamedTuple):
    """What a camera's codes mean.

    logarithm  (3, 256) float64, of the exposure E t of each channel's codes, 0 at code 128; never
               decreasing
    error      (3, 256), its standard deviation: noise, rounding to codes, compression
    """

    logarithm: Double
    error: Double

    def clear(self) -> Int:
        """(2, 3), of each channel the darkest and the brightest code that tells how much. Cameras
        lift their blacks, and bend what is nearly white, differently in each channel: such codes
        stand for anything."""
        ends = []
        for error in self.error:
            told = np.flatnonzero(error[DARK_CODE : BRIGHT_CODE + 1] <= _VAGUE) + DARK_CODE
            ends.append((told.min(initial=_MIDDLE), told.max(initial=_MIDDLE)))
        return np.array(ends, np.int32).T


class Merged(NamedTuple):
    """One picture: radiance (H, W, 3) float32, NaN where the exposures contradict each other or
    none tells; a channel that clips in all exposures is ``saturation`` or more, one that is dark in
    all lies below ``noise_floor``.

    exposures       (K,) that it was merged with: what is stated, or where the pixels tell otherwise
                    (lamps flicker, fast shutters err) what they do
    clipped, ghost  shares of the pixels
    """

    radiance: Float
    saturation: float
    noise_floor: float
    exposures: Double
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
    """(K, P) codes of some pixels of (K, H, W): of each exposure's codes the same number, spread
    over the evener half of its places, which a shift by a part of a pixel does not change. The
    evenest alone may all be one thing, as a screen, whose colour no channel tells by itself."""
    edge = np.zeros(stack.shape[1:])
    for picture in stack.astype(np.float64):
        across, down = np.gradient(picture)
        edge += np.hypot(across, down)
    order = np.argsort(edge.ravel(), kind="stable")
    flat = stack.reshape(len(stack), -1)[:, order]
    chosen = []
    for exposure in flat:
        for code in range(DARK_CODE, BRIGHT_CODE + 1):
            places = np.flatnonzero(exposure == code)
            even = places[: max(_PER_CODE, len(places) // 2)]
            few = np.linspace(0, len(even) - 1, min(_PER_CODE, len(even))).astype(np.int32)
            chosen.append(even[few])
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
    # Where two ranges of codes disagree, each in turn would be to blame; half of the way, both are.
    for _ in range(2 * _ROUNDS):
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
        error = np.sqrt(error * np.maximum(median_filter(each, _AROUND, mode="nearest"), least))
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


def exposures_as_shown(stack: Byte, exposures: Double, response: Response, silent: Bool) -> Double:
    """(K,) exposures of a bracket, ``merge``'s arguments, as its pixels tell them.

    From the longest on each is held against the next longer: what both show clearly has one
    radiance. A lamp's flicker, which short exposures catch at one moment, counts so as an exposure
    that is longer or shorter than stated; else the lamp would contradict itself. The longest one
    lasts longest, so that it averages over the flicker. What differs by no more than
    ``brackets.kept`` is as stated; what by more than ``brackets.flicker`` is no flicker, and stays.
    """
    darkest, brightest = response.clear()
    tells = (stack >= darkest) & (stack <= brightest) & ~silent
    order = np.argsort(-exposures, kind="stable")
    shown = exposures.copy()
    channel = np.arange(3)
    for longer, shorter in pairwise(order.tolist()):
        both = tells[longer] & tells[shorter]
        if both.sum() < _ENOUGH:
            continue
        codes = stack[shorter], stack[longer]
        brighter, fainter = (response.logarithm[channel, c][both] for c in codes)
        error = np.hypot(*(response.error[channel, c][both] for c in codes))
        apart = np.quantile(brighter - fainter, 0.5, weights=error**-2, method="inverted_cdf")
        off = float(apart - np.log(exposures[shorter] / shown[longer]))
        if _KEPT < abs(off) <= _FLICKER:
            shown[shorter] = exposures[shorter] * np.exp(off)
    return shown


def merge(stack: Byte, exposures: Double, response: Response, silent: Bool | None = None) -> Merged:
    """One picture of radiance from a bracket, (K, H, W, 3) uint8, aligned, exposed (K,).

    silent  (K, H, W, 3) where an exposure shows nothing; None: nowhere

    What is further off the mean than ``brackets.ghost`` of its errors contradicts the others.
    """
    silent = np.zeros(stack.shape, np.bool_) if silent is None else silent
    exposures = exposures_as_shown(stack, exposures, response, silent)
    channel = np.arange(3)
    logs = response.logarithm[channel, stack] - np.log(exposures)[:, None, None, None]
    error = response.error[channel, stack]
    darkest, brightest = response.clear()
    over, under = stack > brightest, stack < darkest
    tells = ~over & ~under & ~silent
    weight = tells / error**2
    total = weight.sum(axis=0)
    known = total > 0
    mean = (weight * logs).sum(axis=0) / np.where(known, total, 1)
    against = (tells & (np.abs(logs - mean) > _GHOST * error)).any(axis=0)
    limits = np.array([darkest, brightest]).T
    ends = np.take_along_axis(response.logarithm, limits, axis=1)
    # What clips in an exposure, or is dark in it, is a bound on what the others say.
    reach = _GHOST * np.take_along_axis(response.error, limits, axis=1)
    exposed = mean + np.log(exposures)[:, None, None, None]
    against |= known & (over & ~silent & (exposed < (ends - reach)[:, 1])).any(axis=0)
    against |= known & (under & ~silent & (exposed > (ends + reach)[:, 0])).any(axis=0)
    floor = float(np.exp(ends[:, 0].max() - np.log(exposures.max())))
    ceiling = float(np.exp(ends[:, 1].min() - np.log(exposures.min())))
    radiance = np.where(known, np.exp(mean), np.nan)
    # Of these limits only the shortest exposure knows the one, the longest the other.
    clipped = (over | silent).all(axis=0) & ~silent[exposures.argmin()]
    dark = (under | silent).all(axis=0) & ~silent[exposures.argmax()]
    radiance = np.where(clipped, 2 * ceiling, np.where(dark, 0, radiance))
    # What moves covers more than a pixel; what noise does is alone.
    ghost = uniform_filter(against.any(axis=2).astype(np.float32), 3) > _ALONE
    # Nothing passed before what clips in all exposures; how bright it is at least stays known.
    lamp = clipped.any(axis=2)
    radiance[ghost & ~lamp] = np.nan
    radiance[lamp & np.isnan(radiance).any(axis=2)] = 2 * ceiling
    return Merged(
        radiance=radiance.astype(np.float32),
        saturation=ceiling,
        noise_floor=floor,
        exposures=exposures,
        clipped=float((radiance >= ceiling).any(axis=2).mean()),
        ghost=float(ghost.mean()),
    )
