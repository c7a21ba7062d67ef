"""Patterns as fine as pixels, as all frames together tell them.

A pixel shows the mean of what it covers, and a mean of such means is blurred, however many there
are. But pixels of different frames cover a pattern differently: the texture of which all of them
are means is found by least squares (M. Irani and S. Peleg, "Improving Resolution by Image
Registration", CVGIP 1991). Of texels x, by a step d that minimises

    sum w (r - B d)^2 + sum (d / s)^2,    r = pixel - (B x) - what its neighbours have in common,

with B the means over what pixels cover. What pixels have in common with their neighbours, as in a
highlight, says nothing of a pattern. The step is taken by the share of it that is no noise (B.
Efron and C. Morris, "Stein's Estimation Rule and Its Competitors", 1973): noise that pixels do not
share explains so much of the squares as these leave unexplained, for each number that is free;
noise that the pixels of a frame share, so much as one half of the frames contradicts the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.kernel import loop, parallel_kernel
from usdbrdf.model.arrays import Array, Float, Int, Long
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.footprints import around, blurred
from usdbrdf.texturing.passes import with_rows_beside
from usdbrdf.texturing.pattern_pixels import ACROSS, REACH, Covering, PatternedSurface, covers
from usdbrdf.transport.warps import shifts_of

# Places of the texels that a pixel covers beside one of them, which come after it: the row below by
# so many, and the columns to the right.
_APART = 2 * REACH
_BESIDE = np.array(
    [(0, dx) for dx in range(_APART + 1)]
    + [(dy, dx) for dy in range(1, _APART + 1) for dx in range(-_APART, _APART + 1)]
)
_CONTRAST = calibration.number("patterns.contrast")
_MARGIN = calibration.number("patterns.margin")
# Steps of Chebyshev's iteration, and the smallest eigenvalue that these reach.
_STEPS, _SMALLEST = 16, 1 / 64
# Halves of the frames of which one has less than a twentieth of the weight say nothing of noise.
_LEAST_EQUAL = 0.05 * 0.95
_GOLDEN = (1 + 5**0.5) / 2
# Rows of texels beside a group that what becomes of it depends on, of whose steps again what both
# halves of the frames contradict each other on.
ROWS_BESIDE = _APART * (2 * _STEPS + 2)


class Equations(NamedTuple):
    """Least squares for T texels, of all pixels so far.

    coupling  (2, T, 41) float32, B^T W B of each texel and those of _BESIDE: of either half of
              the frames
    pull      (2, T, 3) float32, B^T W r
    squares   (T,) float32, sum w r^2, mean of the channels; pixels (T,), how many
    """

    coupling: Float
    pull: Float
    squares: Float
    pixels: Float

    @classmethod
    def empty(cls, num_texels: int) -> Equations:
        def zeros() -> Float:
            return np.zeros(num_texels, np.float32)

        halves = np.zeros((2, num_texels, len(_BESIDE)), np.float32)
        return cls(halves, np.zeros((2, num_texels, 3), np.float32), zeros(), zeros())


# Bytes per texel of these, of the sum of both halves, and of the iteration's vectors.
BYTES_OF_EQUATIONS = 4 * (3 * (len(_BESIDE) + 3) + 2) + 208


def add(
    equations: Equations, first: int, surface: PatternedSurface, pixels: Covering, half: int
) -> None:
    """A frame's pixels more, in place, into a ``half`` of the equations of the texels from number
    ``first`` on."""
    texels = surface.texels
    owner = surface.object[pixels.texel]
    _add(
        0, len(pixels.texel), pixels, owner, first, surface.own, texels.pixel, texels.first_pixel,
        texels.resolution, Equations(
            equations.coupling[half], equations.pull[half], equations.squares, equations.pixels
        ),
    )  # fmt: skip


@loop
def _add(
    start: int, stop: int, pixels: Covering, owner: Int, first: int, own: Int, pixel: Long,
    first_pixel: Long, resolution: Int, equations: Equations,
) -> None:  # fmt: skip
    coupling, pull, squares, count = equations
    covered = np.empty(ACROSS * ACROSS, np.float32)
    which = np.empty(ACROSS * ACROSS, np.int64)
    for m in range(start, stop):
        t, o = pixels.texel[m], owner[m]
        wide = resolution[o, 0]
        at = pixel[t] - first_pixel[o]
        covers(
            pixels.where[m], pixels.step[m], at % wide, at // wide, wide, resolution[o, 1], covered
        )
        used = 0
        for n in range(len(covered)):
            if covered[n] > 0:
                which[used] = n
                used += 1
        w = pixels.weight[m]
        rest = pixels.rest[m]
        square = w * (rest[0] ** 2 + rest[1] ** 2 + rest[2] ** 2) / 3
        for a in range(used):
            n = which[a]
            down, along = n // ACROSS, n % ACROSS
            s = own[pixel[t] + (down - REACH) * wide + along - REACH] - first
            if s < 0 or s >= len(count):
                continue
            share = covered[n]
            count[s] += share
            squares[s] += share * square
            for c in range(3):
                pull[s, c] += w * share * rest[c]
            for b in range(a, used):
                dy = which[b] // ACROSS - down
                dx = which[b] % ACROSS - along
                k = dx if dy == 0 else _APART + 1 + (dy - 1) * (2 * _APART + 1) + dx + _APART
                coupling[s, k] += w * share * covered[which[b]]


def steps(
    equations: Equations, part: slice, surface: PatternedSurface, level: Float, seed: int
) -> dict[str, Array]:
    """The step d (n, 3) of the texels of ``part``, of which the equations are; and of each, (n, 6)
    "told": what it explains of the squares, how much of that both halves of the frames do not
    agree on, how many numbers were free for it, which squares are left, how many pixels, and
    whether both halves were asked.
    level (n,): the radiance of which contrasts are a share."""
    texels = surface.texels
    owner, low = surface.object[part], int(texels.pixel[part.start])
    pixel, width = texels.pixel[part] - low, texels.resolution[owner, 0].astype(np.int64)
    first = texels.first_pixel[owner] - low
    number = np.full(int(pixel[-1]) + 1, -1, np.int32)
    number[pixel] = np.arange(len(pixel), dtype=np.int32)
    ridge = 1 / np.maximum(_CONTRAST * level[:, None], 1e-15) ** 2
    coupling, pull = equations.coupling.sum(axis=0), equations.pull.sum(axis=0)

    def coupled(coupling: Float, values: Float) -> Float:
        found = np.empty_like(values)
        _couple(len(pixel), coupling, pixel, first, width, number, values, found)
        return found

    # Ones and minus ones: what is left of them on the mean is how many numbers are free
    # (M. Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1990).
    own = np.arange(part.start, part.stop, dtype=np.int64)
    sign = np.where(shifts_of(own, 1, seed)[:, :1] < 0.5, -1, 1).astype(np.float32)
    sums = coupled(coupling, np.concatenate([np.ones_like(sign), sign], axis=1))
    # All couplings are positive, so these bound the eigenvalues by 1.
    bound = (sums[:, :1] + ridge).astype(np.float32)

    def scaled(values: Float) -> Float:
        return np.asarray((coupled(coupling, values) + ridge * values) / bound)

    found = _solved(scaled, np.concatenate([pull, sums[:, 1:]], axis=1) / bound)
    step = np.ascontiguousarray(found[:, :3])
    explained = (step * pull).mean(axis=1)
    again = (step * coupled(coupling, step)).mean(axis=1)
    # What the step leaves of one half's pull is what it leaves of the other's, turned.
    half = coupled(equations.coupling[0], np.concatenate([step, np.ones_like(sign)], axis=1))
    part_of_half = half[:, 3:] / np.maximum(sums[:, :1], 1e-30)
    equal = part_of_half * (1 - part_of_half)
    apart = (equations.pull[0] - half[:, :3]) / np.sqrt(np.maximum(equal, _LEAST_EQUAL))
    apart = np.where(equal > _LEAST_EQUAL, apart, 0).astype(np.float32)
    noise = _solved(scaled, apart / bound)
    told = [
        explained,
        (apart * noise).mean(axis=1),
        sign[:, 0] * found[:, 3],
        equations.squares - 2 * explained + again,
        equations.pixels,
        (equal > _LEAST_EQUAL)[:, 0].astype(np.float32),
    ]
    return {"step": step, "told": np.stack(told, axis=-1)}


def _solved(scaled: Callable[[Float], Float], left: Float) -> Float:
    """By Chebyshev's iteration, of a matrix whose eigenvalues are 1 at most (G. Golub and R. Varga,
    "Chebyshev semi-iterative methods", 1961)."""
    middle, half = (1 + _SMALLEST) / 2, (1 - _SMALLEST) / 2
    rate = half / middle
    change = left / np.float32(middle)
    found = change.copy()
    for _ in range(_STEPS - 1):
        left = left - scaled(change)
        faster = 1 / (2 * middle / half - rate)
        change = np.float32(faster * rate) * change + np.float32(2 * faster / half) * left
        rate = faster
        found += change
    return found


@parallel_kernel
def _couple(
    start: int, stop: int, coupling: Float, pixel: Long, first: Long, width: Long, number: Int,
    values: Float, out: Float,
) -> None:  # fmt: skip
    """B^T W B times ``values`` (T, C); first (T,): the first pixel of each one's atlas."""
    channels = values.shape[1]
    for t in range(start, stop):
        for c in range(channels):
            out[t, c] = coupling[t, 0] * values[t, c]
        for k in range(1, coupling.shape[1]):
            if k <= _APART:
                apart = np.int64(k)
            else:
                rows, columns = divmod(k - _APART - 1, 2 * _APART + 1)
                apart = (rows + 1) * width[t] + columns - _APART
            strength = coupling[t, k]
            if strength > 0:
                after = pixel[t] + apart
                s = number[after] if after < len(number) else np.int32(-1)
                if s >= 0:
                    for c in range(channels):
                        out[t, c] += strength * values[s, c]
            before = pixel[t] - apart
            if before >= max(first[t], 0):
                s = number[before]
                if s >= 0 and coupling[s, k] > 0:
                    for c in range(channels):
                        out[t, c] += coupling[s, k] * values[s, c]


