"""Packages of few triangles: what was measured is still seen, by maps on coarse meshes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from tests.delivery.packing import extracted, packed, surfaces_of
from tests.delivery.test_glb import document
from tests.json_schemas import checked
from usdbrdf.cli import main
from usdbrdf.delivery.package import package, stage_in_look
from usdbrdf.errors import UsageError
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.geometry.normal_maps import corner_tangents, from_tangent_space, interpolated, sampled
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.options import PackageOptions
from usdbrdf.transport.rays import RayScene

Types = Sdf.ValueTypeNames
BALL = "/room/ball"
# In centimetres, mirrored, turned and moved: nothing of it may show.
PLACE = Gf.Matrix4d(0, -0.01, 0, 0, -0.01, 0, 0, 0, 0, 0, -0.01, 0, 2, 1, 1, 1)


def bumpy_ball():
    sphere = trimesh.creation.icosphere(subdivisions=5)
    x = np.asarray(sphere.vertices)
    radius = 40 * (1 + 0.02 * np.prod(np.sin(5 * x), axis=1))
    return np.float32(x * radius[:, None]), np.int32(sphere.faces)


@pytest.fixture
def with_ball(room):
    """The room and, in the artist's layer, a bumpy ball whose colour tells where on it one is."""
    points, triangles = bumpy_ball()
    # Around the ball and up; texels far finer than the steps of the picture.
    corner = points[triangles] / np.linalg.norm(points[triangles], axis=-1, keepdims=True)
    u = np.arctan2(corner[..., 1], corner[..., 0]) / (2 * np.pi) % 1
    u += (u < 0.5) & (np.ptp(u, axis=1) > 0.5)[:, None]  # beyond 1 at the seam, which repeats
    uv = np.stack([u, corner[..., 2] / 2 + 0.5], axis=-1)
    v = (1 - (np.arange(128) + 0.5) / 128)[:, None]
    along = (np.arange(256) + 0.5)[None] / 256
    texture = np.stack(
        [0.5 + 0.4 * np.sin(2 * np.pi * along) + 0 * v, v + 0 * along, 0.25 + 0 * (v + along)],
        axis=-1,
    )
    write_exr(room.asset.folder / "textures/ball.exr", np.float32(texture))
    layer = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    stage = Usd.Stage.Open(layer)
    mesh = UsdGeom.Mesh.Define(stage, BALL)
    mesh.AddTransformOp().Set(PLACE)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(np.full(len(triangles), 3, np.int32))
    mesh.CreateFaceVertexIndicesAttr(triangles.reshape(-1))
    mesh.CreateSubdivisionSchemeAttr("none")
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Types.TexCoord2fArray, "faceVarying")
    st.Set(np.float32(uv.reshape(-1, 2)))
    weights = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("weight", Types.FloatArray, "vertex")
    weights.Set(np.zeros(len(points), np.float32))
    part = UsdGeom.Subset.Define(stage, f"{BALL}/half")
    part.CreateIndicesAttr(np.arange(100, dtype=np.int32))
    material = UsdShade.Material.Define(stage, "/room/varnish")
    shader = UsdShade.Shader.Define(stage, "/room/varnish/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", Types.Float).Set(0.3)
    reader = UsdShade.Shader.Define(stage, "/room/varnish/Reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Types.String).Set("map1")
    node = UsdShade.Shader.Define(stage, "/room/varnish/Colour")
    node.CreateIdAttr("UsdUVTexture")
    node.CreateInput("file", Types.Asset).Set("./textures/ball.exr")
    node.CreateInput("sourceColorSpace", Types.Token).Set("raw")
    node.CreateInput("wrapS", Types.Token).Set("repeat")
    node.CreateInput("wrapT", Types.Token).Set("repeat")
    node.CreateInput("scale", Types.Float4).Set(Gf.Vec4f(0.5, 0.5, 0.5, 1))
    node.CreateInput("st", Types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    shader.CreateInput("diffuseColor", Types.Color3f).ConnectToSource(node.ConnectableAPI(), "rgb")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    layer.Save()
    return room


def views(surfaces):
    """Points, normals and colours that rays towards the ball's middle meet."""
    ball = surfaces[BALL]
    random = np.random.default_rng(1).normal(size=(5000, 3))
    directions = np.float32(random / np.linalg.norm(random, axis=1, keepdims=True))
    origins = np.float32([2, 1, 1]) - directions
    hits = RayScene(ball.points.astype(np.float32), ball.triangles).closest(origins, directions)
    assert (hits.face >= 0).all()
    normals = interpolated(ball.corner_normals, hits)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv, wrap = interpolated(ball.corner_uv, hits), ball.material.wrap
    if ball.material.normal is not None:
        frames = corner_tangents(ball.points, ball.triangles, ball.corner_normals, ball.corner_uv)
        local = sampled(ball.material.normal, uv, wrap)
        normals = from_tangent_space(local, normals, interpolated(frames, hits))
    return hits.distance, normals, sampled(ball.material.diffuse, uv, wrap)


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))


