"""The BSDF against equations 3 to 6 in plain NumPy, and its samples against its density."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.physics.brdf import f_nd
from usdbrdf.relighting import lobe_plugin
from usdbrdf.relighting.render import VARIANTS, mitsuba_variant
from usdbrdf.transport.brdf import BECKMANN, CONDUCTOR, DIELECTRIC, PAPER, reflectance
from usdbrdf.transport.let_through import share_let_through, share_seen

_CASES = [(0.05, 0.9, 0.1), (0.3, 0.5, 0.4), (0.9, 0.1, 0.7)]


@pytest.fixture
def mi() -> Any:
    module = mitsuba_variant()
    if module.variant() != VARIANTS[0]:
        pytest.skip("no usable LLVM library")
    lobe_plugin.register(module)
    return module


def _plugin(phi: float, psi: float, rho: float) -> dict[str, Any]:
    return {
        "type": lobe_plugin.NAME,
        "diffuse": {"type": "rgb", "value": rho},
        "f0": {"type": "rgb", "value": 0.08 * psi},
        "phi": {"type": "uniform", "value": phi},
    }


@pytest.mark.parametrize(("phi", "psi", "rho"), _CASES)
def test_value(mi: Any, phi: float, psi: float, rho: float) -> None:
    import drjit as dr

    rng = np.random.default_rng(1)
    wi = np.array([0.6, 0.0, 0.8])
    wo = rng.normal(size=(5000, 3)) * np.repeat([1.0, 0.1], 2500)[:, None]
    wo[2500:] += [-0.6, 0, 0.8]  # half of them about the mirror direction
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    si = dr.zeros(mi.SurfaceInteraction3f, len(wo))
    si.wi = mi.Vector3f(wi)
    bsdf = mi.load_dict(_plugin(phi, psi, rho))
    found = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo.T)))[0]
    normal = np.array([0.0, 0, 1])
    expected = (rho / np.pi + f_nd(normal, wo, wi[None], phi, psi)) * np.maximum(wo[:, 2], 0)
    assert found == pytest.approx(expected, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("kinds", "facets"), [((DIELECTRIC, CONDUCTOR), "ggx"), ((BECKMANN,), "beckmann")]
)
def test_value_of_the_lobe_of_renderers(mi: Any, kinds: tuple[int, ...], facets: str) -> None:
    # That of Mitsuba's own rough conductor, but for Fresnel's term: with one that is 1.
    import drjit as dr

    rng = np.random.default_rng(1)
    wi = np.array([0.6, 0.0, 0.8])
    wo = rng.normal(size=(5000, 3)) * 0.2 + wi * [-1, 1, 1]
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    si = dr.zeros(mi.SurfaceInteraction3f, len(wo))
    si.wi = mi.Vector3f(wi)
    half = wo + wi
    cosine = (half / np.linalg.norm(half, axis=1, keepdims=True)) @ wi
    theirs = {
        "type": "roughconductor", "distribution": facets, "material": "none", "alpha": 0.3,
        "sample_visible": True,
    }  # fmt: skip
    other = np.array(mi.load_dict(theirs).eval(mi.BSDFContext(), si, mi.Vector3f(wo.T)))[0]
    for kind in kinds:
        bsdf = mi.load_dict(_plugin(0.3, 0.5, 0.0) | {"lobe": kind})
        found = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo.T)))[0]
        base, rise = reflectance(cosine, kind)
        assert found == pytest.approx(other * (base + 0.04 * rise), rel=2e-3, abs=1e-5)


@pytest.mark.parametrize("phi", [0.02, 0.3])
def test_diffuse_light_passes_the_surface_of_a_dielectric_twice(mi: Any, phi: float) -> None:
    import drjit as dr

    psi, rho, angles = 0.6, 0.4, np.radians([5.0, 40.0, 70.0, 85.0])
    cos_i, cos_o = (grid.ravel() for grid in np.meshgrid(np.cos(angles), np.cos(angles)))
    zero, sine = np.zeros_like(cos_i), np.sqrt(1 - cos_o**2)
    si = dr.zeros(mi.SurfaceInteraction3f, len(cos_i))
    si.wi = mi.Vector3f(np.sqrt(1 - cos_i**2), zero, cos_i)

    def value(colour: float) -> np.ndarray:
        bsdf = mi.load_dict(_plugin(phi, psi, colour) | {"lobe": DIELECTRIC})
        found = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(zero, sine, cos_o))
        return np.array(found)[0] / cos_o

    one = np.ones(len(cos_i), np.float32)
    through = [share_let_through(phi * one, psi * one, cosine) for cosine in (cos_i, cos_o)]
    seen = share_seen(np.array([phi]), np.array([psi]))
    below = value(rho) - value(0.0)
    assert below == pytest.approx(rho / np.pi * through[0] * through[1] / seen, rel=2e-3)


@pytest.mark.parametrize("f0", [0.3, 0.85, 1.0])
def test_what_is_partly_a_metal_scatters_no_more_than_its_colour(mi: Any, f0: float) -> None:
    import drjit as dr

    cosines = np.cos(np.radians([5.0, 45.0, 75.0, 85.0]))
    cos_i, cos_o = (grid.ravel() for grid in np.meshgrid(cosines, cosines))
    zero, sine = np.zeros_like(cos_i), np.sqrt(1 - cos_o**2)
    si = dr.zeros(mi.SurfaceInteraction3f, len(cos_i))
    si.wi = mi.Vector3f(np.sqrt(1 - cos_i**2), zero, cos_i)

    def value(colour: float) -> np.ndarray:
        bsdf = _plugin(0.2, f0 / 0.08, colour) | {"lobe": DIELECTRIC}
        found = mi.load_dict(bsdf).eval(mi.BSDFContext(), si, mi.Vector3f(zero, sine, cos_o))
        return np.array(found)[0] / cos_o

    below = (value(0.1) - value(0.0)) * np.pi / 0.1
    assert (below > 0).all()
    assert below.max() < 1.2


@pytest.mark.parametrize("kind", [PAPER, BECKMANN])
@pytest.mark.parametrize(("phi", "psi", "rho"), _CASES[1:])
def test_samples_follow_the_density(mi: Any, phi: float, psi: float, rho: float, kind: int) -> None:
    properties = _plugin(phi, psi, rho) | {"lobe": kind}
    sample, density = mi.chi2.BSDFAdapter(lobe_plugin.NAME, properties, wi=[0.6, 0.0, 0.8])
    chi2 = mi.chi2.ChiSquareTest(
        mi.chi2.SphericalDomain(), sample, density, sample_dim=3, res=101, ires=8
    )
    assert chi2.run(significance_level=0.001)


@pytest.mark.parametrize("kind", [PAPER, DIELECTRIC, BECKMANN])
def test_lobes_of_many_objects_share_their_code(mi: Any, kind: int) -> None:
    """Else what has to be compiled grows with the objects."""
    import drjit as dr

    def operations(count: int) -> int:
        scene: dict[str, Any] = {"type": "scene", "light": {"type": "constant"}}
        for i in range(count):
            bsdf = {**_plugin(0.1 + 0.05 * i, 0.5, 0.3), "lobe": kind}
            scene[f"ball_{i}"] = {"type": "sphere", "center": [2.0 * i, 0.0, 0.0], "bsdf": bsdf}
        film = {"type": "hdrfilm", "width": 4, "height": 4}
        sensor = mi.load_dict({"type": "perspective", "film": film})
        integrator = mi.load_dict({"type": "path", "max_depth": 3})
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            image = mi.render(
                mi.load_dict(scene, optimize=False), sensor=sensor, integrator=integrator, spp=1
            )
            dr.eval(image)
            dr.sync_thread()
            return max(kernel.get("operation_count", 0) for kernel in dr.kernel_history())

    assert operations(2) == operations(6) > 0
