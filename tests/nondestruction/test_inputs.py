"""A USD input is read, never written: its files stay, and so does all that it can do."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdShade, UsdUtils

from tests.nondestruction import studio
from tests.nondestruction.conftest import COARSE, bytes_of, convert, photographed
from tests.scenes import ROOM
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_edited, open_weaker
from usdbrdf.asset.readers.scene import scene_from_stage
from usdbrdf.capture.adapters import read_scan
from usdbrdf.cli import main
from usdbrdf.options import IngestOptions
from usdbrdf.pipeline import working_on
from usdbrdf.tasks.ingest import ingest
from usdbrdf.untrusted.usd_files import meshes_from_usd
from usdbrdf.validation.rule import Severity
from usdbrdf.validation.validate import validate

OBJECTS = ("/haus/floor", "/haus/ceiling", "/haus/walls", "/haus/first/box", "/haus/second/box")
OBJECTS += ("/haus/bulb/lamp",)


@pytest.fixture(scope="module")
def made(base):
    """The capture, and the files of its geometry beside it with their hashes."""
    capture = photographed(base / "studio_scan")
    root = studio.build(capture, base / "studio")
    return capture, root, bytes_of(root.parent)


@pytest.fixture(scope="module")
def dressed(base, made):
    capture, root, _ = made
    return convert(capture.folder, base / "dressed" / "haus", "--mesh", str(root))


@pytest.fixture
def stage(dressed):
    opened = Usd.Stage.Open(str(dressed.root_layer))
    opened.SetEditTarget(opened.GetSessionLayer())
    return opened


def bound(stage: Usd.Stage, path: str) -> str:
    prim = stage.GetPrimAtPath(path)
    return str(UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].GetPath())


def test_no_byte_of_the_input_changes(made, dressed, tmp_path):
    capture, root, before = made
    files = {"haus.usda", "sub/shell.usda", "sub/tile.exr", "parts/box.usdc", "parts/lamp.usdc"}
    assert set(before) == files
    call = ["convert", str(capture.folder), "-o", str(dressed.folder), "--mesh", str(root)]
    assert main([*call, *COARSE, "--material", "measured"]) == 0
    assert main(["validate", str(dressed.folder)]) == 0
    assert bytes_of(root.parent) == before


def test_every_mesh_is_an_object_and_nothing_else_is(dressed):
    stage = open_edited(dressed)
    scene = scene_from_stage(open_weaker(dressed, "shading"))
    assert {item.prim_path for item in scene.objects} == set(OBJECTS)
    assert [item for item in validate(dressed.root_layer) if item.severity is Severity.ERROR] == []
    meshes = {str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
    assert meshes == set(OBJECTS)


def test_centimetres_with_y_up_are_metres_to_the_measurement(dressed):
    scene = scene_from_stage(open_weaker(dressed, "shading"))
    room = [item for item in scene.objects if item.prim_path in OBJECTS[:3]]
    points = np.concatenate([scene.points[scene.triangles[item.faces]] for item in room])
    extent = np.abs(np.ptp(points.reshape(-1, 3), axis=0))
    np.testing.assert_allclose(extent, np.array(ROOM)[[0, 2, 1]], atol=1e-5)


def test_instances_wear_materials_of_their_own(stage, made):
    assert bound(stage, "/haus/first/box") != bound(stage, "/haus/second/box")
    assert not stage.GetPrimAtPath("/haus/first").IsInstanceable()
    source = Usd.Stage.Open(str(made[1]))
    assert source.GetPrimAtPath("/haus/first").IsInstance()


@pytest.mark.parametrize(("name", "kind"), [("floor", "partition"), ("walls", "nonOverlapping")])
def test_subsets_stay_what_they_were_and_wear_ours(stage, name, kind):
    mesh = UsdGeom.Mesh.Get(stage, f"/haus/{name}")
    family = UsdShade.Tokens.materialBind
    assert UsdGeom.Subset.GetFamilyType(mesh, family) == kind
    valid, reason = UsdGeom.Subset.ValidateFamily(mesh, UsdGeom.Tokens.face, family)
    assert valid, reason
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    subsets = UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.face, family)
    assert len(subsets) == (2 if kind == "partition" else 1)
    for look in ("shaded", "lit"):
        looks.SetVariantSelection(look)
        for subset in subsets:
            assert bound(stage, str(subset.GetPath())) == bound(stage, f"/haus/{name}")


def test_the_inputs_own_materials_are_back_when_our_layers_are_muted(stage, dressed):
    stage.MuteAndUnmuteLayers(
        [str(dressed.layer(role)) for role in ("material", "shading", "texturing")], []
    )
    assert bound(stage, "/haus/floor/a") == "/haus/mtl/tiles"
    assert bound(stage, "/haus/ceiling") == "/haus/mtl/own"
    assert (
        stage.GetPrimAtPath("/haus/mtl/own/surface").GetAttribute("inputs:roughness").Get() == 0.25
    )


@pytest.mark.parametrize("path", OBJECTS)
def test_texture_coordinates_are_inside_and_nothing_shares_them(stage, path):
    """Whatever the input's were: outside, on top of one another, or none."""
    values = np.array(
        UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(path)).GetPrimvar("st").ComputeFlattened()
    )
    assert values.min() >= 0
    assert values.max() <= 1
    corners = values.reshape(-1, 3, 1, 2).astype(float)
    grid = (np.stack(np.meshgrid(*2 * [np.arange(64)]), axis=-1).reshape(-1, 2) + 0.5) / 64
    edges, arms = np.roll(corners, -1, axis=1) - corners, grid - corners
    sides = edges[..., 0] * arms[..., 1] - edges[..., 1] * arms[..., 0]
    inside = (sides.min(axis=1) > 1e-9) | (sides.max(axis=1) < -1e-9)
    assert inside.any()
    assert inside.sum(axis=0).max() == 1