@pytest.mark.parametrize("textures", ["exr", "png"])
def test_a_bumpy_ball_of_few_triangles_looks_like_that_of_many(with_ball, tmp_path, textures):
    before = views(surfaces_of(stage_in_look(with_ball.asset, "shaded")))
    output = packed(with_ball, tmp_path, low_poly=0.05, textures=textures)
    stage = extracted(output, tmp_path / "x")
    surfaces = surfaces_of(stage)
    ball = surfaces[BALL]
    assert 0.04 < len(ball.triangles) / len(bumpy_ball()[1]) < 0.06
    distance, normals, colours = views(surfaces)
    assert np.abs(distance - before[0]).max() < 0.02  # of a radius of 0.4 m
    by_map = degrees_between(normals, before[1])
    coarse = corner_normals(ball.points.astype(np.float32), ball.triangles, 180)
    plain = surfaces | {BALL: _without_map(ball, coarse)}
    assert by_map.mean() < 0.6
    assert by_map.mean() < degrees_between(views(plain)[1], before[1]).mean() / 4
    away = np.abs(colours - before[2])
    assert away.mean() < 0.005
    assert np.quantile(away, 0.99) < 0.03
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(BALL))
    assert not mesh.GetPrim().GetChildren()
    assert not UsdGeom.PrimvarsAPI(mesh).HasPrimvar("weight")
    low, high = np.array(mesh.GetExtentAttr().Get())
    assert np.abs([low, high]) == pytest.approx(40, abs=2)
    node = UsdShade.Shader(stage.GetPrimAtPath("/room/varnish/NormalTexture"))
    told = {each.GetBaseName(): each.Get() for each in node.GetInputs()}
    assert (told["scale"], told["bias"]) == (Gf.Vec4f(2, 2, 2, 1), Gf.Vec4f(-1, -1, -1, 0))
    assert told["sourceColorSpace"] == "raw"
    assert not stage.GetPrimAtPath("/room/varnish/Reader")


def _without_map(ball, normals):
    from dataclasses import replace

    return replace(ball, corner_normals=normals, material=replace(ball.material, normal=None))


def test_the_same_as_gltf_with_tangents(with_ball, tmp_path):
    output = packed(with_ball, tmp_path, "room.glb", low_poly=1000)
    tree = document(output)
    (node,) = (each for each in tree["nodes"] if each.get("name") == "ball")
    (part,) = tree["meshes"][node["mesh"]]["primitives"]
    tangents = tree["accessors"][part["attributes"]["TANGENT"]]
    assert (tangents["type"], tangents["componentType"]) == ("VEC4", 5126)
    assert tangents["count"] == tree["accessors"][part["attributes"]["POSITION"]]["count"]
    assert "_TANGENT" not in part["attributes"]
    assert "normalTexture" in tree["materials"][part["material"]]
    again = packed(with_ball, tmp_path, "again.glb", low_poly=1000)
    assert again.read_bytes() == output.read_bytes()


