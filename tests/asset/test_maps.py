"""The maps of an asset are decoded once, however often they are asked for."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

import usdbrdf
from tests.scenes import make_capture
from usdbrdf.asset import maps as module
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured


def test_every_map_is_decoded_once(tmp_path, monkeypatch: pytest.MonkeyPatch):
    made = make_capture(tmp_path / "scan", frames=8, subdivisions=1)
    sampling = usdbrdf.Sampling(standard_error=0.2)
    with usdbrdf.working_on(tmp_path / "room") as asset:
        usdbrdf.ingest(made.folder, asset, usdbrdf.IngestOptions())
        usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=0.3))
        usdbrdf.shade(asset, usdbrdf.ShadeOptions(sampling=sampling))
    decoded: Counter[str] = Counter()
    read = module.read_exr

    def counted(path):
        decoded[path.name] += 1
        return read(path)

    monkeypatch.setattr(module, "read_exr", counted)
    maps = AssetMaps(open_measured(asset))
    for _ in range(3):
        for name in ("lit", "samples", "coverage", "light", "emission", "emissive", "irradiance"):
            np.asarray(getattr(maps, name))
        maps.map_where_present("albedo", 3)
    assert {name.split(".")[1] for name in decoded} >= {"lit", "albedo", "samples"}
    assert set(decoded.values()) == {1}
