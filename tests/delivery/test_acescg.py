"""Copies in ACEScg against matrices derived here, from the primaries alone."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd

from tests.delivery.packing import edit, extracted, packed
from tests.synthetic_asset import sky_of
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_edited
from usdbrdf.delivery.publish import publish
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.images import colour_tag, read_exr, write_exr
from usdbrdf.options import PublishOptions

REC709 = [(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)], (0.3127, 0.3290)
AP1 = [(0.713, 0.293), (0.165, 0.830), (0.128, 0.044)], (0.32168, 0.33767)
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def xyz(place):
    x, y = place
    return np.array([x / y, 1, (1 - x - y) / y])


def xyz_from_rgb(primaries, white):
    columns = np.stack([xyz(place) for place in primaries], axis=1)
    return columns * np.linalg.solve(columns, xyz(white))


def acescg_from_rec709():
    """Through XYZ, the white points adapted after Bradford."""
    before, after = BRADFORD @ xyz(REC709[1]), BRADFORD @ xyz(AP1[1])
    adapted = np.linalg.inv(BRADFORD) @ np.diag(after / before) @ BRADFORD
    return np.linalg.inv(xyz_from_rgb(*AP1)) @ adapted @ xyz_from_rgb(*REC709)


MATRIX = acescg_from_rec709()


def converted(colour):
    return np.asarray(colour, float) @ MATRIX.T


def test_the_matrix_is_the_published_one():
    assert MATRIX[0] == pytest.approx([0.6130974, 0.3395231, 0.0473795], abs=1e-5)


@pytest.fixture
def version(room, tmp_path):
    """The room in ACEScg, with a display colour and a map of roughness by the artist."""
    folder = room.asset.folder
    write_exr(folder / "rough.exr", np.random.default_rng(1).random((4, 4, 3)).astype(np.float32))
    edit(
        room,
        """over "room" {
        def Sphere "ball" { color3f[] primvars:displayColor = [(0.8, 0.4, 0.1)] }
        over "geo" { over "wall" { over "mtl" { over "wall" {
            over "PreviewSurface" {
                float inputs:roughness.connect = </room/geo/wall/mtl/wall/Rough.outputs:r>
            }
            def Shader "Rough" {
                uniform token info:id = "UsdUVTexture"
                asset inputs:file = @./rough.exr@
                token inputs:sourceColorSpace = "raw"
                float4 inputs:fallback = (0.5, 0.25, 0.1, 1)
                float outputs:r
            }
        } } } } }""",
    )
    options = PublishOptions(texture_space="acescg", photographs=False)
    publish(folder, tmp_path / "dest", options)
    return tmp_path / "dest/v001"


def test_all_colours_are_in_acescg_and_nothing_else_is(room, version):
    here = Usd.Stage.Open(str(room.asset.root_layer))
    there = Usd.Stage.Open(str(version / "room.usd"))
    space = Usd.ColorSpaceAPI.ComputeColorSpaceName(
        there.GetPrimAtPath("/room/geo/wall/mtl/wall"), None
    )
    assert space == "lin_ap1_scene"
    # Textures of colours, their headers and their tags in the stage.
    for name in ("Stuhl_No_1.base_color", "lamp.emission", "lamp.lit"):
        file = version / f"textures/{name}.exr"
        assert colour_tag(file)[0] == "lin_ap1_scene"
        assert colour_tag(file)[1] == pytest.approx([*sum(AP1[0], ()), *AP1[1]])
        expected = converted(read_exr(room.asset.folder / f"textures/{name}.exr"))
        assert read_exr(file) == pytest.approx(expected, rel=2e-3, abs=1e-4)
    node = there.GetPrimAtPath("/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/BaseColorTexture")
    assert node.GetAttribute("inputs:file").GetColorSpace() == "lin_ap1_scene"
    assert node.GetAttribute("inputs:sourceColorSpace").Get() == "raw"
    # Constants: fallbacks, display colours, lights.
    for path, name in (
        ("/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/BaseColorTexture", "inputs:fallback"),
        ("/room/ball", "primvars:displayColor"),
    ):
        before, after = (s.GetPrimAtPath(path).GetAttribute(name).Get() for s in (here, there))
        rows = [np.atleast_2d(np.array(value, float))[:, :3] for value in (before, after)]
        assert rows[1] == pytest.approx(converted(rows[0]), abs=1e-5)
    # Data, and what was measured, stay.
    rough = there.GetPrimAtPath("/room/geo/wall/mtl/wall/Rough")
    assert rough.GetAttribute("inputs:fallback").Get() == pytest.approx((0.5, 0.25, 0.1, 1))
    assert np.array_equal(
        read_exr(version / "rough.exr"), read_exr(room.asset.folder / "rough.exr")
    )
    chair = [s.GetPrimAtPath(room.prims[0]) for s in (here, there)]
    albedo = [prim.GetAttribute("usdBrdf:shading:meanAlbedo") for prim in chair]
    assert albedo[0].Get() == albedo[1].Get()
    assert albedo[1].GetColorSpace() == "lin_rec709_scene"


def test_the_sky_and_the_sun_are_in_acescg(room, tmp_path):
    room.outside = sky_of(room.asset)
    room.write_layer("shading")
    options = PublishOptions(texture_space="acescg", photographs=False)
    publish(room.asset.folder, tmp_path / "dest", options)
    version, sky = tmp_path / "dest/v001", room.asset.sky
    here, there = read_exr(room.asset.folder / sky), read_exr(version / sky)
    assert colour_tag(version / sky)[0] == "lin_ap1_scene"
    assert there == pytest.approx(converted(here), rel=2e-3, abs=1e-4)
    # How far it is known is no colour.
    told = room.asset.sky_confidence
    assert np.array_equal(read_exr(version / told), read_exr(room.asset.folder / told))
    stages = [Usd.Stage.Open(str(p)) for p in (room.asset.root_layer, version / "room.usd")]
    for stage in stages:
        stage.SetEditTarget(stage.GetSessionLayer())
        stage.GetDefaultPrim().GetVariantSet("lights").SetVariantSelection("usdlux")
    lights = [{p.GetTypeName(): p for p in stage.TraverseAll()} for stage in stages]
    dome = lights[1]["DomeLight"].GetAttribute("inputs:texture:file").Get()
    assert dome.resolvedPath == str(version / sky)
    suns = [found["DistantLight"].GetAttribute("inputs:color").Get() for found in lights]
    assert np.array(suns[1]) == pytest.approx(converted(suns[0]), abs=1e-5)


def test_our_own_commands_do_not_take_it_for_rec709(version):
    with pytest.raises(InputRefused, match=r"lin_ap1_scene.*publish\.space"):
        open_edited(Asset.made(version))


def test_a_package_in_acescg(room, tmp_path):
    output = packed(room, tmp_path, texture_space="acescg")
    stage = extracted(output, tmp_path / "x")
    here = read_exr(room.asset.folder / "textures/Stuhl_No_1.base_color.exr")
    there = read_exr(tmp_path / "x/textures/Stuhl_No_1.base_color.exr")
    assert there == pytest.approx(converted(here), rel=2e-3, abs=1e-4)
    space = Usd.ColorSpaceAPI.ComputeColorSpaceName(stage.GetDefaultPrim(), None)
    assert space == "lin_ap1_scene"
    with pytest.raises(UsageError, match=r"package\.space"):
        packed(room, tmp_path, texture_space="acescg", textures="png")


def test_factors_that_differ_by_channel_are_refused(room, tmp_path):
    edit(
        room,
        """over "room" { over "geo" { over "Stuhl_No_1" { over "mtl" {
        over "Stuhl_No_1" { over "BaseColorTexture" {
        float4 inputs:scale = (1, 0.5, 0.5, 1)
        } } } } } }""",
    )
    with pytest.raises(InputRefused, match=r"colour\.scale"):
        publish(room.asset.folder, tmp_path / "d", PublishOptions(texture_space="acescg"))
