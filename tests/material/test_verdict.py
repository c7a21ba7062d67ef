"""What is published of a fit, and how it is labelled."""

from __future__ import annotations

import math

import pytest

from usdbrdf.material.verdict import (
    MAX_PHI_ERROR,
    MAX_PSI_ERROR,
    MIN_EVIDENCE,
    NOTHING_KNOWN,
    PRIOR_ERROR,
    SOME_EVIDENCE,
    Verdict,
    verdict_on_frame,
    verdict_on_views,
    with_prior,
)

PRIOR = (0.6, 0.3)
NO_FIT = (math.nan, math.nan)


def _on_views(
    *,
    phi_error: float = 0.02,
    psi_error: float = 0.05,
    unresolved: float = 0.0,
    evidence: float = 0.8,
    seen: bool = True,
) -> Verdict:
    return verdict_on_views(
        (0.1, phi_error), (0.8, psi_error), unresolved, evidence, PRIOR, seen
    )  # fmt: skip


def _blend(value: float, error: float, of_class: float) -> tuple[float, float]:
    """With nothing unresolved: what the frames say and the prior, by their precisions."""
    return with_prior(value, error, of_class, NOTHING_KNOWN)


@pytest.mark.parametrize("evidence", [MIN_EVIDENCE, 1.0])
def test_a_measurement_is_published_as_found(evidence: float):
    found = _on_views(evidence=evidence)
    # The prior is left behind: 0.02 against 0.25.
    assert (found.phi, found.psi) == (pytest.approx(0.1, abs=0.005), pytest.approx(0.8, abs=0.025))
    assert (found.phi_error, found.psi_error) == pytest.approx((0.02, 0.05), rel=0.05)
    assert (found.phi_confidence, found.psi_confidence) == ("high", "high")
    assert found.status == "measured"


@pytest.mark.parametrize("share", [0.5, 0.9, 1.1, 1.3])
def test_each_parameter_is_judged_by_its_own_error(share: float):
    # Errors that, with the prior's precision added, come to ``share`` of the limit.
    def before(limit: float) -> float:
        precision = (share * limit) ** -2 - PRIOR_ERROR**-2 + NOTHING_KNOWN**-2
        return precision**-0.5

    wanted = "high" if share < 1 else "low"
    found = _on_views(psi_error=before(MAX_PSI_ERROR))
    assert found.psi_error == pytest.approx(share * MAX_PSI_ERROR)
    assert found.psi == pytest.approx(_blend(0.8, before(MAX_PSI_ERROR), PRIOR[1])[0])
    assert PRIOR[1] < found.psi < 0.8
    assert (found.phi_confidence, found.psi_confidence) == ("high", wanted)
    assert found.status == ("measured" if share < 1 else "prior")
    found = _on_views(phi_error=before(MAX_PHI_ERROR))
    assert found.phi_error == pytest.approx(share * MAX_PHI_ERROR)
    assert (found.phi_confidence, found.psi_confidence) == (wanted, "high")
    assert found.status == ("measured" if share < 1 else "prior")


@pytest.mark.parametrize("evidence", [SOME_EVIDENCE, MIN_EVIDENCE - 0.01])
def test_some_evidence_moves_the_prior(evidence: float):
    found = _on_views(phi_error=0.15, evidence=evidence)
    assert (found.phi, found.phi_error) == pytest.approx(_blend(0.1, 0.15, PRIOR[0]))
    assert 0.1 < found.phi < PRIOR[0]
    # However small the errors.
    assert (found.phi_confidence, found.psi_confidence) == ("low", "low")
    assert found.status == "prior"


@pytest.mark.parametrize("evidence", [SOME_EVIDENCE - 0.01, 0.0, math.nan])
def test_without_evidence_the_prior_stays(evidence: float):
    assert _on_views(evidence=evidence) == Verdict(
        phi=PRIOR[0], psi=PRIOR[1], phi_error=PRIOR_ERROR, psi_error=PRIOR_ERROR, status="prior"
    )


def test_a_highlight_as_small_as_its_footprint_is_no_measurement():
    # Some of phi may be the footprint's, or all of it.
    sharp = _on_views()
    for unresolved, confidence in ((0.03, "high"), (0.15, "low")):
        found = _on_views(unresolved=unresolved)
        assert (found.phi, found.psi) == (sharp.phi, sharp.psi)
        assert found.phi_error == pytest.approx(math.hypot(sharp.phi_error, unresolved))
        # A blurred highlight holds the same light.
        assert found.psi_error == pytest.approx(
            math.hypot(sharp.psi_error, sharp.psi / 3 * min(unresolved / 0.1, 1)), rel=0.03
        )
        assert found.phi_confidence == confidence
        assert found.status == ("measured" if confidence == "high" else "prior")


def test_what_no_frame_sees_is_unseen():
    found = verdict_on_views(NO_FIT, NO_FIT, math.nan, math.nan, PRIOR, False)
    assert (found.phi, found.psi, found.status) == (*PRIOR, "unseen")
    assert found.phi_error == found.psi_error == PRIOR_ERROR
    assert (found.phi_confidence, found.psi_confidence) == ("none", "none")
    # Seen, but by too few frames for a fit.
    assert verdict_on_views(NO_FIT, NO_FIT, math.nan, math.nan, PRIOR, True).status == "prior"


@pytest.mark.parametrize("keep", [True, False])
def test_one_frame_measures_where_it_tells_roughnesses_apart(keep: bool):
    found = verdict_on_frame((0.1, 0.02), 0.8, 0.5, PRIOR, True, keep)
    assert (found.phi, found.psi, found.phi_error, found.status) == (0.1, 0.8, 0.02, "measured")
    assert math.isnan(found.psi_error)


@pytest.mark.parametrize(
    ("flat", "evidence"), [(0.02, 0.09), (0.5 / math.sqrt(12), 0.5), (0.02, math.nan)]
)
def test_the_paper_keeps_what_it_finds_and_the_others_take_the_prior(flat: float, evidence: float):
    kept = verdict_on_frame((0.1, flat), 0.8, evidence, PRIOR, True, True)
    assert (kept.phi, kept.psi, kept.status) == (0.1, 0.8, "failed")
    prior = verdict_on_frame((0.1, flat), 0.8, evidence, PRIOR, True, False)
    assert (prior.phi, prior.psi, prior.status) == (*PRIOR, "prior")
    assert prior.phi_error == prior.psi_error == PRIOR_ERROR


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize(("seen", "status"), [(True, "prior"), (False, "unseen")])
def test_without_a_fit_there_is_nothing_to_keep(keep: bool, seen: bool, status: str):
    found = verdict_on_frame(NO_FIT, math.nan, math.nan, PRIOR, seen, keep)
    assert (found.phi, found.psi, found.status) == (*PRIOR, status)
