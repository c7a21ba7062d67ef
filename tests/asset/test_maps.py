"""The maps of an asset are decoded once, however often they are asked for."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

import usdbrdf
from tests.scenes import make_capture, poses_down_and_up
from usdbrdf.asset import maps as module
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.model.texels import CoverageMap


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

    # Views that differ by half of the radiance, of what enough of them show.
    def half(path):
        return 0.5 * read(path.with_name(path.name.replace(".spread.", ".lit.")))

    monkeypatch.setattr(module, "read_exr", half)
    often = maps.samples >= 3
    told = [often[maps.texels.of_object(i)].any() for i in range(len(maps.scene.objects))]
    assert any(told)
    np.testing.assert_allclose(maps.differing, np.where(told, 0.5, np.nan), rtol=1e-3)


def test_light_that_was_inferred_is_doubted_by_its_errors(tmp_path, monkeypatch):
    """Of a lamp, only where no frame measured it."""
    made = make_capture(
        tmp_path / "scan", subdivisions=1, poses=poses_down_and_up(6, 6),
        radiance={"ceiling": (0.125, 0.125, 0.125)}, size=(48, 36), saturation_radiance=4.0,
    )  # fmt: skip
    with usdbrdf.working_on(tmp_path / "room") as asset:
        usdbrdf.ingest(made.folder, asset, usdbrdf.IngestOptions())
        usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=0.2))
        usdbrdf.shade(asset, usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.2)))
    maps = AssetMaps(open_measured(asset))
    (lamp,) = (obj.prim_path for obj in maps.scene.objects if obj.identifier == "lamp")
    # Only a bound of it is known.
    assert maps.doubts_of_light == {lamp: 1.0}
    inferred = maps.emissive & ~maps.coverage.measured
    doubt = maps.light_in_doubt("estimate")
    assert doubt is not None
    center = np.array([maps.texels.face[inferred], *maps.texels.barycentric[inferred, 1:].T])
    shown = doubt.radiance.at(center[0].astype(np.int32), *np.float32(center[1:]))
    np.testing.assert_allclose(shown.mean(axis=0), maps.emission[inferred].mean(axis=0), rtol=0.05)
    every = doubt.radiance.at(
        maps.texels.face.astype(np.int32), *np.float32(maps.texels.barycentric[:, 1:].T)
    )
    seen = ~maps.emissive & maps.coverage.measured
    assert not (every[seen] > 0.01 * maps.light[seen]).any(axis=1).mean() > 0.02
    # What no frame shows is doubted whether or not there are such lamps.
    hidden = ~(maps.emissive | maps.coverage.observed) & maps.texels.interior
    assert hidden.sum() > 50
    light = maps.light[hidden].mean(axis=0)
    monkeypatch.setitem(maps.__dict__, "doubts_of_light", {})
    doubt = maps.light_in_doubt("estimate")
    assert doubt is not None
    shown = doubt.radiance.at(
        maps.texels.face[hidden].astype(np.int32),
        *np.float32(maps.texels.barycentric[hidden, 1:].T),
    )
    np.testing.assert_allclose(shown.mean(axis=0), 0.3 * light, rtol=0.2)
    assert not doubt.emission.pixels.any()
    every = np.ones(len(maps.texels), np.bool_)
    monkeypatch.setitem(maps.__dict__, "coverage", CoverageMap.of(every, ~every))
    assert maps.light_in_doubt("estimate") is None
    # Of what clips the map of what hides says nothing here, as in an older asset.
    clipped = seen & (np.cumsum(seen) % 2 == 0)
    monkeypatch.setitem(maps.__dict__, "coverage", CoverageMap.of(~clipped, clipped))
    np.testing.assert_array_equal(maps.light[clipped], maps.lit[clipped])
    assert maps.light_in_doubt("estimate") is None
