"""A room in centimetres with y up is the room in metres with z up, from the capture to the numbers
that are published."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from tests.dim_room import converted, means_of_objects, write_objects
from tests.scenes import MadeCapture, edited, from_z_up, write_ply
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.scene import read_fit, read_shading
from usdbrdf.job.progress import set_quiet


def _in_centimetres(made: MadeCapture) -> None:
    """The capture in place of itself, a hundred times as large and y up, its objects in another
    order."""
    turn = from_z_up("Y")
    turn[:3] *= 100
    number = np.array([3, 0, 4, 1, 2])[: len(made.names)]
    points = (made.points @ turn[:3, :3].T).astype(np.float32)
    write_ply(made.folder / "mesh.ply", points, made.triangles, number[made.face_object])
    write_objects(made, number)
    with edited(made.manifest) as changed:
        changed["up_axis"], changed["meters_per_unit"] = "Y", 0.01
        for frame in changed["frames"]:
            pose = turn @ np.array(frame["transform_matrix"])
            pose[:3, :3] /= 100
            frame["transform_matrix"] = pose.tolist()


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[AssetMaps, ...]:
    set_quiet(True)
    try:
        return tuple(
            converted(tmp_path_factory.mktemp("room"), 2, otherwise)
            for otherwise in (None, _in_centimetres)
        )
    finally:
        set_quiet(False)


def test_each_stage_says_what_it_is_in(both):
    stages: list[Usd.Stage] = [maps.stage for maps in both]
    assert [UsdGeom.GetStageUpAxis(stage) for stage in stages] == ["Z", "Y"]
    assert [UsdGeom.GetStageMetersPerUnit(stage) for stage in stages] == [1, 0.01]
    # Maps and texels are in metres whatever the stage is in.
    areas = [maps.texels.area.sum() for maps in both]
    assert areas[1] == pytest.approx(areas[0], rel=0.05)


# Turned, and with objects in another order, texels lie elsewhere: near a lamp that tells.
@pytest.mark.parametrize(
    ("aov", "relative"),
    [("lit", 1e-3), ("irradiance", 0.12), ("albedo", 0.12), ("base_color", 0.12)],
)
def test_maps_are_the_same(both, aov: str, relative: float):
    usual, other = (means_of_objects(maps, [aov]) for maps in both)
    assert usual.keys() == other.keys()
    for name, value in usual.items():
        np.testing.assert_allclose(
            other[name][aov], value[aov], rtol=relative, atol=1e-6, err_msg=name
        )


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
