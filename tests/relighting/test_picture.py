"""The exposure of displayed pictures."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.files.colour import display_exposure
from usdbrdf.relighting.relight import exposure_levels


def test_the_levels_of_a_large_picture_are_few_and_tell_the_same() -> None:
    picture = np.random.default_rng(0).random((700, 500, 3), np.float32)
    few = exposure_levels(picture)
    assert len(few) <= 1 << 16
    means = picture.mean(axis=2).ravel()
    stops, expected = (np.log2(display_exposure(levels)) for levels in (few, means))
    assert stops == pytest.approx(expected, abs=0.01)
