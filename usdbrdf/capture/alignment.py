"""Photographs of one view with several exposures, taken by hand, laid onto each other.

Bitmaps above and below a rank are compared for whole pixels, coarse to fine (Ward, "Fast, robust
image registration", 2003). For the rest the codes of one exposure are brought to those of the other
by their ranks, which no response changes, and the homography is found under which both correlate
best (Evangelidis and Psarakis, "Parametric image alignment using enhanced correlation coefficient
maximization", 2008). Whatever does not fit after that was not taken from one place, and is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from usdbrdf import calibration
from usdbrdf.capture.brackets import BRIGHT_CODE, DARK_CODE
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.model.arrays import Bool, Byte, Double, Float, Int

T = TypeVar("T", bound=np.generic)
_STILL = calibration.number("alignment.still")
_FITS = calibration.number("alignment.fits")
# How far brackets are shifted, at most, as a power of two, in pixels.
_LEVELS = 6
# Codes between which the threshold of a bitmap is chosen, and those around it that say nothing.
_CLEAR, _UNDECIDED = (16, 239), 4
# Pixels by which the parts of a shifted picture may disagree, if so many more of their bits fit.
_NEAR, _BETTER = 1.5, 0.01
# Pixels to a side of the smallest pictures that are correlated, and of the largest ones in all.
_SMALLEST, _MOST_PIXELS = 48, 1 << 22
# Steps in one size of the pictures; less than this change of the correlation ends them.
_STEPS, _LEAST = 100, 1e-6
# Share of a picture that another must show too.
_OVERLAP = 0.5
# Of the filter before the slopes are taken, in pixels.
_WINDOW = 5


class Aligned(NamedTuple):
    """A bracket in the pixels of its middle exposure.

    stack   (K, H, W, 3) uint8, 0 where the exposure says nothing
    silent  (K, H, W, 3) bool: where that is: beyond its edge, or between what clips and what not
    moved   (K, 3, 3) float64: places in the exposure, as homogeneous column and row with the first
            pixel's centre at (0, 0), of those in the middle one
    unchecked  (K,) bool: no code is clear both in the exposure and in its neighbour, so that
               nothing tells whether the camera moved between them
    """

    stack: Byte
    silent: Bool
    moved: Double
    unchecked: Bool


def aligned(stack: Byte, names: Sequence[str]) -> Aligned:
    """A bracket, (K, H, W, 3) by exposure, the longest first, laid onto its middle exposure.

    What hardly moved, or cannot be compared, stays as it is. Raises InputRefused, with ``names``,
    where an exposure does not fit onto its neighbour, and where parts of it moved by different
    amounts: something near was seen from elsewhere. EnvironmentFailure without OpenCV.
    """
    grey = stack.astype(np.float32).mean(axis=3).astype(np.uint8)
    middle = len(stack) // 2
    moved = np.broadcast_to(np.eye(3), (len(stack), 3, 3)).copy()
    unchecked = np.zeros(len(stack), np.bool_)
    for k in [*range(middle + 1, len(stack)), *range(middle - 1, -1, -1)]:
        near = k - 1 if k > middle else k + 1
        found = between(grey[near], grey[k], (names[near], names[k]))
        unchecked[k], step = found is None, np.eye(3) if found is None else found
        moved[k] = step @ moved[near]
    still = [_farthest(one, grey.shape[1:]) <= _STILL for one in moved]
    result, silent = stack.copy(), np.zeros(stack.shape, np.bool_)
    for k in range(len(stack)):
        if still[k]:
            moved[k] = np.eye(3)
        else:
            result[k], silent[k] = laid(stack[k], moved[k])
    return Aligned(result, silent, moved, unchecked)


def between(fixed: Byte, other: Byte, names: tuple[str, str]) -> Double | None:
    """(3, 3): the place in the picture ``other`` (H, W) of each one in ``fixed``, as ``Aligned``
    has it, None where no code is clear in both; raises as ``aligned`` does."""
    if _common_rank(fixed, other) is None:
        return None
    down, right = (int(n) for n in _shift(fixed, other, _LEVELS))
    found = np.array([[1.0, 0, -right], [0, 1, -down], [0, 0, 1]])
    if fixed.mean() >= other.mean():
        found = _correlated(fixed, other, found)
    else:
        back = _correlated(other, fixed, np.asarray(np.linalg.inv(found), np.float64))
        found = np.asarray(np.linalg.inv(back), np.float64)
    _refuse_misfit(fixed, other, found, names)
    return found


def laid(picture: Byte, moved: Double) -> tuple[Byte, Bool]:
    """A picture (H, W, C) at the places ``moved`` (3, 3) of its pixels, 0 where it says nothing,
    and where that is, as ``Aligned`` has it."""
    size = (3, 3, *[1] * (picture.ndim - 2))
    least = _warped(minimum_filter(picture, size), moved, near=True)
    most = _warped(maximum_filter(picture, size), moved, near=True)
    # Between a code that tells and one that does not there is none that tells.
    mixed = (least <= BRIGHT_CODE) & (most > BRIGHT_CODE)
    mixed |= (least < DARK_CODE) & (most >= DARK_CODE)
    silent = mixed | ~_inside(picture.shape, moved)
    return np.where(silent, np.uint8(0), _warped(picture, moved)), silent


def _inside(shape: Sequence[int], moved: Double) -> Bool:
    """Where all that a pixel is made of lies in the picture."""
    whole = np.zeros(shape, np.uint8)
    whole[1:-1, 1:-1] = 1
    return _warped(whole, moved, near=True) > 0


def _warped(picture: Byte, moved: Double, *, near: bool = False) -> Byte:
    """The picture at the places ``moved`` of its pixels; beyond its edge what is there."""
    import cv2

    method = cv2.INTER_NEAREST if near else cv2.INTER_CUBIC
    found = cv2.warpPerspective(
        picture, moved, picture.shape[1::-1], flags=method | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(found, np.uint8).reshape(picture.shape)


def _correlated(longer: Byte, shorter: Byte, start: Double) -> Double:
    """(3, 3) places in the shorter exposure of those in the longer; ``start`` where nothing
    correlates."""
    if find_spec("cv2") is None:
        raise EnvironmentFailure(
            "brackets: exposures are laid onto each other by OpenCV, which is not installed. "
            "Install it with: pip install 'usdbrdf[brackets]'. [environment.cv2]"
        )
    import cv2

    # What the longer exposure clips the shorter one does too then.
    brought = _codes_by_rank(shorter, longer, start)[shorter]
    telling = np.where(shorter >= DARK_CODE, np.uint8(255), np.uint8(0))
    height, width = longer.shape
    finest = 0
    while (height >> finest) * (width >> finest) > _MOST_PIXELS:
        finest += 1
    coarsest = max(finest, int(np.log2(max(min(height, width) / _SMALLEST, 1))))
    found = start
    for level in range(coarsest, finest - 1, -1):
        size = width >> level, height >> level
        one, two, told = (
            cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (longer, brought, telling)
        )
        scale = np.diag([width / size[0], height / size[1], 1.0])
        scale[:2, 2] = (np.diag(scale)[:2] - 1) / 2
        kind = cv2.MOTION_EUCLIDEAN if level > finest + 1 else cv2.MOTION_HOMOGRAPHY
        guess = np.linalg.inv(scale) @ found @ scale
        guess = (guess / guess[2, 2]).astype(np.float32)
        some = guess if kind == cv2.MOTION_HOMOGRAPHY else np.ascontiguousarray(guess[:2])
        steps = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _STEPS, _LEAST)
        try:
            _, some = cv2.findTransformECC(
                one.astype(np.float32), two.astype(np.float32), some, kind, steps,
                np.where(told == 255, np.uint8(255), np.uint8(0)), _WINDOW,
            )  # fmt: skip
        except cv2.error:  # it ran away
            return start
        guess[: len(some)] = some
        found = scale @ guess.astype(np.float64) @ np.linalg.inv(scale)
    return np.asarray(found / found[2, 2], np.float64)


def _codes_by_rank(picture: Byte, other: Byte, moved: Double) -> Float:
    """(256,) code of ``other`` that as large a share of its pixels lies below, for each code of
    ``picture``, of what both show."""
    height, width = other.shape
    right, down = (round(float(n)) for n in moved[:2, 2])
    theirs = other[max(0, -down) : height - max(0, down), max(0, -right) : width - max(0, right)]
    own = picture[max(0, down) : height + min(0, down), max(0, right) : width + min(0, right)]
    share = []
    for codes in (own, theirs):
        count = np.bincount(codes.ravel(), minlength=256)
        share.append((np.cumsum(count) - count / 2) / max(codes.size, 1))
    strictly = share[1] + 1e-9 * np.arange(256)
    return np.asarray(np.interp(share[0], strictly, np.arange(256.0)), np.float32)


def _refuse_misfit(fixed: Byte, other: Byte, moved: Double, names: tuple[str, str]) -> None:
    onto, both = _warped(other, moved), _inside(fixed.shape, moved)
    if both.mean() < _OVERLAP or _unlike(fixed, onto, both) > _FITS:
        raise InputRefused(
            f"{names[1]}: shows another view than {names[0]}, or one turned too far, so that one "
            "cannot be laid onto the other. Leave it out, or use a tripod. [brackets.moved]"
        )
    rows, columns = (n // 2 for n in fixed.shape)
    parts = [np.s_[a : a + rows, b : b + columns] for a in (0, rows) for b in (0, columns)]
    if any(both[p].mean() > _OVERLAP and _moves_on(fixed[p], onto[p]) for p in parts):
        raise InputRefused(
            f"{names[1]}: its parts have moved by different amounts against {names[0]}, which no "
            "turn of the camera does. Use a tripod, or leave it out. [brackets.moved]"
        )


def _unlike(one: Byte, other: Byte, both: Bool) -> float:
    """Share of differing bits of two pictures where both show something."""
    rank = _common_rank(one[both], other[both])
    if rank is None:
        return 0.0
    bits = [_bitmap(p, float(np.quantile(p[both], rank))) for p in (one, other)]
    return _differing((bits[0][0], bits[0][1] & both), bits[1], np.zeros(2, np.int32))


def _farthest(moved: Double, shape: Sequence[int]) -> float:
    """By how many pixels a corner of the picture moves, at most."""
    bottom, right = (float(n - 1) for n in shape)
    corners = np.array([[0, right, 0, right], [0, 0, bottom, bottom], [1, 1, 1, 1]])
    there = moved @ corners
    return float(np.hypot(*(there[:2] / there[2] - corners[:2])).max())


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
        bits = _at_rank(one, rank), _at_rank(two, rank)
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
    bits = _at_rank(fixed, rank), _at_rank(other, rank)
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


def _at_rank(picture: Byte, rank: float) -> tuple[Bool, Bool]:
    return _bitmap(picture, float(np.quantile(picture, rank)))


def _bitmap(picture: Byte, threshold: float) -> tuple[Bool, Bool]:
    """(H, W): above the threshold, and clearly above or below it."""
    return picture > threshold, np.abs(picture - threshold) > _UNDECIDED


def _differing(one: tuple[Bool, Bool], other: tuple[Bool, Bool], shift: Int) -> float:
    """Share of the decided pixels whose bits differ, ``other`` moved."""
    above, decided = _moved(other[0], shift), _moved(other[1], shift)
    both = one[1] & decided
    return float((both & (one[0] != above)).sum() / max(int(both.sum()), 1))
