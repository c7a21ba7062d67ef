"""The exposure of displayed pictures."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.relighting.relight import automatic_exposure, exposure_levels


def test_the_levels_of_a_large_picture_are_few_and_tell_the_same() -> None:
    picture = np.random.default_rng(0).random((700, 500, 3), np.float32)
    few = exposure_levels(picture)
    assert len(few) <= 1 << 16
    means = picture.mean(axis=2).ravel()
    assert automatic_exposure([few]) == pytest.approx(automatic_exposure([means]), abs=0.01)
