"""Radiance in another unit is the same capture: colours stay, and what shines scales."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.scenes import make_capture, poses_down_and_up
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import read_fit

OPTIONS = usdbrdf.ConvertOptions(
    texture=usdbrdf.TextureOptions(texel_size=0.2),
    shade=usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64)),
    fit=usdbrdf.FitOptions(max_pixels=60),
)


def _converted(folder: Path, unit: float) -> tuple[AssetMaps, np.ndarray]:
    """The asset's maps and each object's phi and psi."""
    made = make_capture(
        folder / "scan", poses=poses_down_and_up(6, 4), noise=0.02, subdivisions=2, unit=unit
    )
    usdbrdf.convert(made.folder, folder / "asset", OPTIONS)
    maps = AssetMaps(open_measured(Asset.at(folder / "asset")))
    fits = [read_fit(maps.stage, obj.prim_path) for obj in maps.scene.objects]
    return maps, np.array([(fit.phi, fit.psi) for fit in fits])


@pytest.fixture(scope="module")
def usual(tmp_path_factory) -> tuple[AssetMaps, np.ndarray]:
    return _converted(tmp_path_factory.mktemp("usual"), 1.0)


@pytest.mark.parametrize("unit", [1e5, 1e-7])
def test_results_scale_with_the_unit_of_radiance(usual, tmp_path, unit):
    maps, fits = usual
    other, other_fits = _converted(tmp_path, unit)
    np.testing.assert_allclose(other_fits, fits, rtol=0.01)
    for aov, scale in {"lit": unit, "irradiance": unit, "albedo": 1, "base_color": 1}.items():
        np.testing.assert_allclose(
            other.map(aov) / scale, maps.map(aov), rtol=0.01, atol=0.002 * maps.map(aov).max()
        )
