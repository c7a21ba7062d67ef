"""The asset as one USDZ: the same surfaces, nothing of this machine, nothing from elsewhere."""

from __future__ import annotations

import json
import os
import subprocess
import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdMedia

from usdbrdf.cli import main
from usdbrdf.delivery.package import PackageOptions, package
from usdbrdf.delivery.textures import encoded_data, size_within
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.images import image_size, write_exr
from usdbrdf.stage.flat_stage import stage_in_look
from usdbrdf.stage.packaged_files import texture_uses
from usdbrdf.stage.published_surfaces import published_surfaces
from usdbrdf.validation.standard import standard_findings

BLENDER = os.environ.get("USDBRDF_BPY_PYTHON", "")
TIME = Usd.TimeCode.EarliestTime()

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


def packed(room, tmp_path, name="room.usdz", **options):
    output = tmp_path / "out of it" / name
    package(room.asset.folder, output, PackageOptions(**options))
    return output


def surfaces_of(stage):
    return {s.name: s for s in published_surfaces(stage, TIME, pytest.fail)}


def members(output):
    with zipfile.ZipFile(output) as archive:
        return archive.namelist()


def extracted(output, folder):
    """The package's files: our own readers do not look into archives."""
    with zipfile.ZipFile(output) as archive:
        archive.extractall(folder)
        return Usd.Stage.Open(str(folder / archive.namelist()[0]))


def edit(room, text):
    """Replace the artist's layer; ``text`` may have its braces on one line, which USD may not."""
    lines = text.replace("{", "{\n").replace("}", "\n}\n").replace("(", "(\n").replace(")", "\n)")
    layer = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    layer.ImportFromString(f'#usda 1.0\n(\n    defaultPrim = "room"\n)\n{lines}\n')
    layer.Save()


CHAIR_FILE = """over "room" {{ over "mtl" {{ over "Stuhl_No_1" {{ over "BaseColorTexture" {{
    asset inputs:file = @{}@
}} }} }} }}"""


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
    chair, lamp = "/room/geo/Stuhl_No_1", "/room/geo/lamp"
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
    assert not stage.GetPrimAtPath("/room/mtl")
    assert not stage.GetPrimAtPath("/room/render")
    thumbnail = UsdMedia.AssetPreviewsAPI(stage.GetDefaultPrim()).GetDefaultThumbnails()
    assert thumbnail.defaultImage.path == "./previews/lit.png"


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
    here = surfaces_of(stage_in_look(room.asset, "shaded"))["/room/geo/Stuhl_No_1"]
    there = surfaces_of(Usd.Stage.Open(str(tmp_path / "x/room.usdc")))["/room/geo/Stuhl_No_1"]
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
        """over "room" { over "mtl" { over "Stuhl_No_1" {
        over "PreviewSurface" {
            float inputs:roughness.connect = </room/mtl/Stuhl_No_1/Rough.outputs:r>
        }
        def Shader "Rough" {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./rough.exr@
            token inputs:sourceColorSpace = "raw"
            float2 inputs:st.connect = </room/mtl/Stuhl_No_1/StReader.outputs:result>
            float outputs:r
        }
    } } }""",
    )
    stage = extracted(packed(room, tmp_path, textures="png"), tmp_path / "x")
    (use,) = (
        u for u in texture_uses(stage, replace(room.asset, folder=tmp_path / "x"))
        if u.prim_path.endswith("Rough")
    )  # fmt: skip
    assert (use.space, use.colour) == ("raw", False)
    found = surfaces_of(stage)["/room/geo/Stuhl_No_1"].material.roughness[..., 0]
    assert found == pytest.approx(values, abs=3e-3)


def test_data_beyond_one_is_stored_by_scale_and_bias():
    values = np.float32([[[-1.0, 0.0, 3.0]]])
    stored, scale, bias = encoded_data(values)
    assert stored / 255 * scale + bias == pytest.approx(values, abs=0.02)


@pytest.mark.parametrize(
    "path", ["/etc/hostname", "../../../../../../../../etc/hostname", "./textures/link.exr"]
)
def test_files_outside_are_refused(room, tmp_path, path):
    secret = tmp_path / "secret.exr"
    write_exr(secret, np.zeros((2, 2, 3), np.float32))
    (room.asset.folder / "textures/link.exr").symlink_to(secret)
    edit(room, CHAIR_FILE.format(path))
    for name in ("room.usdz", "room.glb"):
        with pytest.raises(InputRefused, match=r"package\.outside"):
            packed(room, tmp_path, name)
        assert not (tmp_path / "out of it" / name).exists()


def test_other_attributes_bring_no_file_in(room, tmp_path):
    edit(room, 'over "room" { custom asset userProperties:note = @/etc/hostname@ }')
    with pytest.raises(InputRefused, match=r"package\.outside"):
        packed(room, tmp_path)


