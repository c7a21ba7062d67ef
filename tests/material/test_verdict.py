"""What is published of a fit, and how it is labelled."""

from __future__ import annotations

import math

import numpy as np
import pytest

from usdbrdf.material.verdict import (
    MAX_PHI_ERROR,
    MAX_PSI_ERROR,
    MODEL_DISCREPANCY,
    MOST_CONTRADICTED,
    MOST_OF_MEASURED,
    NEUTRAL,
    NOTHING_KNOWN,
    SOME_EVIDENCE,
    UNASKED,
    LobeEstimate,
    _deviation,
    _quantiles,
    _vertex,
    averaged,
    least_costs,
    lobe_from_costs,
    verdict_on_frame,
    verdict_on_metal,
    verdict_on_views,
)


def _lobe(**numbers: float) -> LobeEstimate:
    sharp = LobeEstimate(
        phi=0.1, psi=0.8, phi_error=0.02, psi_error=0.05, unresolved=0.0, cost=1.0, evidence=1.0,
        phi_median=0.3, psi_median=0.6, psi_upper=0.9,
    )  # fmt: skip
    return sharp._replace(**numbers)


# Of a phi of 0.1, by what the model of lobes lacks.
LACKING = (0.05 * 0.1, 0.005)


@pytest.mark.parametrize("phi", [0.0, 0.2])
def test_many_samples_do_not_make_phi_surer_than_the_model_of_lobes_is(phi: float):
    """Of a floor phi was known to 0.001 by its samples, and off by 0.011."""
    found = verdict_on_views(_lobe(phi=phi, phi_error=1e-4), True)
    assert found.phi_error == pytest.approx(math.hypot(0.05 * phi, 0.005), rel=1e-3)


@pytest.mark.parametrize("evidence", [SOME_EVIDENCE, 1.0])
def test_a_measurement_is_published_as_found(evidence: float):
    found = verdict_on_views(_lobe(evidence=evidence), True)
    assert (found.phi, found.psi, found.psi_error) == (0.1, 0.8, 0.05)
    assert found.phi_error == pytest.approx(math.hypot(0.02, *LACKING))
    assert (found.phi_confidence, found.psi_confidence) == ("high", "high")
    assert (found.status, found.psi_upper) == ("measured", 0.9)


@pytest.mark.parametrize("psi", [0.98, 1.0])
def test_psi_at_the_end_of_its_range_is_a_bound_and_no_measurement(psi: float):
    found = verdict_on_views(_lobe(psi=psi, psi_median=0.95), True)
    assert found.psi == (psi if psi < 1 else 0.95)
    assert (found.phi, found.phi_confidence) == (0.1, "high")
    assert found.psi_confidence == ("high" if psi < 1 else "low")
    assert found.status == ("measured" if psi < 1 else "undetermined")


@pytest.mark.parametrize("share", [0.9, 1.1])
@pytest.mark.parametrize("sure", [False, True])
def test_what_views_contradict_is_no_measurement(share: float, sure: bool):
    """Of what has no lobe anyway, more of it is needed to say that it is seen through."""
    most = MOST_OF_MEASURED if sure else MOST_CONTRADICTED
    psi_error = (0.5 if sure else 1.1) * MAX_PSI_ERROR
    given = _lobe(contradiction=share * most, psi_error=psi_error, psi_median=0.8)
    found = verdict_on_views(given, True)
    assert found.status == ("measured" if share < 1 and sure else "undetermined")
    if share > 1:
        # What shows is what comes nearest to the views.
        assert (found.phi, found.psi) == (0.1, 0.8)
        assert (found.phi_confidence, found.psi_confidence) == ("none", "none")
        assert found.contradiction == share * most
    else:
        assert math.isnan(found.contradiction)


@pytest.mark.parametrize("share", [0.5, 0.9, 1.1, 1.3])
def test_each_parameter_is_judged_by_its_own_error(share: float):
    wanted = "high" if share < 1 else "low"
    found = verdict_on_views(_lobe(psi_error=share * MAX_PSI_ERROR), True)
    # Where psi is not determined its median stands for it.
    assert (found.phi, found.psi) == (0.1, 0.8 if share < 1 else 0.6)
    assert (found.phi_confidence, found.psi_confidence) == ("high", wanted)
    assert found.status == ("measured" if share < 1 else "undetermined")
    found = verdict_on_views(_lobe(phi_error=share * MAX_PHI_ERROR), True)
    assert (found.phi, found.psi) == (0.1 if share < 1 else 0.3, 0.8)
    assert (found.phi_confidence, found.psi_confidence) == (wanted, "high")
    assert found.status == ("measured" if share < 1 else "undetermined")


