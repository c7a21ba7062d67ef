"""Which texture coordinates of an input may hold measurements, and which are replaced."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.geometry.unwrap import atlas_side

TEXEL = 0.05
# Two triangles of a square of 1 x 1, and the same again one metre above.
SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1)], np.float32).reshape(2, 3, 2)
FLOOR = np.concatenate([SQUARE, np.zeros((2, 3, 1), np.float32)], axis=2)
FLOORS = np.concatenate([FLOOR, FLOOR + np.float32([0, 0, 1])])


def placed(x: float, y: float, size: float) -> np.ndarray:
    return SQUARE * np.float32(size) + np.float32([x, y])


@pytest.mark.parametrize(
    ("uv", "side"),
    [
        (placed(0, 0, 1), 20),
        (placed(0.25, 0.25, 0.5), 40),
        (placed(0, 0, 1)[..., ::-1], 20),  # mirrored
        (placed(0, 0, 1) * np.float32([1, 0.6]), 26),  # a little stretched
    ],
)
def test_fit(uv, side):
    assert atlas_side(uv, FLOOR, TEXEL) == side


def test_two_charts_with_room_between_are_fit():
    uv = np.concatenate([placed(0, 0, 0.45), placed(0.55, 0.55, 0.45)])
    assert atlas_side(uv, FLOORS, TEXEL) == 45


@pytest.mark.parametrize(
    "uv",
    [
        np.concatenate([placed(0, 0, 0.5), placed(0, 0, 0.5)]),
        np.concatenate([placed(0, 0, 0.5), placed(0.25, 0.25, 0.5)]),
        np.concatenate([placed(0, 0, 0.48), placed(0.5, 0, 0.48)]),
        np.concatenate([placed(0, 0, 0.5), placed(0.5, 0, 0.5)]),
        np.concatenate([placed(0, 0, 0.1), placed(0.2, 0.2, 0.8)]),
        np.concatenate([placed(0, 0, 0.45), placed(0.6, 0.6, 0.45)]),
        np.concatenate([placed(0, 0, 0.45), placed(0.55, 0.55, 0.45) * np.float32(np.nan)]),
        np.concatenate([placed(0, 0, 0.45), placed(0.55, 0.55, 0.0)]),
        np.concatenate([placed(0, 0, 0.45), placed(0.55, 0.55, 0.45)]) * np.float32([1, 0.1]),
    ],
    ids=[
        "one on the other", "overlapping", "one texel apart", "side by side", "uneven",
        "outside", "not a number", "without area", "stretched",
    ],
)  # fmt: skip
def test_unfit(uv):
    assert atlas_side(uv, FLOORS, TEXEL) is None


def test_a_sheet_folded_onto_itself_is_unfit():
    """Neighbours on the surface and in the atlas, yet in one place of it."""
    folded = SQUARE.copy()
    folded[1, 2] = (1, 0.1)
    assert atlas_side(folded, FLOOR, TEXEL) is None


def test_an_atlas_that_would_be_too_large_is_unfit():
    assert atlas_side(placed(0, 0, 1), FLOOR, 1e-5) is None