@pytest.mark.parametrize("path", OBJECTS[:3])
def test_texture_coordinates_are_kept_where_they_are_fit(stage, made, path):
    """The ceiling's are; the floor's lie outside, and the walls' on top of one another."""
    source = Usd.Stage.Open(str(made[1]))
    theirs, ours = (
        np.array(UsdGeom.PrimvarsAPI(s.GetPrimAtPath(path)).GetPrimvar("st").ComputeFlattened())
        for s in (source, stage)
    )
    assert np.array_equal(theirs, ours) == (path == "/haus/ceiling")


def test_texture_coordinates_of_the_input_are_there_below_ours(stage, dressed, made):
    source = Usd.Stage.Open(str(made[1]))
    before = UsdGeom.PrimvarsAPI(source.GetPrimAtPath("/haus/floor"))
    stage.MuteLayer(str(dressed.uv_layer))
    stage.MuteLayer(str(dressed.layer("texturing")))
    after = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/haus/floor"))
    assert after.GetPrimvar("st").Get() == before.GetPrimvar("st").Get()


def test_a_payload_may_stay_unloaded(dressed):
    stage = Usd.Stage.Open(str(dressed.root_layer), Usd.Stage.LoadNone)
    assert not stage.GetCompositionErrors()
    assert not stage.GetPrimAtPath("/haus/first/box")
    # Ours, and not yet those of the input.
    stage.Load("/haus", Usd.LoadWithoutDescendants)
    assert not stage.GetPrimAtPath("/haus/first/box").IsDefined()
    stage.Load("/haus/first")
    assert stage.GetPrimAtPath("/haus/first/box").IsA(UsdGeom.Mesh)
    assert bound(stage, "/haus/first/box").startswith("/haus/geo/")


def test_another_variant_of_the_input_does_not_break_what_was_measured(stage):
    """Its points would meet our faces and texture coordinates."""
    mesh = UsdGeom.Mesh.Get(stage, "/haus/bulb/lamp")
    names = ("points", "extent", "faceVertexCounts", "faceVertexIndices", "primvars:st")
    before = [mesh.GetPrim().GetAttribute(name).Get() for name in names]
    stage.GetPrimAtPath("/haus/bulb").GetVariantSet("shape").SetVariantSelection("square")
    square = [mesh.GetPrim().GetAttribute(name).Get() for name in names]
    stage.GetPrimAtPath("/haus/bulb").GetVariantSet("shape").SetVariantSelection("pyramid")
    assert [mesh.GetPrim().GetAttribute(name).Get() for name in names] == before == square
    assert len(before[0]) == 4
    assert not stage.GetCompositionErrors()


