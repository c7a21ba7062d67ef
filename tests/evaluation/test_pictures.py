"""Colours of errors."""

from __future__ import annotations

import numpy as np

from usdbrdf.evaluation.report import change, magma, sheet


def test_magma_runs_from_black_to_pale_yellow():
    error = np.array([[0.0, 0.5, 1.0, 7.0]], np.float32)
    colours = magma(error, np.ones(error.shape, bool))[0]
    assert colours[0].max() <= 4
    assert (colours[1] == (181, 54, 122)).all()
    assert (colours[2] == colours[3]).all()
    assert colours[2].min() > 180
    # Brighter all the way, so that it can be read without colours.
    steps = (
        magma(np.linspace(0, 1, 33, dtype=np.float32)[None], np.ones((1, 33), bool))[0]
        .astype(int)
        .sum(axis=1)
    )
    assert (np.diff(steps) > 0).all()


def test_what_is_not_counted_is_grey():
    counted = np.array([[True, False]])
    assert (magma(np.ones((1, 2), np.float32), counted)[0, 1] == 96).all()


def test_a_smaller_error_is_blue_and_a_larger_one_orange():
    before, after = np.full((1, 3), 0.3, np.float32), np.array([[0.1, 0.3, 0.5]], np.float32)
    smaller, same, larger = change(before, after, np.ones(before.shape, bool))[0].astype(int)
    assert smaller[2] > 200 > smaller[0]
    assert (same == 0).all()
    assert larger[0] > 200 > larger[2]


def test_a_sheet_has_white_gaps_and_room_for_short_rows():
    dark = np.zeros((3, 5, 3), np.uint8)
    whole = sheet([[dark, dark], [dark]])
    assert whole.shape == (10, 14, 3)
    assert (whole[:3, :5] == 0).all()
    assert (whole[:, 5:9] == 255).all()
    assert (whole[7:, 9:] == 255).all()
