"""A room in centimetres with y up is the room in metres with z up, from the capture to the numbers
that are published."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import usdbrdf
from tests.scenes import edited, from_z_up, make_capture, poses_down_and_up, write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import read_fit, read_shading
from usdbrdf.job.progress import set_quiet

# The same length in metres, whatever the capture is in.
OPTIONS = usdbrdf.ConvertOptions(
    texture=usdbrdf.TextureOptions(texel_size=0.2),
    shade=usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.05, max_rays=256)),
    fit=usdbrdf.FitOptions(max_pixels=60),
)
# Nothing but the lamp sends more than it receives from it.
DIM = {
    "ceiling": (0.125, 0.125, 0.125), "walls": (0.25, 0.3, 0.2), "floor": (0.25, 0.125, 0.0625),
    "box": (0.06, 0.09, 0.12), "lamp": (32.0, 28.0, 24.0),
}  # fmt: skip


def _in_centimetres(folder: Path) -> None:
    """The capture in place of itself, a hundred times as large and y up, its objects in another
    order."""
    turn = from_z_up("Y")
    turn[:3] *= 100
    document = json.loads((folder / "transforms.json").read_text())
    made = make_capture(folder / "again", subdivisions=2, frames=1)
    number = np.array([3, 0, 4, 1, 2])[: len(made.names)]
    points = (made.points @ turn[:3, :3].T).astype(np.float32)
    write_ply(folder / "mesh.ply", points, made.triangles, number[made.face_object])
    shutil.rmtree(folder / "again")
    named = [
        {"id": int(number[i]), "name": name, "class_name": name}
        for i, name in enumerate(made.names)
    ]
    (folder / "objects.json").write_text(json.dumps({"objects": named[::-1]}))
    with edited(folder / "transforms.json") as changed:
        changed["up_axis"], changed["meters_per_unit"] = "Y", 0.01
        for frame, given in zip(changed["frames"], document["frames"], strict=True):
            pose = turn @ np.array(given["transform_matrix"])
            pose[:3, :3] /= 100
            frame["transform_matrix"] = pose.tolist()


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[AssetMaps, AssetMaps]:
    set_quiet(True)
    found = []
    try:
        for name in ("metres", "centimetres"):
            folder = tmp_path_factory.mktemp(name)
            make_capture(
                folder / "scan", poses=poses_down_and_up(6, 6), subdivisions=2, radiance=DIM
            )
            if name == "centimetres":
                _in_centimetres(folder / "scan")
            usdbrdf.convert(folder / "scan", folder / "asset", OPTIONS)
            found.append(AssetMaps(open_measured(Asset.at(folder / "asset"))))
    finally:
        set_quiet(False)
    return found[0], found[1]


def test_each_stage_says_what_it_is_in(both):
    stages: list[Usd.Stage] = [maps.stage for maps in both]
    assert [UsdGeom.GetStageUpAxis(stage) for stage in stages] == ["Z", "Y"]
    assert [UsdGeom.GetStageMetersPerUnit(stage) for stage in stages] == [1, 0.01]
    # Maps and texels are in metres whatever the stage is in.
    areas = [maps.texels.area.sum() for maps in both]
    assert areas[1] == pytest.approx(areas[0], rel=0.05)


def _by_name(maps: AssetMaps, aov: str) -> dict[str, np.ndarray]:
    """Means over the area that frames show, of each object."""
    values, seen = maps.map(aov), maps.coverage.observed > 0
    found = {}
    for i, item in enumerate(maps.scene.objects):
        own = np.zeros(len(seen), np.bool_)
        own[maps.texels.of_object(i)] = True
        found[item.label] = np.average(
            values[own & seen], axis=0, weights=maps.texels.area[own & seen]
        )
    return found


# Turned, and with objects in another order, texels lie elsewhere: near a lamp that tells.
@pytest.mark.parametrize(
    ("aov", "relative"),
    [("lit", 1e-3), ("irradiance", 0.12), ("albedo", 0.12), ("base_color", 0.12)],
)
def test_maps_are_the_same(both, aov: str, relative: float):
    usual, other = (_by_name(maps, aov) for maps in both)
    assert usual.keys() == other.keys()
    for name, value in usual.items():
        np.testing.assert_allclose(other[name], value, rtol=relative, atol=1e-6, err_msg=name)


def test_published_numbers_are_the_same_within_their_errors(both):
    told = []
    for maps in both:
        items = {item.label: item.prim_path for item in maps.scene.objects}
        told.append({
            name: (read_fit(maps.stage, path), read_shading(maps.stage, path).emitter)
            for name, path in items.items()
        })  # fmt: skip
    assert told[0].keys() == told[1].keys()
    for name, (fit, emits) in told[0].items():
        other, emits_too = told[1][name]
        assert (emits, fit.status) == (emits_too, other.status), name
        for one, two, error, error_too in (
            (fit.phi, other.phi, fit.phi_error, other.phi_error),
            (fit.psi, other.psi, fit.psi_error, other.psi_error),
        ):
            assert abs(one - two) <= np.hypot(error, error_too), name
            assert error == pytest.approx(error_too, abs=0.1), name