def test_boxes_keep_their_meshes_and_textures(with_ball, tmp_path):
    """They have few triangles already."""
    full = extracted(packed(with_ball, tmp_path), tmp_path / "full")
    low = extracted(packed(with_ball, tmp_path, low_poly=500), tmp_path / "low")
    here, there = surfaces_of(full), surfaces_of(low)
    assert here.keys() == there.keys()
    for name in here.keys() - {BALL}:
        assert np.array_equal(here[name].points, there[name].points)
        assert np.array_equal(here[name].material.diffuse, there[name].material.diffuse)
        assert there[name].material.normal is None


def test_a_material_of_two_meshes_becomes_two(with_ball, tmp_path):
    layer = Sdf.Layer.FindOrOpen(str(with_ball.asset.edits_layer))
    Sdf.CopySpec(layer, BALL, layer, "/room/twin")
    stage = Usd.Stage.Open(layer)
    UsdGeom.Xformable(stage.GetPrimAtPath("/room/twin")).ClearXformOpOrder()
    layer.Save()
    stage = extracted(packed(with_ball, tmp_path, low_poly=2000), tmp_path / "x")
    bound = [
        UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()[0]
        for path in (BALL, "/room/twin")
    ]
    assert [each.GetPath().name for each in bound] == ["varnish", "varnish_twin"]
    files = [
        UsdShade.Shader(each.GetPrim().GetChild("NormalTexture")).GetInput("file").Get().path
        for each in bound
    ]
    assert files[0] != files[1]


def test_meshes_whose_maps_cannot_be_carried_over_stay(with_ball, tmp_path, capsys):
    layer = Sdf.Layer.FindOrOpen(str(with_ball.asset.edits_layer))
    stage = Usd.Stage.Open(layer)
    shader = UsdShade.Shader(stage.GetPrimAtPath("/room/varnish/Surface"))
    node = UsdShade.Shader(stage.GetPrimAtPath("/room/varnish/Colour"))
    shader.CreateInput("opacity", Types.Float).ConnectToSource(node.ConnectableAPI(), "a")
    layer.Save()
    package(with_ball.asset.folder, tmp_path / "low.usdz", PackageOptions(low_poly=1000))
    told = capsys.readouterr().err
    assert re.search(r"stay as they are: </room/ball> has a texture whose alpha is used\.", told)


def _with_roughness(room, file, *, scale=None, kind="UsdUVTexture", inside="/room/varnish"):
    """A roughness that a node of its own reads, at coordinates scaled by ``scale``."""
    layer = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    stage = Usd.Stage.Open(layer)
    node = UsdShade.Shader.Define(stage, f"{inside}/Rough")
    node.CreateIdAttr(kind)
    if kind == "UsdUVTexture":
        node.CreateInput("file", Types.Asset).Set(f"./{file}")
        node.CreateInput("sourceColorSpace", Types.Token).Set("raw")
        node.CreateInput("wrapS", Types.Token).Set("repeat")
        node.CreateInput("wrapT", Types.Token).Set("repeat")
    source = UsdShade.Shader(stage.GetPrimAtPath("/room/varnish/Reader"))
    if scale:
        turned = UsdShade.Shader.Define(stage, "/room/varnish/Turned")
        turned.CreateIdAttr("UsdTransform2d")
        turned.CreateInput("scale", Types.Float2).Set(Gf.Vec2f(scale))
        turned.CreateInput("in", Types.Float2).ConnectToSource(source.ConnectableAPI(), "result")
        source = turned
    node.CreateInput("st", Types.Float2).ConnectToSource(source.ConnectableAPI(), "result")
    shader = UsdShade.Shader(stage.GetPrimAtPath("/room/varnish/Surface"))
    rough = shader.CreateInput("roughness", Types.Float)
    rough.ConnectToSource(node.ConnectableAPI(), "r" if kind == "UsdUVTexture" else "result")
    layer.Save()