@pytest.mark.fault("L3")
@pytest.mark.parametrize("evidence", [0.0, 0.9 * SOME_EVIDENCE])
def test_without_a_highlight_what_remains_likely_is_published(evidence: float):
    found = verdict_on_views(_lobe(evidence=evidence, psi_median=0.05, psi_upper=0.2), True)
    assert (found.phi, found.psi, found.psi_upper) == (0.3, 0.05, 0.2)
    # However small the errors.
    assert (found.phi_confidence, found.psi_confidence) == ("none", "none")
    assert (found.status, found.model) == ("bounded", "dielectric")


@pytest.mark.parametrize(
    ("numbers", "seen", "status", "model"),
    [
        ({"psi_median": 0.0, "psi_upper": 0.49}, True, "bounded", "diffuse"),
        ({"psi_median": 0.0, "psi_upper": 0.51}, True, "undetermined", "diffuse"),
        ({"psi_median": 0.45, "psi_upper": 0.9}, True, "undetermined", "dielectric"),
        ({"psi_median": 0.1, "psi_upper": 0.2}, False, "unseen", "dielectric"),
        ({"psi_median": 0.1, "psi_upper": 0.2, "contradiction": 9.0}, True, "undetermined", None),
    ],
)
def test_what_is_not_measured_is_bounded_where_psi_lies_in_the_lower_half(
    numbers, seen, status, model
):
    found = verdict_on_views(_lobe(evidence=0.0)._replace(**numbers), seen)
    assert (found.status, found.model) == (status, model or found.model)


def test_no_highlight_where_one_would_show_bounds_psi():
    # A cost that a lobe of any roughness but the largest raises by 100 for psi = 1.
    phis = np.linspace(0, 1, 21)
    seen = 100 * (1 - phis**4)
    terms = np.stack([np.ones(21), np.zeros(21), seen], axis=1)
    found = lobe_from_costs(phis, terms, without=1.0, noisy=1.0, freedom=1, blur=0.0)
    assert found.evidence == 0
    assert found.psi_median < 0.15
    assert found.psi_median < found.psi_upper < 0.85
    # Where nothing was asked nothing is known, and no lobe is as likely as one.
    terms[:, 2] = 0
    found = lobe_from_costs(phis, terms, without=1.0, noisy=1.0, freedom=1, blur=0.0)
    assert found.psi_median < 0.03
    assert found.psi_upper == pytest.approx(0.95, abs=0.01)
    assert found.phi_median == pytest.approx(0.5, abs=0.03)


def test_the_median_of_psi_leaves_room_for_there_being_no_lobe():
    # A lobe of psi = 0.8 is some times as likely as none; that of the rest falls off by distance.
    phis = np.linspace(0, 1, 21)
    gain = 2 * np.log(20.0)
    terms = np.tile([gain, gain / 0.8, gain / 0.8**2], (21, 1))
    found = lobe_from_costs(phis, terms, without=gain, noisy=0.0, freedom=1, blur=0.0)
    psi = np.linspace(0, 1, 201)
    density = np.exp(-0.5 * gain * (psi / 0.8 - 1) ** 2)
    none = np.exp(-0.5 * gain) / (np.exp(-0.5 * gain) + density.mean())
    below = none + (1 - none) * np.cumsum(density) / density.sum()
    assert 0.05 < none < 0.3
    assert found.psi_median == pytest.approx(psi[np.searchsorted(below, 0.5)], abs=0.01)
    assert found.psi_median < psi[np.searchsorted(np.cumsum(density) / density.sum(), 0.5)] - 0.01


def test_a_cost_that_noise_of_the_rays_makes_negative_is_no_more_than_all_explained():
    phis = np.linspace(0, 1, 11)
    terms = np.tile([100.0, 150.0, 200.0], (11, 1))
    terms[3, 0] = 90.0  # cost(psi) = 90 - 300 psi + 200 psi^2 < 0 from psi = 0.42 on
    found = lobe_from_costs(phis, terms, without=100.0, noisy=50.0, freedom=100, blur=0.01)
    assert found.cost < 0
    assert found.evidence == 1
    verdict = verdict_on_views(found, True)
    assert verdict.status == "undetermined"  # what is nothing but noise is no measurement
    assert np.isfinite([verdict.phi_error, verdict.psi_error]).all()


