"""What the class says, alone and together with what was measured."""

from __future__ import annotations

import pytest

from usdbrdf.material.verdict import NEUTRAL, NOTHING_KNOWN, PRIOR_ERROR, class_prior, with_prior


@pytest.mark.parametrize(
    ("class_name", "label", "wanted"),
    [
        ("wall", "", (0.6, 0.3)),
        ("", "Office-Chair 3", (0.4, 0.5)),
        # Of a compound the last word says what the thing is; the class is stronger than the name.
        ("", "paper towel", (0.9, 0.1)),
        ("", "towel paper", (0.7, 0.3)),
        ("screen", "wall", (0.02, 0.5)),
        ("thing", "mirror", (0.01, 1.0)),
        ("thing", "unheard of", NEUTRAL),
    ],
)
def test_the_class_is_found_by_its_words(class_name: str, label: str, wanted):
    assert class_prior(class_name, label) == wanted


def test_nothing_known_leaves_the_prior():
    mean, error = with_prior(0.9, NOTHING_KNOWN, 0.2, NOTHING_KNOWN)
    assert (mean, error) == (pytest.approx(0.2), pytest.approx(PRIOR_ERROR))
    # A larger error does not count against the prior.
    assert with_prior(0.9, 1.0, 0.2, NOTHING_KNOWN) == (mean, error)


def test_a_sharp_measurement_leaves_the_prior_behind():
    mean, error = with_prior(0.9, 0.01, 0.2, NOTHING_KNOWN)
    assert mean == pytest.approx(0.9, abs=0.002)
    assert error == pytest.approx(0.01, rel=0.01)
    # An error of 0 is none: 0.001 at least.
    assert with_prior(0.9, 0.0, 0.2, NOTHING_KNOWN)[1] == pytest.approx(1e-3, rel=1e-4)


def test_in_between_precisions_add():
    # A posterior of deviation s on [0, 1] held 1 / s^2 - 12 of precision from the samples.
    error = (1 / PRIOR_ERROR**2 + 1 / NOTHING_KNOWN**2) ** -0.5
    mean, combined = with_prior(0.9, error, 0.3, NOTHING_KNOWN)
    assert mean == pytest.approx(0.6)
    assert combined == pytest.approx(PRIOR_ERROR / 2**0.5)
