"""What to publish of a fit: measured values, or the class prior with what the frames say."""

from __future__ import annotations

import math
from dataclasses import dataclass

from usdbrdf import calibration
from usdbrdf.material.lobe_posterior import NOTHING_KNOWN

PRIOR_ERROR = calibration.number("prior.error")
NEUTRAL = calibration.pair("prior.neutral")
_OF_WORD = calibration.pairs("prior.classes")


def class_prior(class_name: str, label: str) -> tuple[float, float]:
    """(phi, psi) for an object's class, else for its name, else a neutral dielectric."""
    for text in (class_name, label):
        words = text.lower().replace("-", "_").replace(" ", "_").split("_")
        for word in reversed(words):
            if word in _OF_WORD:
                return _OF_WORD[word]
    return NEUTRAL


def with_prior(
    value: float, error: float, prior: float, nothing_known: float
) -> tuple[float, float]:
    """(value, error) of a number in [0, 1] estimated as ``value`` with a standard deviation of
    ``error``, together with its prior. An error of ``nothing_known`` leaves the prior alone."""
    precision = max(1 / max(error, 1e-3) ** 2 - 1 / nothing_known**2, 0.0)
    of_prior = 1 / PRIOR_ERROR**2
    mean = (precision * value + of_prior * prior) / (precision + of_prior)
    return mean, (precision + of_prior) ** -0.5


MIN_EVIDENCE = calibration.number("verdict.min_evidence")
SOME_EVIDENCE = calibration.number("verdict.some_evidence")
MAX_PHI_ERROR = calibration.number("verdict.max_phi_error")
MAX_PSI_ERROR = calibration.number("verdict.max_psi_error")
_PSI_SHARE = calibration.number("verdict.footprint_in_psi")
_MAX_FLAT_PHI = calibration.number("verdict.of_frame.max_flat_phi") / math.sqrt(12)
_MIN_EVIDENCE_OF_FRAME = calibration.number("verdict.of_frame.min_evidence")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """phi, psi and their standard deviations (NaN: not known); status "measured", "prior",
    "unseen" or "failed"; confidence in either, "high", "low" or "none"."""

    phi: float
    psi: float
    phi_error: float
    psi_error: float
    status: str
    phi_confidence: str = "none"
    psi_confidence: str = "none"


def verdict_on_views(
    phi: tuple[float, float],
    psi: tuple[float, float],
    unresolved: float,
    evidence: float,
    prior: tuple[float, float],
    seen: bool,
) -> Verdict:
    """On a fit of many views. phi, psi: (value, standard deviation), NaN without a fit; unresolved,
    evidence: see LobeEstimate; prior: (phi, psi) of the class.

    Each is published as the mean of what the frames say and of the prior, weighted by their
    precisions: where the frames determine it, that is what they say. Of a highlight that is hardly
    larger than the samples' footprint they say something, but the stated error includes what the
    footprint may have done. Without evidence the prior stands alone.
    """
    published, confidence = [], []
    of_psi = _PSI_SHARE * psi[0] * min(unresolved / max(phi[0], 0.01), 1.0)
    for (value, error), of_class, limit, blurred in zip(
        (phi, psi), prior, (MAX_PHI_ERROR, MAX_PSI_ERROR), (unresolved, of_psi), strict=True
    ):
        if evidence >= SOME_EVIDENCE:
            value, error = with_prior(value, error, of_class, NOTHING_KNOWN)
            error = min(math.hypot(error, blurred), NOTHING_KNOWN)
            published.append((value, error))
            sure = evidence >= MIN_EVIDENCE and error <= limit
            confidence.append("high" if sure else "low")
        else:
            published.append((of_class, PRIOR_ERROR))
            confidence.append("none")
    measured = confidence == ["high", "high"]
    return Verdict(
        phi=published[0][0],
        psi=published[1][0],
        phi_error=published[0][1],
        psi_error=published[1][1],
        status="measured" if measured else "prior" if seen else "unseen",
        phi_confidence=confidence[0],
        psi_confidence=confidence[1],
    )


def verdict_on_frame(
    phi: tuple[float, float],
    psi: float,
    evidence: float,
    prior: tuple[float, float],
    seen: bool,
    keep: bool,
) -> Verdict:
    """On a fit of one frame. phi: (value, standard deviation of the flat stretch), NaN without a
    fit; keep: publish the minimum even where it is no measurement."""
    fitted = math.isfinite(phi[0])
    measured = fitted and evidence >= _MIN_EVIDENCE_OF_FRAME and phi[1] <= _MAX_FLAT_PHI
    if measured or (fitted and keep):
        status = "measured" if measured else "failed"
        return Verdict(
            phi=phi[0],
            psi=psi,
            phi_error=phi[1],
            psi_error=math.nan,
            status=status,
            phi_confidence="low",
            psi_confidence="low",
        )
    return Verdict(
        phi=prior[0],
        psi=prior[1],
        phi_error=PRIOR_ERROR,
        psi_error=PRIOR_ERROR,
        status="prior" if seen else "unseen",
    )
