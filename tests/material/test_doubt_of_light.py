"""What the errors of inferred light make of what a lobe is told."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from usdbrdf.material.doubt_of_light import error_by_doubt
from usdbrdf.material.view_model import ViewSamples
from usdbrdf.transport.brdf import DIELECTRIC

TEXELS, VIEWS, PSI, OFF = 40, 8, 0.5, 0.3


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
    samples = ViewSamples(
        texel=np.repeat(np.arange(TEXELS), VIEWS),
        frame=np.tile(np.arange(VIEWS), TEXELS),
        position=rng.uniform(0, 1, (count, 3)).astype(np.float32),
        radiance=radiance.astype(np.float32),
        noise=np.full((count, 3), 1e-3, np.float32),
        cell=0.1,
    )

    def lobe(kind: int, phi: float, seed: int, of_doubt: bool = False):
        noise = np.random.default_rng(seed).normal(1, 0.02, slope.shape).astype(np.float32)
        return np.zeros_like(slope), (doubt if of_doubt else slope * noise)

    error = error_by_doubt(SimpleNamespace(samples=samples, lobe=lobe), DIELECTRIC, 0.1, PSI, 0)
    expected = OFF * PSI if mirrored_by == "all" else 0.0
    assert error == pytest.approx(expected, abs=0.1 * OFF * PSI)
