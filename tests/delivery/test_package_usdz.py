"""The asset as one USDZ: the same surfaces, nothing of this machine, nothing from elsewhere."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdMedia

from tests.blender import in_blender, needs_blender
from tests.delivery.packing import TIME, edit, extracted, members, packed, surfaces_of
from tests.json_schemas import checked
from usdbrdf.cli import main
from usdbrdf.delivery.package import package, stage_in_look
from usdbrdf.delivery.packaged_files import encoded_data, size_within, texture_uses
from usdbrdf.files.images import image_size, write_exr
from usdbrdf.options import PackageOptions
from usdbrdf.validation.validate import standard_findings

ARKIT_CHECK = """
import json, sys
import bpy
bpy.utils.expose_bundled_modules()
from pxr import UsdUtils
checker = UsdUtils.ComplianceChecker(arkit=True)
checker.CheckCompliance(sys.argv[1])
print(json.dumps([*checker.GetErrors(), *checker.GetFailedChecks(), *checker.GetWarnings()]))
"""
OPEN_IN_BLENDER = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=sys.argv[1], import_textures_mode="IMPORT_PACK")
print(json.dumps({i.name: [*i.size, *i.pixels[:3]] for i in bpy.data.images if i.type == "IMAGE"}))
"""


def test_the_surfaces_are_those_of_the_asset(room, tmp_path):
    here = surfaces_of(stage_in_look(room.asset, "shaded"))
    there = surfaces_of(extracted(packed(room, tmp_path), tmp_path / "x"))
    assert there.keys() == here.keys()
    for name, surface in here.items():
        found = there[name]
        assert np.array_equal(found.points, surface.points)
        for part in ("diffuse", "f0", "roughness", "emission"):
            expected = getattr(surface.material, part)
            assert np.array_equal(getattr(found.material, part), expected), (name, part)


def test_eight_bits_keep_colours_and_high_emission(room, tmp_path):
    output = packed(room, tmp_path, textures="png")
    here = surfaces_of(stage_in_look(room.asset, "shaded"))
    there = surfaces_of(extracted(output, tmp_path / "x"))
    chair, lamp = "/room/geo/Stuhl_No_1/Stuhl_No_1", "/room/geo/lamp/lamp"
    diffuse = here[chair].material.diffuse
    # Half a step of sRGB, at its steepest: 1 / (2 * 255) * 2.3 at the white end.
    assert there[chair].material.diffuse == pytest.approx(diffuse, abs=5e-3)
    assert not np.array_equal(there[chair].material.diffuse, diffuse)
    assert there[lamp].material.emission.max() == pytest.approx(8.0, rel=1e-3)
    assert there[lamp].material.emission == pytest.approx(here[lamp].material.emission, abs=0.05)
    assert {name.rsplit(".", 1)[1] for name in members(output)} == {"usdc", "png"}


def test_one_look_and_its_textures_only(room, tmp_path):
    output = packed(room, tmp_path, look="lit")
    assert set(members(output)) == {
        "room.usdc", "previews/lit.png", "textures/Stuhl_No_1.lit.exr", "textures/lamp.lit.exr",
    }  # fmt: skip
    stage = Usd.Stage.Open(str(output))
    assert not stage.GetDefaultPrim().HasVariantSets()
    assert not stage.GetPrimAtPath("/room/geo/Stuhl_No_1/mtl")
    assert not stage.GetPrimAtPath("/room/render")
    thumbnail = UsdMedia.AssetPreviewsAPI(stage.GetDefaultPrim()).GetDefaultThumbnails()
    assert thumbnail.defaultImage.path == "./previews/lit.png"


@pytest.mark.parametrize(
    ("selected", "asked", "expected"),
    [
        ("lit", None, "lit"),
        ("lit", "shaded", "shaded"),
        ("sunny", None, "shaded"),
        (None, None, "shaded"),
    ],
)
def test_the_look_is_the_one_that_it_opens_in(room, tmp_path, selected, asked, expected):
    if selected:
        edit(room, f'over "room" ( variants = {{ string look = "{selected}" }} ) {{}}')
    output = tmp_path / "room.usdz"
    assert package(room.asset.folder, output, PackageOptions(look=asked))["look"] == expected
    stage = Usd.Stage.Open(str(output))
    assert stage.GetRootLayer().customLayerData["usdbrdf"]["look"] == expected
    assert ("textures/lamp.lit.exr" in members(output)) == (expected == "lit")


def test_nothing_tells_where_it_was_made(room, tmp_path):
    stage = Usd.Stage.Open(str(packed(room, tmp_path)))
    text = stage.GetRootLayer().ExportToString()
    assert str(tmp_path) not in text
    assert "frame 00" not in text
    # The measured numbers travel.
    assert stage.GetPrimAtPath(room.prims[0]).GetAttribute("usdBrdf:fit:phi").Get() == 0.25