def test_a_layer_from_elsewhere_is_refused(room, tmp_path):
    (tmp_path / "mine.usda").write_text('#usda 1.0\nover "room" {}\n')
    edits = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    edits.subLayerPaths = [str(tmp_path / "mine.usda")]
    edits.Save()
    with pytest.raises(InputRefused, match=r"mine\.usda.*package\.outside"):
        packed(room, tmp_path)


@pytest.mark.parametrize(
    ("path", "code"),
    [("./note.txt", "package.format"), ("./gone.exr", "package.missing"), ("./x.exr", "image")],
)
def test_what_is_no_picture_is_refused(room, tmp_path, path, code):
    (room.asset.folder / "note.txt").write_text("mine")
    (room.asset.folder / "x.exr").write_text("no picture")
    edit(room, CHAIR_FILE.format(path))
    with pytest.raises(InputRefused, match=code):
        packed(room, tmp_path)


def test_the_standard_validators_agree(room, tmp_path):
    for i, options in enumerate(({}, {"textures": "png"}, {"profile": "arkit"})):
        stage = Usd.Stage.Open(str(packed(room, tmp_path, f"{i}.usdz", **options)))
        found = [str(f) for f in standard_findings(stage)]
        # They look for the files beside the package.
        assert [f for f in found if "missing" not in f] == []


def test_lights_that_the_artist_selected_travel(room, tmp_path, capsys):
    edit(room, 'over "room" ( variants = { string lights = "usdlux" } ) {}')
    stage = Usd.Stage.Open(str(packed(room, tmp_path)))
    assert sum(prim.HasAPI(UsdLux.LightAPI) for prim in stage.TraverseAll()) == 6
    stage = Usd.Stage.Open(str(packed(room, tmp_path, "ar.usdz", profile="arkit")))
    assert not any(prim.HasAPI(UsdLux.LightAPI) for prim in stage.TraverseAll())
    assert "6 lights are left out" in capsys.readouterr().err


def test_arkit_stands_upright(room, tmp_path):
    stage = Usd.Stage.Open(str(packed(room, tmp_path, profile="arkit")))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert not any(prim.IsA(UsdGeom.Camera) for prim in stage.TraverseAll())
    assert stage.GetRootLayer().GetFileFormat().formatId == "usdz"
    bounds = UsdGeom.BBoxCache(TIME, ["default"]).ComputeWorldBound(
        stage.GetPrimAtPath("/room/geo/wall")
    )
    box = bounds.ComputeAlignedRange()
    # The wall's middle was at y 3 and z 1 with z up.
    assert np.array(box.GetMidpoint()) == pytest.approx([0, 1, -3], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("room.zip", {}),
        ("room.glb", {"profile": "arkit"}),
        ("room.glb", {"textures": "exr"}),
        ("room.usdz", {"profile": "arkit", "textures": "exr"}),
        ("room.usdz", {"max_size": 0}),
        ("room.usdz", {"look": "sunny"}),
    ],
)
def test_options_that_cannot_be(room, tmp_path, name, options):
    with pytest.raises(UsageError):
        packed(room, tmp_path, name, **options)


def test_the_command(room, tmp_path, capsys):
    output = tmp_path / "room.usdz"
    assert main(["package", str(room.asset.folder), "-o", str(output), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bytes"] == output.stat().st_size
    assert told["textures"] == 3
    inside = room.asset.folder / "room.usdz"
    assert main(["package", str(room.asset.folder), "-o", str(inside)]) == 2
    assert not inside.exists()


@pytest.mark.skipif(not BLENDER, reason="USDBRDF_BPY_PYTHON names no interpreter with bpy")
def test_arkit_complies_and_blender_finds_every_texture(room, tmp_path):
    output = packed(room, tmp_path, profile="arkit")
    assert json.loads(in_blender(ARKIT_CHECK, output, tmp_path)) == []
    images = json.loads(in_blender(OPEN_IN_BLENDER, packed(room, tmp_path), tmp_path))
    assert set(images) == {
        "Stuhl_No_1.base_color.exr", "wall.base_color.exr", "lamp.emission.exr",
    }  # fmt: skip
    assert all(min(width, height) > 0 for width, height, *_ in images.values())
    assert images["lamp.emission.exr"][2:] == pytest.approx([8, 4, 2])


def in_blender(script, file, folder):
    """The last line that a script says in Blender's own process."""
    done = subprocess.run(
        [BLENDER, "-c", script, str(file)],
        env={k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PXR_PLUGINPATH_NAME")},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return next(x for x in reversed(done.stdout.splitlines()) if x.startswith(("{", "[")))
