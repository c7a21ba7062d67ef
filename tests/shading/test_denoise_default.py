"""Which filter the shading step takes by itself, and what the asset says about it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.scenes import make_capture
from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.command_parser import parsed
from usdbrdf.commands import COMMANDS, Shade
from usdbrdf.job.progress import set_quiet
from usdbrdf.options import ShadeOptions
from usdbrdf.tasks.atlas import atlas_from_stage

OPTIONS = usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64))


@pytest.fixture
def asset(tmp_path) -> Asset:
    set_quiet(True)
    capture = make_capture(tmp_path / "scan", frames=8, subdivisions=1)
    with usdbrdf.working_on(tmp_path / "room") as asset:
        usdbrdf.ingest(capture.folder, asset, usdbrdf.IngestOptions())
        usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=0.4))
    yield asset
    set_quiet(False)


def _shaded(asset: Asset) -> tuple[bool, str, str]:
    """Shade by default: whether it ran, and the filter that the summary and the layer name."""
    with usdbrdf.working_on(asset.folder) as again:
        result = usdbrdf.shade(again, OPTIONS)
    recorded = read_provenance(asset.layer("shading"))["parameters"]["denoise"]
    return result.reran, result.summary["denoise"], recorded


def test_the_option_is_auto_by_default():
    assert parsed(["shade", "room"], COMMANDS) == Shade(asset=Path("room"), shade=ShadeOptions())
    assert ShadeOptions().denoise == "auto"


def test_the_asset_says_what_was_done_and_is_shaded_again_when_the_filter_appears(
    asset: Asset, monkeypatch
):
    pytest.importorskip("pyoidn", reason="the filter is Open Image Denoise's")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pyoidn", None)
        assert _shaded(asset) == (True, "none", "none")
        assert _shaded(asset) == (False, "none", "none")
    traced = atlas_from_stage(open_measured(asset)).map("irradiance")
    assert _shaded(asset) == (True, "oidn", "oidn")
    filtered = atlas_from_stage(open_measured(asset))
    np.testing.assert_array_equal(filtered.map("irradiance_raw"), traced)
    assert (filtered.map("irradiance") != traced).mean() > 0.5
    assert _shaded(asset) == (False, "oidn", "oidn")
