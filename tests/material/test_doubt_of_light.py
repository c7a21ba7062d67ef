"""What the errors of inferred light make of what a lobe is told."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from usdbrdf.material.doubt_of_light import error_by_doubt
from usdbrdf.material.view_model import ViewSamples
from usdbrdf.transport.brdf import CONDUCTOR, DIELECTRIC

TEXELS, VIEWS, PSI, OFF = 40, 8, 0.5, 0.3


def _samples(radiance: np.ndarray, rng: np.random.Generator) -> ViewSamples:
    count = TEXELS * VIEWS
    return ViewSamples(
        texel=np.repeat(np.arange(TEXELS), VIEWS),
        frame=np.tile(np.arange(VIEWS), TEXELS),
        position=rng.uniform(0, 1, (count, 3)).astype(np.float32),
        radiance=radiance.astype(np.float32),
        noise=np.full((count, 3), 1e-3, np.float32),
        cell=0.1,
    )


@pytest.mark.parametrize("mirrored_by", ["none", "one ray", "all"])
def test_psi_is_doubted_as_far_as_doubted_light_tells_it(mirrored_by: str):
    """A lamp that one ray finds, and the frame does not show, tells nothing of psi."""
    rng = np.random.default_rng(0)
    count = TEXELS * VIEWS
    slope = rng.uniform(0.2, 2.0, (count, 3, 1)).astype(np.float32)
    radiance = 0.3 + PSI * slope[..., 0] + rng.normal(0, 0.01, (count, 1))
    doubt = np.zeros_like(slope)
    if mirrored_by == "one ray":
        slope[11] = 500.0
        doubt[11] = OFF * slope[11]
    elif mirrored_by == "all":
        doubt = np.float32(OFF) * slope
    samples = _samples(radiance, rng)

    def lobe(kind: int, phi: float, seed: int, of_doubt: bool = False):
        noise = np.random.default_rng(seed).normal(1, 0.02, slope.shape).astype(np.float32)
        return np.zeros_like(slope), (doubt if of_doubt else slope * noise)

    sampled, white = SimpleNamespace(samples=samples, lobe=lobe), np.ones((3, 1), np.float32)
    error = error_by_doubt(sampled, DIELECTRIC, 0.1, PSI, 0, white)
    expected = OFF * PSI if mirrored_by == "all" else 0.0
    assert error == pytest.approx(expected, abs=0.1 * OFF * PSI)


def test_a_coloured_metal_is_doubted_as_what_it_mirrors_is_weighed():
    """Of gold blue is dim: predicted as bright as red, its samples would weigh next to nothing."""
    rng = np.random.default_rng(1)
    count, tint = TEXELS * VIEWS, np.float32([[1.0], [0.5], [0.1]])
    # Red is mirrored of a lamp that is doubted, blue of walls that are seen.
    slope = rng.uniform(0.5, 2.0, (count, 3, 1)).astype(np.float32)
    slope[:, 0] *= np.where(rng.random((count, 1)) < 0.5, 20, 1)
    doubt = np.where(slope > 2.0, np.float32(OFF) * slope, np.float32(0))
    radiance = (PSI * tint * slope)[..., 0] * (1 + rng.normal(0, 0.01, (count, 1)))
    samples = _samples(radiance, rng)

    def lobe(kind: int, phi: float, seed: int, of_doubt: bool = False):
        return np.zeros_like(slope), (doubt if of_doubt else slope)

    sampled = SimpleNamespace(samples=samples, lobe=lobe)

    def error(tint: np.ndarray, slope_times: np.ndarray) -> float:
        own = SimpleNamespace(
            samples=samples, lobe=lambda *a, **k: tuple(slope_times * one for one in lobe(*a, **k))
        )
        return error_by_doubt(own, CONDUCTOR, 0.1, PSI, 0, tint)

    white = np.ones((3, 1), np.float32)
    tinted = error_by_doubt(sampled, CONDUCTOR, 0.1, PSI, 0, tint)
    # As if the light itself had that colour.
    assert tinted == pytest.approx(error(white, tint), rel=1e-5)
    assert tinted != pytest.approx(error_by_doubt(sampled, CONDUCTOR, 0.1, PSI, 0, white), rel=1e-3)