def share_that_is_no_noise(texels: Texels, told: Float, footprint: Float) -> Float:
    """(T,): of the steps, from what is ``told`` (T, 6) of them and their neighbours; footprint
    (T, 3): what pixels cover, see ``blurred``."""
    explained, apart, free, left, count = around(texels, told[:, :5], footprint).T
    white = np.maximum(left, 0) / np.maximum(count - free, 0.1 * count + 1e-9) * free
    # What the pixels leave holds the patterns that are too fine for them: an object that has
    # patterns at all has those.
    owner = texels.object_index()
    both, alone = (np.bincount(owner, told[:, k] * told[:, 5]) for k in (0, 1))
    alike = np.where(both > 0, np.clip(alone / np.maximum(both - alone, 1e-12), 0, 1), 1)
    noise = _MARGIN * np.maximum(white * alike[owner], apart)
    share: Float = np.clip(1 - noise / np.maximum(explained, 1e-12), 0, 1)
    return np.where((explained > 0) & (free > 0), share, 0).astype(np.float32)


def half_of(frame: int) -> int:
    """0 or 1: of two frames in a row one goes to each. Which one, squares times the golden ratio
    tell, whose whole parts are as often odd as even along every rhythm (Weyl 1916) that exposures
    or the cameras of a rig may take turns in."""
    turn = int(_GOLDEN * (frame // 2) ** 2) % 2
    return turn ^ (frame & 1)


def steps_of(
    surface: PatternedSurface,
    pixels: Iterable[tuple[int, Covering]],
    part: slice,
    level: Float,
    seed: int,
) -> dict[str, Array]:
    """``steps`` of the texels of ``part``, with what tells of them beside it.

    pixels  of frames, each with its number
    level   (T,): the radiance of which contrasts are a share
    """
    whole = with_rows_beside(surface.texels, part, ROWS_BESIDE)
    equations = Equations.empty(whole.stop - whole.start)
    for frame, some in pixels:
        add(equations, whole.start, surface, some, half_of(frame))
    found = steps(equations, whole, surface, level[whole], seed)
    inner = slice(part.start - whole.start, part.stop - whole.start)
    return {name: array[inner].copy() for name, array in found.items()}


def with_patterns(
    surface: PatternedSurface, footprint: Float, steps_by: Callable[[Float], Mapping[str, Array]]
) -> Float:
    """The ``values`` (T, 3) of the ``surface`` with what pixels of all frames tell beside them.

    footprint  (T, 3): what a pixel covers, see ``blurred``
    steps_by   gives ``steps_of`` of all texels by their ``level``
    """
    texels, values = surface.texels, surface.values
    found = steps_by(blurred(texels, values, footprint).mean(axis=1))
    share = share_that_is_no_noise(texels, found["told"], footprint)
    sharper: Float = np.maximum(values + share[:, None] * found["step"], 0)
    return sharper