def test_textures_of_one_name_stay_apart(with_ball, tmp_path, capfd):
    (with_ball.asset.folder / "textures/rough").mkdir()
    picture = np.full((8, 8, 3), 0.9, np.float32)
    write_exr(with_ball.asset.folder / "textures/rough/ball.exr", picture)
    _with_roughness(with_ball, "textures/rough/ball.exr")
    package(with_ball.asset.folder, tmp_path / "low.glb", PackageOptions(low_poly=1000))
    package(with_ball.asset.folder, tmp_path / "low.usdz", PackageOptions(low_poly=1000))
    assert "Warning: in" not in capfd.readouterr().err  # USD has nothing to say
    stage = Usd.Stage.Open(str(tmp_path / "low.usdz"))
    files = {
        str(UsdShade.Shader(prim).GetInput("file").Get().path)
        for prim in Usd.PrimRange(stage.GetPrimAtPath("/room/varnish"))
        if UsdShade.Shader(prim).GetShaderId() == "UsdUVTexture"
    }
    assert len(files) == 3  # colour, roughness, normals


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"scale": 4.0}, "has textures at several coordinates"),
        ({"kind": "UsdPrimvarReader_float"}, "reads values of its vertices"),
        ({"inside": "/room/shared"}, "has a material with nodes elsewhere"),
    ],
)
def test_what_has_no_one_place_on_the_coarse_mesh_stays(with_ball, tmp_path, capsys, change, told):
    _with_roughness(with_ball, "textures/ball.exr", **change)
    package(with_ball.asset.folder, tmp_path / "low.usdz", PackageOptions(low_poly=1000))
    assert f"stay as they are: </room/ball> {told}." in capsys.readouterr().err


def test_an_asset_of_few_triangles_stays(room, tmp_path, capsys):
    found = package(room.asset.folder, tmp_path / "low.usdz", PackageOptions(low_poly=1000))
    assert found["triangles"] == 36
    assert "the asset has 36 triangles, which stay as they are" in capsys.readouterr().err
    package(room.asset.folder, tmp_path / "full.usdz")
    assert (tmp_path / "low.usdz").read_bytes() == (tmp_path / "full.usdz").read_bytes()


@pytest.mark.parametrize("count", [0, -5, float("nan")])
def test_what_is_no_number_of_triangles(count):
    with pytest.raises(UsageError, match=r"--low-poly"):
        PackageOptions(low_poly=count)


def test_all_layers_as_they_are_hold_no_coarse_meshes(room, tmp_path):
    with pytest.raises(UsageError, match=r"without --low-poly.*package\.whole"):
        packed(room, tmp_path, whole=True, low_poly=100)


def test_in_acescg_only_colours_change(with_ball, tmp_path):
    both = [
        extracted(
            packed(with_ball, tmp_path, f"{space}.usdz", low_poly=1000, texture_space=space),
            tmp_path / space,
        )
        for space in ("rec709", "acescg")
    ]

    def pixels(stage, name):
        shader = UsdShade.Shader(stage.GetPrimAtPath(f"/room/varnish/{name}"))
        return read_exr(Path(shader.GetInput("file").Get().resolvedPath))

    same, other = ([pixels(s, n) for s in both] for n in ("NormalTexture", "Colour"))
    assert np.array_equal(*same)
    assert np.abs(other[0] - other[1]).max() > 0.05


def test_from_the_command_line(with_ball, tmp_path, capsys):
    output = tmp_path / "low.glb"
    command = ["package", str(with_ball.asset.folder), "-o", str(output), "--low-poly", "1000"]
    assert main([*command, "--json"]) == 0
    found = checked(capsys.readouterr().out, "package")
    assert 900 < found["triangles"] < 1100
    assert output.is_file()
