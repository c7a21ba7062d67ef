"""FLIP in its child process."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.errors import UsdBrdfError
from usdbrdf.evaluation.metrics import Pair, flip_in_child, flip_maps

RANDOM = np.random.default_rng(3).random((24, 32, 3)).astype(np.float32)


def test_equal_pictures_do_not_differ_and_black_from_white_does():
    black, white = np.zeros((9, 7, 3), np.float32), np.ones((9, 7, 3), np.float32)
    same, most = flip_maps([Pair(RANDOM, RANDOM), Pair(black, white)], "a test")
    assert same.shape == (24, 32)
    assert (same == 0).all()
    assert most.shape == (9, 7)
    # FLIP of black and white is known: 0.9725 without edges nearby.
    assert most[4, 3] == pytest.approx(0.9725, abs=0.02)


def test_no_pictures_start_no_child():
    assert flip_maps([], "nothing") == []


def test_the_child_refuses_what_the_package_would_misread():
    # A fourth channel gives a wrong number there, without a word.
    with_alpha = np.concatenate([RANDOM, RANDOM[..., :1]], axis=2)
    with pytest.raises(UsdBrdfError, match=r"\(24, 32, 4\), not \(H, W, 3\).*\[evaluate.flip\]"):
        flip_maps([Pair(RANDOM, RANDOM), Pair(with_alpha, with_alpha)], "a test")


@pytest.mark.parametrize(
    ("test", "said"),
    [
        (RANDOM[1:], r"shapes \(24, 32, 3\) and \(23, 32, 3\)"),
        (RANDOM * np.nan, "not finite"),
        (RANDOM + 1, r"outside \[0, 1\]"),
        (-RANDOM, r"outside \[0, 1\]"),
    ],
)
def test_each_check(test, said):
    with pytest.raises(UsdBrdfError, match=said):
        flip_in_child({"reference-0": RANDOM, "test-0": test}, {"count": 1})
