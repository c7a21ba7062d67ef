"""A model of somebody else in the artist's layer, with pictures that packages may not hold."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from usdbrdf.asset.readers.surfaces import surfaces_from_stage
from usdbrdf.cli import main
from usdbrdf.delivery.package import package, stage_in_look
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import read_exr, read_radiance
from usdbrdf.options import PackageOptions
from usdbrdf.validation.validate import standard_findings

LAMP = "/room/prop/lamp"
TIME = Usd.TimeCode.EarliestTime()


def write(path, pixels, kind):
    """(H, W, C) pixels as ``kind``, by OpenImageIO's writer for the suffix."""
    height, width, channels = pixels.shape
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(width, height, channels, kind))
    assert output.write_image(pixels)
    assert output.close()


def texture(stage, name, file, space, output, size):
    """A UsdUVTexture of the lamp's material."""
    reader = UsdShade.Shader.Define(stage, f"/prop/looks/paint/{name}St")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    shader = UsdShade.Shader.Define(stage, f"/prop/looks/paint/{name}")
    shader.CreateIdAttr("UsdUVTexture")
    shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(file))
    shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
    found = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    shader.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(found)
    return shader.CreateOutput(output, size)


@pytest.fixture
def prop(room):
    """The room, with a lamp of three textures under a sky, all in files of other formats."""
    folder = room.asset.folder / "props"
    folder.mkdir()
    random = np.random.default_rng(3)
    glow = random.random((4, 6, 3), np.float32) * 30
    write(folder / "glow.hdr", glow, "float")
    write(folder / "paint.tif", random.integers(0, 256, (4, 6, 3), np.uint8), "uint8")
    write(folder / "rough.tiff", random.random((4, 6, 1), np.float32), "uint16")
    write(folder / "sky.hdr", random.random((4, 8, 3), np.float32), "float")
    stage = Usd.Stage.CreateNew(str(folder / "lamp.usda"))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/prop").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/prop/lamp")
    mesh.CreatePointsAttr([(0, 0, 3), (1, 0, 3), (0, 1, 3)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateSubdivisionSchemeAttr("none")
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    st.Set([(0, 0), (1, 0), (0, 1)])
    paint = UsdShade.Material.Define(stage, "/prop/looks/paint")
    surface = UsdShade.Shader.Define(stage, "/prop/looks/paint/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    types = Sdf.ValueTypeNames
    for name, file, space, output, size, kind in (
        ("diffuseColor", "./paint.tif", "auto", "rgb", types.Float3, types.Color3f),
        ("emissiveColor", "./glow.hdr", "auto", "rgb", types.Float3, types.Color3f),
        ("roughness", "./rough.tiff", "raw", "r", types.Float, types.Float),
    ):
        found = texture(stage, name, file, space, output, size)
        surface.CreateInput(name, kind).ConnectToSource(found)
    paint.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(paint)
    sky = UsdLux.DomeLight.Define(stage, "/prop/sky")
    sky.CreateTextureFileAttr(Sdf.AssetPath("./sky.hdr"))
    stage.Save()
    edits = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    prim = Sdf.CreatePrimInLayer(edits, "/room/prop")
    prim.specifier = Sdf.SpecifierDef
    prim.referenceList.prependedItems = [Sdf.Reference("./props/lamp.usda")]
    edits.Save()
    return room


def material_of(stage):
    (lamp,) = (s for s in surfaces_from_stage(stage, TIME, pytest.fail) if s.name == LAMP)
    return lamp.material


def unpacked(output, folder):
    with zipfile.ZipFile(output) as archive:
        archive.extractall(folder)
        return Usd.Stage.Open(str(folder / archive.namelist()[0]))


def test_they_become_exr_of_the_same_values(prop, tmp_path):
    output = tmp_path / "room.usdz"
    package(prop.asset.folder, output)
    there = unpacked(output, tmp_path / "x")
    files = {p.relative_to(tmp_path / "x").as_posix() for p in (tmp_path / "x").rglob("*.*")}
    expected = {"textures/glow.exr", "textures/paint.exr", "textures/rough.exr", "props/sky.exr"}
    assert expected <= files
    assert not [name for name in files if name.endswith((".hdr", ".tif", ".tiff"))]
    folder = prop.asset.folder / "props"
    stored = read_radiance(folder / "paint.tif")
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    half = 2.0**-10  # what half floats round by
    found = material_of(there)
    assert found.diffuse == pytest.approx(linear, rel=half, abs=1e-5)
    assert np.array_equal(found.emission, read_radiance(folder / "glow.hdr"))
    assert found.roughness == pytest.approx(read_exr(folder / "rough.tiff"), rel=half, abs=1e-5)
    assert np.array_equal(
        read_radiance(tmp_path / "x/props/sky.exr"), read_radiance(folder / "sky.hdr")
    )
    light = UsdLux.DomeLight(there.GetPrimAtPath("/room/prop/sky"))
    assert light.GetTextureFileAttr().Get().path == "./props/sky.exr"
    problems = [str(found) for found in standard_findings(Usd.Stage.Open(str(output)))]
    assert [text for text in problems if "missing" not in text] == []


def test_eight_bits_of_them(prop, tmp_path):
    here = material_of(stage_in_look(prop.asset, "shaded"))
    output = tmp_path / "room.usdz"
    package(prop.asset.folder, output, PackageOptions(profile="arkit"))
    there = material_of(unpacked(output, tmp_path / "x"))
    assert there.diffuse == pytest.approx(here.diffuse, abs=5e-3)
    assert there.roughness == pytest.approx(here.roughness, abs=3e-3)
    # Half a step of sRGB at the white end, of at most 30.
    assert there.emission == pytest.approx(here.emission, abs=0.15)


def test_gltf_takes_them_too(prop, tmp_path, capsys):
    output = tmp_path / "room.glb"
    assert main(["package", str(prop.asset.folder), "-o", str(output), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["meshes"] == 4


def test_alpha_stays_where_the_package_can_hold_it(prop, tmp_path):
    folder = prop.asset.folder / "props"
    pixels = np.random.default_rng(4).random((4, 6, 4), np.float32)
    write(folder / "paint.tif", pixels, "float")
    stage = Usd.Stage.Open(str(folder / "lamp.usda"))
    paint = UsdShade.Shader(stage.GetPrimAtPath("/prop/looks/paint/diffuseColor"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/prop/looks/paint/surface"))
    alpha = paint.CreateOutput("a", Sdf.ValueTypeNames.Float)
    surface.CreateInput("opacity", Sdf.ValueTypeNames.Float).ConnectToSource(alpha)
    stage.Save()
    output = tmp_path / "room.usdz"
    package(prop.asset.folder, output)
    unpacked(output, tmp_path / "x")
    # Floats of four channels are no sRGB.
    assert read_exr(tmp_path / "x/textures/paint.exr") == pytest.approx(pixels, rel=2.0**-10)
    with pytest.raises(InputRefused, match=r"paint\.tif.*package\.alpha"):
        package(prop.asset.folder, output, PackageOptions(textures="png"))