def test_what_moves_is_said_and_stays_where_it_was_photographed(stage, made):
    (warning,) = meshes_from_usd(made[1]).warnings
    assert "1 meshes move or change with time, first </haus/bulb/lamp>" in warning
    assert "[stage.animated]" in warning
    lamp = UsdGeom.Xformable(stage.GetPrimAtPath("/haus/bulb/lamp"))
    for time in (Usd.TimeCode.Default(), 1, 3, 5):
        assert lamp.ComputeLocalToWorldTransform(time) == Gf.Matrix4d(1)


def test_render_settings_of_the_input_do_not_meet_ours(stage):
    ours = stage.GetMetadata("renderSettingsPrimPath")
    assert ours == "/haus/usdbrdf_render/capture"
    assert stage.GetPrimAtPath(ours).GetTypeName() == "RenderSettings"
    assert stage.GetPrimAtPath("/haus/render").GetTypeName() == "Scope"


def test_a_package_is_an_input_too(made, tmp_path):
    capture, root, _ = made
    package = tmp_path / "haus.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(root), str(package))
    before = package.read_bytes()
    asset = Asset.at(tmp_path / "haus")
    place = [str(capture.folder), "-o", str(asset.folder)]
    assert main(["ingest", "-q", *place, "--mesh", str(package)]) == 0
    assert main(["texture", "-q", str(asset.folder), "--texel-size", "0.2"]) == 0
    assert package.read_bytes() == before
    scene = scene_from_stage(open_weaker(asset, "shading"))
    assert {item.prim_path for item in scene.objects} == set(OBJECTS)
    assert [item for item in validate(asset.root_layer) if item.severity is Severity.ERROR] == []


def test_meshes_without_normals_get_those_that_are_measured_with(made, tmp_path):
    """Mirrored, left-handed or both; turned and stretched."""
    capture = made[0]
    file = tmp_path / "odd.usda"
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/odd").GetPrim())
    kinds = itertools.product((1, -1), ("rightHanded", "leftHanded"))
    for i, (mirror, side) in enumerate(kinds):
        mesh = UsdGeom.Mesh.Define(stage, f"/odd/roof_{i}")
        mesh.AddRotateYOp().Set(30.0)
        mesh.AddScaleOp().Set(Gf.Vec3f(mirror, 1, 2))
        mesh.CreatePointsAttr(
            [(0, 0, 0), (100, 20, 0), (100, 20, 100), (0, 0, 100), (200, 0, 0), (200, 0, 100)]
        )
        mesh.CreateFaceVertexCountsAttr([4, 4])
        mesh.CreateFaceVertexIndicesAttr([0, 3, 2, 1, 1, 2, 5, 4])
        mesh.CreateOrientationAttr(side)
        mesh.CreateSubdivisionSchemeAttr("none")
        # Too few to be used, as in files of careless exporters.
        mesh.CreateNormalsAttr([Gf.Vec3f(0, 1, 0)] * (i % 2))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    floor = UsdGeom.Mesh.Define(stage, "/odd/seen")
    floor.CreatePointsAttr([(-900, 0, -900), (900, 0, -900), (900, 0, 900), (-900, 0, 900)])
    floor.CreateFaceVertexCountsAttr([4])
    floor.CreateFaceVertexIndicesAttr([0, 3, 2, 1])
    stage.Save()
    with working_on(tmp_path / "odd") as asset:
        options = IngestOptions(mesh=file, crease_angle_deg=60.0)
        ingest(capture.folder, asset, options)
    expected = read_scan(capture.folder, options).mesh
    composed = open_weaker(Asset.at(tmp_path / "odd"), "texturing")
    for i in range(4):
        mesh = UsdGeom.Mesh.Get(composed, f"/odd/roof_{i}")
        assert len(mesh.GetNormalsAttr().Get()) == 12
    scene = scene_from_stage(composed)
    np.testing.assert_allclose(scene.corner_normals, expected.corner_normals, atol=1e-6)
    np.testing.assert_allclose(
        scene.points[scene.triangles], expected.points[expected.triangles] * 0.01, atol=1e-5
    )