def test_a_highlight_as_small_as_its_footprint_is_no_measurement():
    # Some of phi may be the footprint's, or all of it.
    for unresolved, confidence in ((0.03, "high"), (0.15, "low")):
        found = verdict_on_views(_lobe(unresolved=unresolved), True)
        assert found.phi_error == pytest.approx(math.hypot(0.02, unresolved, *LACKING))
        # A blurred highlight holds the same light.
        assert found.psi_error == pytest.approx(
            math.hypot(0.05, 0.08 * min(unresolved / 0.1, 1)), rel=0.03
        )
        assert found.phi_confidence == confidence


@pytest.mark.parametrize("phi", [0.0, 0.01, 0.04])
def test_of_a_mirror_the_footprint_counts_as_against_a_hundredth_of_a_radian(phi: float):
    def of_psi(unresolved: float) -> float:
        found = verdict_on_views(_lobe(phi=phi, psi_error=0.0, unresolved=unresolved), True)
        return found.psi_error

    assert of_psi(0.0) == 0
    for share in (0.2, 0.5, 1.0):
        assert of_psi(share * max(phi, 0.01)) == pytest.approx(share * of_psi(1.0))


@pytest.mark.parametrize("share", [0.45, 0.55])
def test_a_lobe_within_twice_its_error_of_none_is_no_measurement(share: float):
    # In a stairwell by others a lobe of 0.5 came out as 0.04 +- 0.03.
    found = verdict_on_views(_lobe(psi=0.1, psi_error=share * 0.1), True)
    assert found.status == ("measured" if share < 0.5 else "undetermined")


@pytest.mark.fault("L2")
def test_what_no_frame_sees_is_unseen():
    found = verdict_on_views(None, False)
    assert (found.phi, found.psi, found.psi_upper, found.status) == (0.5, 0.0, 1.0, "unseen")
    assert (found.phi_error, found.psi_error) == pytest.approx((NOTHING_KNOWN, UNASKED))
    assert (found.phi_confidence, found.psi_confidence) == ("none", "none")
    # Seen, but by too few frames for a fit.
    assert verdict_on_views(None, True).status == "undetermined"


@pytest.mark.fault("L3")
@pytest.mark.parametrize("keep", [True, False])
def test_one_frame_measures_where_it_tells_roughnesses_apart(keep: bool):
    found = verdict_on_frame((0.1, 0.02), 0.8, 0.5, True, keep)
    assert (found.phi, found.psi, found.phi_error, found.status) == (0.1, 0.8, 0.02, "measured")
    assert math.isnan(found.psi_error)


@pytest.mark.parametrize(
    ("flat", "evidence"), [(0.02, 0.09), (0.5 / math.sqrt(12), 0.5), (0.02, math.nan)]
)
def test_the_paper_keeps_what_it_finds_and_the_others_know_nothing(flat: float, evidence: float):
    kept = verdict_on_frame((0.1, flat), 0.8, evidence, True, True)
    assert (kept.phi, kept.psi, kept.status) == (0.1, 0.8, "failed")
    prior = verdict_on_frame((0.1, flat), 0.8, evidence, True, False)
    assert (prior.phi, prior.psi, prior.status) == (*NEUTRAL, "undetermined")
    assert (prior.phi_error, prior.psi_error) == pytest.approx((NOTHING_KNOWN, UNASKED))


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize(("seen", "status"), [(True, "undetermined"), (False, "unseen")])
def test_without_a_fit_there_is_nothing_to_keep(keep: bool, seen: bool, status: str):
    found = verdict_on_frame((math.nan, math.nan), math.nan, math.nan, seen, keep)
    assert (found.phi, found.psi, found.status) == (*NEUTRAL, status)


def test_one_frame_is_sure_of_nothing_of_a_metal():
    f0 = (0.9, 0.6, 0.3)
    many, one = (verdict_on_metal(0.2, f0, 1e-3, error) for error in (1e-3, math.nan))
    assert (many.status, many.phi_confidence, many.psi_confidence) == ("measured", "high", "high")
    assert (one.status, one.phi_confidence, one.psi_confidence) == ("undetermined", "low", "low")


def test_the_least_cost_lies_at_the_vertex_of_a_parabola():
    """Of roughnesses that are unevenly far from each other, of any scale of the cost."""
    phis = np.array([0.0, 0.1, 0.25, 0.3, 0.6, 1.0])
    for vertex in (0.12, 0.2, 0.28, 0.33, 0.52):
        assert _vertex(phis, 4 + 7 * (phis - vertex) ** 2) == pytest.approx(vertex)
    # None at either end, nor where neighbours do not rise.
    assert _vertex(phis, 1 + phis) == 0
    assert _vertex(phis, 2 - phis) == 1
    assert _vertex(phis, np.ones(6)) == 0
    assert _vertex(phis, np.array([3.0, 1, 1, 1, 2, 3])) == pytest.approx(0.175, abs=0.076)
    # Never beyond a neighbour.
    steep = np.array([1e6, 1.0, 1.0 + 1e-9, 2, 3, 4])
    assert 0.1 <= _vertex(phis, steep) <= 0.25