def test_equal_assets_give_equal_bytes(room, tmp_path, monkeypatch):
    first = packed(room, tmp_path, textures="png").read_bytes()
    for file in room.asset.folder.rglob("*.exr"):
        os.utime(file, (1, 1))
    monkeypatch.setenv("TZ", "Asia/Kathmandu")
    time.tzset()
    try:
        assert packed(room, tmp_path, "room.usdz", textures="png").read_bytes() == first
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.mark.parametrize("textures", ["exr", "png"])
def test_textures_are_reduced(room, tmp_path, textures):
    extracted(packed(room, tmp_path, textures=textures, max_size=4), tmp_path / "x")
    width, height, _ = image_size(tmp_path / f"x/textures/Stuhl_No_1.base_color.{textures}")
    assert (width, height) == (3, 4)
    here = surfaces_of(stage_in_look(room.asset, "shaded"))["/room/geo/Stuhl_No_1/Stuhl_No_1"]
    there = surfaces_of(Usd.Stage.Open(str(tmp_path / "x/room.usdc")))[
        "/room/geo/Stuhl_No_1/Stuhl_No_1"
    ]
    expected = here.material.diffuse.reshape(4, 2, 3, 2, 3).mean(axis=(1, 3))
    assert there.material.diffuse == pytest.approx(expected, abs=5e-3)


def test_sizes():
    assert size_within(100, 50, None) == (100, 50)
    assert size_within(100, 50, 10) == (10, 5)
    assert size_within(1, 1000, 10) == (1, 10)


def test_data_is_not_taken_for_colour(room, tmp_path):
    values = np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4)
    write_exr(room.asset.folder / "rough.exr", values)
    edit(
        room,
        """over "room" { over "geo" { over "Stuhl_No_1" { over "mtl" { over "Stuhl_No_1" {
        over "PreviewSurface" {
            float inputs:roughness.connect = </room/geo/Stuhl_No_1/mtl/Stuhl_No_1/Rough.outputs:r>
        }
        def Shader "Rough" {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./rough.exr@
            token inputs:sourceColorSpace = "raw"
            float2 inputs:st.connect = </room/geo/Stuhl_No_1/mtl/Stuhl_No_1/StReader.outputs:result>
            float outputs:r
        }
    } } } } }""",
    )
    stage = extracted(packed(room, tmp_path, textures="png"), tmp_path / "x")
    (use,) = (
        u for u in texture_uses(stage, replace(room.asset, folder=tmp_path / "x"))
        if u.prim_path.endswith("Rough")
    )  # fmt: skip
    assert (use.space, use.colour) == ("raw", False)
    found = surfaces_of(stage)["/room/geo/Stuhl_No_1/Stuhl_No_1"].material.roughness[..., 0]
    assert found == pytest.approx(values, abs=3e-3)


def test_data_beyond_one_is_stored_by_scale_and_bias():
    values = np.float32([[[-1.0, 0.0, 3.0]]])
    stored, scale, bias = encoded_data(values)
    assert stored / 255 * scale + bias == pytest.approx(values, abs=0.02)


def test_the_standard_validators_agree(room, tmp_path):
    for i, options in enumerate(({}, {"textures": "png"}, {"profile": "arkit"})):
        stage = Usd.Stage.Open(str(packed(room, tmp_path, f"{i}.usdz", **options)))
        found = [str(f) for f in standard_findings(stage)]
        # They look for the files beside the package.
        assert [f for f in found if "missing" not in f] == []


def test_arkit_stands_upright(room, tmp_path):
    stage = Usd.Stage.Open(str(packed(room, tmp_path, profile="arkit")))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert not any(prim.IsA(UsdGeom.Camera) for prim in stage.TraverseAll())
    assert stage.GetRootLayer().GetFileFormat().formatId == "usdz"
    bounds = UsdGeom.BBoxCache(TIME, ["default"]).ComputeWorldBound(
        stage.GetPrimAtPath("/room/geo/wall/wall")
    )
    box = bounds.ComputeAlignedRange()
    # The wall's middle was at y 3 and z 1 with z up.
    assert np.array(box.GetMidpoint()) == pytest.approx([0, 1, -3], abs=1e-6)


def test_the_command(room, tmp_path, capsys):
    output = tmp_path / "room.usdz"
    assert main(["package", str(room.asset.folder), "-o", str(output), "--json"]) == 0
    told = checked(capsys.readouterr().out, "package")
    assert told["bytes"] == output.stat().st_size
    assert told["textures"] == 3
    inside = room.asset.folder / "room.usdz"
    assert main(["package", str(room.asset.folder), "-o", str(inside)]) == 2
    assert not inside.exists()


@needs_blender
def test_arkit_complies_and_blender_finds_every_texture(room, tmp_path):
    output = packed(room, tmp_path, profile="arkit")
    assert said_in_blender(ARKIT_CHECK, output, tmp_path) == []
    images = said_in_blender(OPEN_IN_BLENDER, packed(room, tmp_path), tmp_path)
    assert set(images) == {
        "Stuhl_No_1.base_color.exr", "wall.base_color.exr", "lamp.emission.exr",
    }  # fmt: skip
    assert all(min(width, height) > 0 for width, height, *_ in images.values())
    assert images["lamp.emission.exr"][2:] == pytest.approx([8, 4, 2])


def said_in_blender(script, file, folder):
    """The last JSON that a script prints in Blender's own process."""
    lines = in_blender("-c", script, file, folder=folder).splitlines()
    return json.loads(next(x for x in reversed(lines) if x.startswith(("{", "["))))
