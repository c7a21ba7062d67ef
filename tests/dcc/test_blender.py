"""What Blender makes of an asset: textures, roughness and index of refraction on every object."""

import json
import shutil
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdShade

from tests.blender import in_blender, needs_blender
from tests.nondestruction.conftest import convert, photographed
from usdbrdf.asset.layout import Asset
from usdbrdf.files.images import read_radiance
from usdbrdf.job.progress import set_quiet

SCRIPT = Path(__file__).with_name("blender_report.py")
FOLDERS = ["room", "Zimmer é 椅子 (1)"]

pytestmark = needs_blender


def blender_report(layer, tmp_path):
    said = in_blender(SCRIPT, layer, folder=tmp_path)
    # Blender may have a last word of its own.
    return json.loads(next(x for x in said.splitlines() if x.startswith("{")))


def report_of(built, tmp_path, look):
    """The report with a look selected, as an artist would in a layer of his own."""
    mine = Sdf.Layer.CreateNew(str(tmp_path / f"{look}.usda"))
    mine.subLayerPaths = [str(built.asset.root_layer)]
    mine.defaultPrim = built.asset.name
    prim = Sdf.CreatePrimInLayer(mine, f"/{built.asset.name}")
    prim.variantSelections["look"] = look
    mine.Save()
    meshes = blender_report(mine.realPath, tmp_path)["meshes"]
    assert set(meshes) == {"Stuhl_No_1", "wall", "lamp"}
    return {name: mesh["slots"][0] for name, mesh in meshes.items()}


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_shaded_look(tmp_path, synthetic, folder):
    scan = synthetic.make_scan(tmp_path / "capture")
    made = synthetic.build(tmp_path / "made" / "room", scan).asset
    asset = Asset(tmp_path / folder, made.name)
    shutil.move(made.folder, asset.folder)
    report = blender_report(asset.root_layer, tmp_path)
    for mesh in report["meshes"].values():
        assert mesh["uv_layers"] == ["st"]
        assert len(mesh["slots"]) == 1
    materials = {name: mesh["slots"][0] for name, mesh in report["meshes"].items()}
    for name in ("Stuhl_No_1", "wall"):
        image = materials[name]["base_image"]
        assert image["file"] == f"{name}.base_color.exr"
        # Not taken for sRGB, and in place: a missing image has no size.
        assert image["colorspace"] == "Non-Color"
        assert image["pixel"] == [0.25, 0.25, 0.25, 1.0]
        assert (image["extension"], image["uv"]) == ("EXTEND", "st")
    chair, wall, lamp = (materials[name] for name in ("Stuhl_No_1", "wall", "lamp"))
    assert (chair["roughness"], chair["ior"]) == pytest.approx((0.5, 1.5))
    assert (wall["roughness"], wall["ior"]) == (1.0, 1.0)
    assert chair["tint"] == [1.0] * 4
    assert chair["metallic"] == 0
    assert lamp["emission_image"]["file"] == "lamp.emission.exr"
    assert lamp["emission_strength"] == 1
    assert lamp["base_color"][:3] == [0, 0, 0]
    assert report["frames"] == [1, 3]


@pytest.mark.parametrize("look", ["lit", "coverage", "albedo"])
def test_a_look_shows_its_map_unlit(built, tmp_path, look):
    chair = report_of(built, tmp_path, look)["Stuhl_No_1"]
    assert chair["emission_image"]["file"] == f"Stuhl_No_1.{look}.exr"
    # A map of one channel is grey, not red.
    assert chair["emission_image"]["pixel"][:3] == [0.25] * 3
    assert chair["base_color"][:3] == [0, 0, 0]
    assert chair["ior"] == 1


def test_every_object_of_a_converted_asset_that_was_moved(tmp_path):
    """Roughness, ior, textures and their factors are those of its layers, on all objects."""
    made = convert(photographed(tmp_path / "scan").folder, tmp_path / "made" / "room")
    set_quiet(False)
    asset = Asset(tmp_path / FOLDERS[1] / "room", made.name)
    asset.folder.parent.mkdir()
    shutil.move(made.folder, asset.folder)
    shown = blender_report(asset.root_layer, tmp_path)["meshes"]
    stage = Usd.Stage.Open(str(asset.root_layer))
    written = objects_of(stage)
    assert len(written) >= 4
    assert shown.keys() == written.keys()
    for name, surface in written.items():
        (slot,) = shown[name]["slots"]
        assert slot["roughness"] == pytest.approx(surface.GetInput("roughness").Get()), name
        assert slot["ior"] == pytest.approx(surface.GetInput("ior").Get()), name
        assert slot["tint"] == [1.0] * 4
        check_texture(asset, surface.GetInput("diffuseColor"), slot["base_image"])
        check_texture(asset, surface.GetInput("emissiveColor"), slot["emission_image"])
    textured = [slot for mesh in shown.values() for slot in mesh["slots"] if slot["base_image"]]
    assert len(textured) == len(written) - 1, "all but the lamp"


def objects_of(stage):
    """Name of each object -> the UsdPreviewSurface that it wears, by our build of USD."""
    found = {}
    for prim in stage.Traverse():
        if prim.GetAttribute("usdBrdf:label").HasAuthoredValue():
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            found[prim.GetName()] = material.ComputeSurfaceSource()[0]
    return found


def check_texture(asset, connected, image):
    """``image`` is the texture that an input has, or None where it has none."""
    sources = connected.GetConnectedSources()[0] if connected else []
    assert bool(sources) == (image is not None)
    if not sources:
        return
    texture = UsdShade.Shader(sources[0].source.GetPrim())
    file = Path(texture.GetInput("file").Get().resolvedPath)
    assert file.is_relative_to(asset.folder)
    assert (image["file"], image["colorspace"]) == (file.name, "Non-Color")
    pixels = read_radiance(file)
    assert image["size"] == [pixels.shape[1], pixels.shape[0]]
    # Blender counts rows from below.
    assert image["pixel"][:3] == pytest.approx(pixels[-1, 0, :3].tolist(), rel=1e-3)
    scale = texture.GetInput("scale")
    factor = list(scale.Get())[:3] if scale else [1.0] * 3
    assert image["factor"] == pytest.approx(factor)