def test_quantiles_are_of_the_middle_of_what_each_value_stands_for():
    values = np.array([0.0, 1, 2, 3])
    even = np.full(4, 0.25)
    assert _quantiles(even, values, (0.5, 0.125, 0.875)) == pytest.approx((1.5, 0, 3))
    assert _quantiles(np.array([0, 0, 1.0, 0]), values, (0.5,)) == pytest.approx((2,))
    assert _quantiles(np.array([0.5, 0, 0, 0.5]), values, (0.05, 0.95)) == pytest.approx((0, 3))


def test_a_deviation_is_about_what_is_asked():
    density, values = np.array([0.25, 0.5, 0.25]), np.array([0.2, 0.4, 0.6])
    assert _deviation(density, values, 0.4) == pytest.approx(0.2 / math.sqrt(2))
    assert _deviation(density, values, 0.5) == pytest.approx(math.sqrt(0.02 + 0.01))


def test_psi_of_the_least_cost_is_the_ratio_of_its_terms_between_none_and_all():
    # c0, c1, c2 of c0 - 2 psi c1 + psi^2 c2.
    terms = np.array([[5.0, 1.0, 4.0], [5.0, 6.0, 4.0], [5.0, -1.0, 4.0], [5.0, 0.0, 0.0]])
    psi, cost, square = least_costs(terms, 5.0)
    assert psi.tolist() == [0.25, 1, 0, 0]
    assert cost == pytest.approx([5 - 0.25, 5 - 12 + 4, 5, 5])
    assert square == pytest.approx([4, 4, 4, 5e-12])
    assert least_costs(terms, 0.1)[2][3] == pytest.approx(1e-12)


def test_models_that_fit_alike_are_averaged_and_what_they_differ_by_is_an_error():
    """One with a weight of a quarter that finds 0.4 more: sqrt(3 / 16) of that, beside its own."""
    one = LobeEstimate(
        phi=0.2, psi=0.3, phi_error=0.06, psi_error=0.03, unresolved=0.02, cost=2.0, evidence=0.6,
        of_rays=(0.01, 0.02), phi_median=0.25, psi_median=0.35, psi_upper=0.5,
    )  # fmt: skip
    other = one._replace(
        phi=0.3, psi=0.34, phi_error=0.02, unresolved=0.1, of_rays=(0.05, 0.1), psi_upper=0.9
    )
    found = averaged([one, other], 100, [3, 1])
    assert found.phi == pytest.approx(0.225)
    assert found.psi == pytest.approx(0.31)
    phi_error = math.sqrt((3 * 0.06**2 + 0.02**2) / 4 + 3 / 16 * 0.1**2)
    assert found.phi_error == pytest.approx(phi_error)
    assert found.psi_error == pytest.approx(math.sqrt(0.03**2 + 3 / 16 * 0.04**2))
    assert found.unresolved == pytest.approx(0.04)
    assert found.psi_upper == pytest.approx(0.6)
    assert (found.phi_median, found.psi_median) == pytest.approx((0.25, 0.35))
    assert found.of_rays == pytest.approx((0.02, 0.04))
    # Far apart nothing is known, and no less than that.
    apart = [one._replace(phi=phi, phi_error=0.2) for phi in (0.0, 1.0)]
    assert averaged(apart, 100, [1, 1]).phi_error == NOTHING_KNOWN
    # A cost that is larger by twice the unit, in all, counts e times less; the best one's stands.
    unit = max(1.0, MODEL_DISCREPANCY * 200)
    worse = other._replace(cost=2.0 + 2 * unit / 100, evidence=0.1)
    told = averaged([worse, one], 100, [1, 1])
    assert told.phi == pytest.approx((0.2 * math.e + 0.3) / (math.e + 1))
    assert (told.cost, told.evidence) == (2.0, 0.6)
    # Of less than one degree of freedom there is none.
    assert averaged([worse, one], 0, [1, 1]).phi == pytest.approx(
        (0.2 + 0.3 * math.exp(-unit / 100)) / (1 + math.exp(-unit / 100))
    )
