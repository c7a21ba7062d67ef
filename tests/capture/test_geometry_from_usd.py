"""A capture whose geometry is USD, with materials and habits of its own."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from tests.scenes import edited, make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import scene_from_stage
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.parts import geometry_from_usd
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsageError, UsdBrdfError
from usdbrdf.model.mesh import face_normals_and_angles
from usdbrdf.options import IngestOptions
from usdbrdf.tasks.ingest import ingest
from usdbrdf.untrusted import bounds
from usdbrdf.untrusted.usd_files import layers_of_usd, meshes_from_usd, render_scene_of_usd


def _mesh(stage, path, points, counts, indices, **attributes):
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    mesh.CreateFaceVertexCountsAttr(list(map(int, counts)))
    mesh.CreateFaceVertexIndicesAttr(list(map(int, indices)))
    mesh.CreateSubdivisionSchemeAttr(attributes.get("scheme", "none"))
    return mesh


def _stage(path, **metadata):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, metadata.get("up_axis", "Z"))
    UsdGeom.SetStageMetersPerUnit(stage, metadata.get("meters_per_unit", 1.0))
    root = UsdGeom.Xform.Define(stage, "/scan")
    stage.SetDefaultPrim(root.GetPrim())
    return stage


@pytest.fixture
def capture(tmp_path):
    """The usual room, its mesh as USD: an Xform per object, bound to materials of its own."""
    made = make_capture(tmp_path / "room")
    (made.folder / "mesh.ply").unlink()
    (made.folder / "objects.json").unlink()
    stage = _stage(made.folder / "room.usda")
    red = UsdShade.Material.Define(stage, "/scan/Looks/red")
    for i, name in enumerate(made.names):
        own = made.triangles[made.face_object == i]
        group = UsdGeom.Xform.Define(stage, f"/scan/{name}")
        group.AddTranslateOp().Set(Gf.Vec3d(0, 0, i))
        lowered = made.points - np.float32([0, 0, i])
        mesh = _mesh(stage, f"/scan/{name}/surface", lowered, [3] * len(own), own.ravel())
        mesh.GetPrim().SetDisplayName(f"the {name}")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(
            red, UsdShade.Tokens.strongerThanDescendants
        )
    stage.Save()
    with edited(made.manifest) as document:
        document["mesh"] = "room.usda"
    return made


def test_geometry_stays_in_its_file_and_meshes_are_objects(capture):
    before = (capture.folder / "room.usda").read_bytes()
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.usd_geometry == capture.folder / "room.usda"
    assert scan.object_prims == tuple(f"{name}/surface" for name in capture.names)
    assert [o.label for o in scan.objects] == [f"the {name}" for name in capture.names]
    assert [o.identifier for o in scan.objects] == [f"the_{name}" for name in capture.names]
    assert len(scan.mesh.triangles) == len(capture.triangles)
    corner = scan.mesh.points[scan.mesh.triangles].reshape(-1, 3)
    np.testing.assert_allclose(corner.min(axis=0), [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(corner.max(axis=0), [4, 3, 2.5], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(scan.mesh.corner_normals, axis=2), 1, atol=1e-6)
    assert scan.counts["rays_hit_percent"] == 100
    assert (capture.folder / "room.usda").read_bytes() == before


def test_a_mesh_without_faces_is_left_out(capture, tmp_path):
    stage = Usd.Stage.Open(str(capture.folder / "room.usda"))
    _mesh(stage, "/scan/deleted", [], [], [])
    _mesh(stage, "/scan/points", np.eye(3), [], [])
    UsdGeom.Mesh.Define(stage, "/scan/nothing")
    stage.Save()
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.object_prims == tuple(f"{name}/surface" for name in capture.names)
    (said,) = (s for s in scan.warnings if "[stage.empty]" in s)
    assert "room.usda: 3 meshes have no faces and are left out, first </scan/deleted>" in said
    asset = Asset(tmp_path / "asset", "asset")
    ingest(capture.folder, asset, IngestOptions())
    scene = scene_from_stage(open_weaker(asset, "texturing"))
    assert len(scene.objects) == len(capture.names)


@pytest.mark.parametrize("scheme", ["none", "catmullClark"])
def test_holes_are_no_faces(capture, tmp_path, scheme):
    """Numbers of faces that do not exist are none of any."""
    stage = Usd.Stage.Open(str(capture.folder / "room.usda"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/scan/{capture.names[-1]}/surface"))
    mesh.GetSubdivisionSchemeAttr().Set(scheme)
    mesh.CreateHoleIndicesAttr([3, 5, -1, 99_999])
    stage.Save()
    scan = read_scan(capture.folder, IngestOptions())
    whole = capture.triangles[capture.face_object == len(capture.names) - 1]
    left = scan.mesh.triangles[scan.mesh.face_object == len(capture.names) - 1]
    expected = np.sort(capture.points[np.delete(whole, [3, 5], axis=0)].mean(axis=1), axis=0)
    found = np.sort(scan.mesh.points[left].mean(axis=1), axis=0)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    asset = Asset(tmp_path / "asset", "asset")
    ingest(capture.folder, asset, IngestOptions())
    scene = scene_from_stage(open_weaker(asset, "texturing"))
    assert len(scene.triangles) == len(capture.triangles) - 2


def test_referenced_geometry_is_not_reduced(capture):
    with pytest.raises(UsageError, match=r"--decimate .* \[usage.option\]"):
        read_scan(capture.folder, IngestOptions(decimate=10))


def test_units_axis_and_options(tmp_path):
    stage = _stage(tmp_path / "a.usdc", up_axis="Y", meters_per_unit=0.01)
    _mesh(stage, "/scan/m", np.eye(3), [3], [0, 1, 2])
    stage.Save()
    found = meshes_from_usd(tmp_path / "a.usdc")
    assert (found.up_axis, found.meters_per_unit) == ("Y", 0.01)
    assert [each.label for each in found.objects] == ["m"]
    assert (found.object_prims, found.warnings) == (("m",), ())


def test_polygons_normals_and_handedness(tmp_path):
    square = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    stage = _stage(tmp_path / "a.usda")
    _mesh(stage, "/scan/plain", square, [4], range(4))
    left = _mesh(stage, "/scan/left", square, [4], range(4))
    left.CreateOrientationAttr("leftHanded")
    mirrored = _mesh(stage, "/scan/mirrored", square, [4], range(4))
    mirrored.AddScaleOp().Set(Gf.Vec3f(2, 1, -1))
    shaded = _mesh(stage, "/scan/shaded", square, [4], range(4))
    shaded.AddScaleOp().Set(Gf.Vec3f(1, 1, 0.5))
    tilted = np.array([(1, 0, 1)] * 3 + [(0, 0, 1)], float)
    shaded.CreateNormalsAttr([Gf.Vec3f(*n) for n in tilted])
    shaded.SetNormalsInterpolation("faceVarying")
    wrong = _mesh(stage, "/scan/wrong", square, [4], range(4))
    wrong.CreateNormalsAttr([Gf.Vec3f(1, 0, 0)] * 3)
    stage.Save()
    given = meshes_from_usd(tmp_path / "a.usda").mesh.corner_normals.reshape(5, 2, 3, 3)
    assert np.isnan(given).all(axis=(1, 2, 3)).tolist() == [True, True, True, False, True]
    path, options = tmp_path / "a.usda", IngestOptions()
    mesh = geometry_from_usd(path, options, Findings(), capture_root=tmp_path).mesh
    normals = mesh.corner_normals.reshape(5, 2, 3, 3)  # object, triangle, corner
    np.testing.assert_allclose(normals[0], np.broadcast_to([0, 0, 1], (2, 3, 3)), atol=1e-6)
    np.testing.assert_allclose(normals[1], np.broadcast_to([0, 0, -1], (2, 3, 3)), atol=1e-6)
    np.testing.assert_allclose(normals[2], np.broadcast_to([0, 0, -1], (2, 3, 3)), atol=1e-6)
    steep = np.array([1, 0, 2]) / np.sqrt(5)
    np.testing.assert_allclose(normals[3, 0], [steep] * 3, atol=1e-6)
    np.testing.assert_allclose(normals[3, 1], [steep, steep, [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(normals[4], np.broadcast_to([0, 0, 1], (2, 3, 3)), atol=1e-6)
    # The winding agrees with the normals, whatever the handedness.
    p = mesh.points[mesh.triangles].astype(float)
    facing = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert ((facing[:, None] * mesh.corner_normals).sum(axis=2) > 0).all()


def test_polygons_that_are_not_convex_are_cut_with_all_that_goes_with_them(capture, tmp_path):
    """The floor is made an L of six corners and the rest of the square: the fan from the L's first
    corner would cover what is not of it."""
    stage = Usd.Stage.Open(str(capture.folder / "room.usda"))
    floor = UsdGeom.Mesh(stage.GetPrimAtPath("/scan/floor/surface"))
    z = float(np.array(floor.GetPointsAttr().Get())[:, 2].min())
    outline = [(1, 3), (0, 3), (0, 0), (4, 0), (4, 1), (1, 1)]
    points = [(x, y, z) for x, y in [*outline, (4, 3)]]
    floor.GetPointsAttr().Set([Gf.Vec3f(*point) for point in points])
    floor.GetFaceVertexCountsAttr().Set([6, 4])
    corners = [0, 1, 2, 3, 4, 5, 5, 4, 6, 0]
    floor.GetFaceVertexIndicesAttr().Set(corners)
    primvars = UsdGeom.PrimvarsAPI(floor.GetPrim())
    types = Sdf.ValueTypeNames
    at = primvars.CreatePrimvar("at", types.Float3Array, "faceVarying")
    at.Set([Gf.Vec3f(*points[corner]) for corner in corners])
    primvars.CreatePrimvar("of", types.IntArray, "uniform").Set([6, 4])
    UsdGeom.Subset.CreateGeomSubset(floor, "L", "face", [0], "materialBind")
    UsdGeom.Subset.CreateGeomSubset(floor, "rest", "face", [1], "materialBind")
    stage.Save()
    scan = read_scan(capture.folder, IngestOptions())
    own = scan.mesh.triangles[scan.mesh.face_object == capture.names.index("floor")]
    across = _across(scan.mesh.points[own])
    assert (across[:, 2] > 0).all()
    assert across[:4, 2].sum() == pytest.approx(2 * 6)
    asset = Asset(tmp_path / "asset", "asset")
    ingest(capture.folder, asset, IngestOptions())
    ours = open_weaker(asset, "texturing")
    scene = scene_from_stage(ours)
    np.testing.assert_allclose(
        scene.points[scene.triangles], scan.mesh.points[scan.mesh.triangles], atol=1e-6
    )
    mesh = next(
        UsdGeom.Mesh(prim)
        for prim in ours.Traverse()
        if prim.IsA(UsdGeom.Mesh) and "floor" in str(prim.GetPath())
    )
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    used = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    primvars = UsdGeom.PrimvarsAPI(mesh.GetPrim())
    np.testing.assert_array_equal(
        np.array(primvars.GetPrimvar("at").ComputeFlattened()), np.float32(points)[used]
    )
    assert list(primvars.GetPrimvar("of").Get()) == [6, 6, 6, 6, 4, 4]
    subsets = {s.GetPrim().GetName(): s for s in UsdGeom.Subset.GetAllGeomSubsets(mesh)}
    assert list(subsets["L"].GetIndicesAttr().Get()) == [0, 1, 2, 3]
    assert list(subsets["rest"].GetIndicesAttr().Get()) == [4, 5]


def _across(corners):
    """Along the normals of triangles (F, 3, 3), twice as long as their areas are large."""
    first, second, third = np.moveaxis(corners.astype(float), 1, 0)
    return np.cross(second - first, third - first)


def test_instances_are_objects_one_by_one(tmp_path):
    stage = _stage(tmp_path / "a.usda")
    stage.CreateClassPrim("/chair")
    _mesh(stage, "/chair/seat", np.eye(3), [3], [0, 1, 2])
    for i in range(2):
        chair = UsdGeom.Xform.Define(stage, f"/scan/chair_{i}")
        chair.AddTranslateOp().Set(Gf.Vec3d(5 * i, 0, 0))
        chair.GetPrim().GetReferences().AddInternalReference("/chair")
        chair.GetPrim().SetInstanceable(True)
    stage.Save()
    found = meshes_from_usd(tmp_path / "a.usda")
    assert found.object_prims == ("chair_0/seat", "chair_1/seat")
    assert found.mesh.points[:, 0].tolist() == [1, 0, 0, 6, 5, 5]


def test_what_is_left_out_is_said(tmp_path):
    stage = _stage(tmp_path / "a.usda")
    _mesh(stage, "/scan/cage", np.eye(3), [3], [0, 1, 2], scheme="catmullClark")
    UsdGeom.Cube.Define(stage, "/scan/cube")
    hidden = _mesh(stage, "/scan/hidden", np.eye(3), [3], [0, 1, 2])
    hidden.MakeInvisible()
    guide = _mesh(stage, "/scan/guide", np.eye(3), [3], [0, 1, 2])
    guide.CreatePurposeAttr("guide")
    _mesh(stage, "/elsewhere", np.eye(3), [3], [0, 1, 2])
    stage.Save()
    found = meshes_from_usd(tmp_path / "a.usda")
    assert found.object_prims == ("cage",)
    text = "\n".join(found.warnings)
    assert "</scan/cube> (Cube)" in text
    assert "1 meshes are subdivision cages" in text
    assert "2 invisible or guide prims" in text


def _no_default(stage):
    _mesh(stage, "/scan/m", np.eye(3), [3], [0, 1, 2])
    stage.GetRootLayer().ClearDefaultPrim()


def _instancer(stage):
    UsdGeom.PointInstancer.Define(stage, "/scan/copies")


def _bad(points, counts, indices):
    return lambda stage: _mesh(stage, "/scan/m", points, counts, indices)


def _asset(path):
    def author(stage):
        _mesh(stage, "/scan/m", np.eye(3), [3], [0, 1, 2])
        shader = UsdShade.Shader.Define(stage, "/scan/Looks/texture")
        shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(path))

    return author


def _missing_layer(stage):
    stage.GetDefaultPrim().GetReferences().AddReference("./missing.usda")


def _metadata(key, value):
    def author(stage):
        _mesh(stage, "/scan/m", np.eye(3), [3], [0, 1, 2])
        stage.GetRootLayer().pseudoRoot.SetInfo(key, value)

    return author


_NAN = [(np.nan, 0, 0), (1, 0, 0), (0, 1, 0)]


@pytest.mark.fault("S1")
@pytest.mark.parametrize(
    ("author", "rule", "words"),
    [
        (_no_default, "stage.default_prim", "Set defaultPrim"),
        (lambda stage: None, "mesh.empty", "no visible mesh below </scan>"),
        (_instancer, "stage.instancer", "</scan/copies>"),
        (_bad(_NAN, [3], [0, 1, 2]), "mesh.topology", "</scan/m> has 1 NaN"),
        (_bad(np.eye(3), [3], [0, 1, 99]), "mesh.topology", "outside its 3 points"),
        (_bad(np.eye(3), [3], [0, 1, -1]), "mesh.topology", "outside its 3 points"),
        (_bad(np.eye(3), [4], [0, 1, 2]), "mesh.topology", "3 corners where its faces need 4"),
        (_bad(np.eye(3), [2], [0, 1]), "mesh.topology", "a face of 2 corners"),
        (_bad(np.zeros((0, 3)), [], []), "mesh.empty", "no visible mesh with faces below </scan>"),
        (_bad(np.eye(3), [], [0, 1, 2]), "mesh.topology", "is empty"),
        (_asset("/etc/passwd"), "paths.outside", "'/etc/passwd' is an absolute path"),
        (_asset("../../secret.png"), "paths.outside", "leads outside"),
        (_asset("https://example.org/a.png"), "paths.outside", "is a URI"),
        (_missing_layer, "stage.input", "does not compose"),
        (_metadata("metersPerUnit", np.nan), "stage.units", "metersPerUnit is nan"),
        (_metadata("metersPerUnit", -1.0), "stage.units", "metersPerUnit is -1"),
        (_metadata("metersPerUnit", 1e300), "stage.units", "metersPerUnit is 1e+300"),
        (_metadata("upAxis", "X"), "stage.units", "upAxis is 'X'"),
    ],
)
def test_unusable_stages_are_refused(tmp_path, author, rule, words):
    (tmp_path / "capture").mkdir()
    stage = _stage(tmp_path / "capture" / "a.usda")
    author(stage)
    stage.Save()
    with pytest.raises(InputRefused, match=rf"a\.usda: .*\[{rule}\]$") as refused:
        meshes_from_usd(tmp_path / "capture" / "a.usda")
    assert words in str(refused.value)


def test_a_reference_may_lead_into_the_capture_but_not_beyond(tmp_path):
    for folder in ("geo", "lib"):
        (tmp_path / folder).mkdir()
    library = _stage(tmp_path / "lib" / "chair.usda")
    _mesh(library, "/scan/seat", np.eye(3), [3], [0, 1, 2])
    library.Save()
    stage = _stage(tmp_path / "geo" / "a.usda")
    stage.GetDefaultPrim().GetReferences().AddReference("../lib/chair.usda")
    stage.Save()
    with pytest.raises(InputRefused, match=r"\[paths.outside\]"):
        meshes_from_usd(tmp_path / "geo" / "a.usda")
    # A folder is allowed, not all whose names begin like it.
    (tmp_path / "li").mkdir()
    with pytest.raises(InputRefused, match=r"\[paths.outside\]"):
        meshes_from_usd(tmp_path / "geo" / "a.usda", allow=(tmp_path / "li",))
    found = meshes_from_usd(tmp_path / "geo" / "a.usda", allow=(tmp_path,))
    assert [each.label for each in found.objects] == ["seat"]


@pytest.mark.parametrize("content", [b"", b"#usda 1.0\ndef Xform {{{", b"PXR-USDC" + b"\xff" * 90])
def test_damaged_files_are_refused(tmp_path, content):
    (tmp_path / "a.usd").write_bytes(content)
    with pytest.raises(InputRefused, match=r"a\.usd.*\[(stage|child)\.[a-z_]+\]"):
        meshes_from_usd(tmp_path / "a.usd")


@pytest.mark.parametrize(
    "read",
    [
        meshes_from_usd,
        lambda file: layers_of_usd(file, ()),
        lambda file: render_scene_of_usd(file, "builtins:repr"),
    ],
    ids=["meshes", "layers", "scene"],
)
def test_every_reader_of_usd_is_stopped_at_the_limits(tmp_path, monkeypatch, read):
    stage = _stage(tmp_path / "a.usdc")
    _mesh(stage, "/scan/m", np.eye(3), [3], [0, 1, 2])
    stage.Save()

    def expect(kind, match, file_bytes=1 << 30, seconds=600.0, memory_bytes=64 << 30):
        limits = bounds.Limits(file_bytes, seconds, memory_bytes)
        monkeypatch.setitem(bounds.LIMITS, "stage", limits)
        with pytest.raises(kind, match=match):
            read(tmp_path / "a.usdc")

    expect(EnvironmentFailure, r"a\.usdc: .*\[child\.timeout\]$", seconds=0.01)
    # It runs out while the readers are loaded, or when they start.
    memory = r"a\.usdc: .*\[(environment\.memory|child\.start)\]$"
    expect(EnvironmentFailure, memory, memory_bytes=1 << 20)
    expect(InputRefused, r"the limit of a stage is 100.*\[stage\.size\]$", file_bytes=100)


def test_what_a_file_makes_of_a_few_bytes_is_limited(tmp_path, monkeypatch):
    """Sixty kilobytes that become a gigabyte, of which there is less."""
    stage = _stage(tmp_path / "a.usdc")
    _mesh(stage, "/scan/m", np.eye(3), [3], [0, 1, 2])
    many = Vt.IntArray(60_000_000, 1)
    UsdGeom.Mesh.Get(stage, "/scan/m").GetFaceVertexIndicesAttr().Set(many)
    stage.Save()
    assert (tmp_path / "a.usdc").stat().st_size < 1 << 20
    with pytest.raises(InputRefused, match=r"60000000 corners.*\[mesh\.topology\]$"):
        meshes_from_usd(tmp_path / "a.usdc")
    monkeypatch.setitem(bounds.LIMITS, "stage", bounds.Limits(1 << 30, 600.0, 1300 << 20))
    with pytest.raises(
        UsdBrdfError, match=r"\[(stage\.input|child\.\w+|environment\.memory)\]$"
    ) as found:
        meshes_from_usd(tmp_path / "a.usdc")
    assert found.value.exit_code in (3, 4)


def test_a_file_and_folders_that_usd_cannot_name_are_refused(tmp_path):
    for name in ("\udcff.usda", "\udcff/a.usda"):
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text("#usda 1.0")
        with pytest.raises(InputRefused, match=r"not UTF-8.*\[paths\.name\]$"):
            meshes_from_usd(file)


def test_faces_of_a_usd_mesh_that_look_away_are_turned_in_our_layer_alone(capture, tmp_path):
    expected = read_scan(capture.folder, IngestOptions())
    file = capture.folder / "room.usda"
    stage = Usd.Stage.Open(str(file))
    floor = UsdGeom.Mesh(stage.GetPrimAtPath("/scan/floor/surface"))
    indices = np.array(floor.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    indices[::2] = indices[::2][:, [0, 2, 1]]
    floor.GetFaceVertexIndicesAttr().Set(indices.ravel())
    UsdGeom.Mesh(stage.GetPrimAtPath("/scan/box/surface")).GetOrientationAttr().Set("leftHanded")
    stage.Save()
    before = file.read_bytes()
    scan = read_scan(capture.folder, IngestOptions())
    turned = np.zeros(len(scan.mesh.triangles), np.bool_)
    turned[np.flatnonzero(scan.mesh.face_object == capture.names.index("floor"))[::2]] = True
    turned[scan.mesh.face_object == capture.names.index("box")] = True
    np.testing.assert_array_equal(scan.turned_faces, turned)
    result = ingest(capture.folder, Asset(tmp_path / "asset", "asset"), IngestOptions())
    assert result.summary["counts"]["faces_turned"] == turned.sum()
    scene = scene_from_stage(open_weaker(Asset(tmp_path / "asset", "asset"), "texturing"))
    np.testing.assert_allclose(
        face_normals_and_angles(scene.points, scene.triangles)[0],
        face_normals_and_angles(expected.mesh.points, expected.mesh.triangles)[0],
        atol=1e-5,
    )
    np.testing.assert_allclose(
        scene.corner_normals[:, 0],
        face_normals_and_angles(scene.points, scene.triangles)[0],
        atol=1e-5,
    )
    assert file.read_bytes() == before


@pytest.mark.fault("S3")
@pytest.mark.parametrize("how", ["sublayer", "itself", "reference", "inherit"])
def test_layers_that_name_each_other_end_in_a_sentence(tmp_path, how):
    root = 'def Xform "scan" ({arc}) {{ def Mesh "m" {{}} }}'
    arcs = {"reference": "references = @./{other}@</scan>", "inherit": "inherits = </scan/m>"}
    for name, other in (("a.usda", "b.usda"), ("b.usda", "a.usda")):
        other = name if how == "itself" else other
        sub = f"subLayers = [@./{other}@]" if how in ("sublayer", "itself") else ""
        arc = arcs.get(how, "").format(other=other)
        text = f'#usda 1.0\n(\n defaultPrim = "scan"\n {sub}\n)\n{root.format(arc=arc)}\n'
        (tmp_path / name).write_text(text)
    with pytest.raises(InputRefused, match=r"a\.usda: .*\[(stage|mesh|child)\.\w+\]$"):
        meshes_from_usd(tmp_path / "a.usda")


@pytest.mark.fault("S3")
def test_prims_nested_beyond_reason_kill_a_child_and_nothing_else(tmp_path):
    depth = 200_000
    nested = 'def Xform "a" {\n' * depth + "}\n" * depth
    (tmp_path / "a.usda").write_text(f'#usda 1.0\n(\n defaultPrim = "a"\n)\n{nested}')
    with pytest.raises(InputRefused, match=r"a\.usda.*\[(child\.crashed|stage\.input)\]$"):
        meshes_from_usd(tmp_path / "a.usda")


def _usdz(path, entries, *, compressed=False):
    kind = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", kind) as package:
        for name, content in entries:
            package.writestr(name, content)


_ROOM = '#usda 1.0\n(\n defaultPrim = "scan"\n)\ndef Xform "scan" {}\n'


@pytest.mark.fault("S3")
@pytest.mark.parametrize("name", ["../evil.usda", "/evil.usda", "a/../../evil.usda", "..\\evil"])
def test_a_package_whose_entries_leave_it_is_refused_and_nothing_is_written(tmp_path, name):
    (tmp_path / "capture").mkdir()
    path = tmp_path / "capture" / "a.usdz"
    _usdz(path, [("room.usda", _ROOM), (name, _ROOM)])
    before = set(tmp_path.rglob("*"))
    with pytest.raises(InputRefused, match=r"a\.usdz: .*\[(paths|stage|mesh)\.\w+\]$"):
        meshes_from_usd(path)
    assert set(tmp_path.rglob("*")) == before
    assert not Path("/evil.usda").exists()


@pytest.mark.fault("S3")
def test_a_compressed_package_is_no_usdz_and_is_not_blown_up(tmp_path):
    """A quarter of a gigabyte of zeros in a thousandth of it: USD reads stored entries alone."""
    _usdz(tmp_path / "a.usdz", [("room.usda", _ROOM), ("b.usda", bytes(1 << 28))], compressed=True)
    assert (tmp_path / "a.usdz").stat().st_size < 1 << 19
    with pytest.raises(InputRefused, match=r"a\.usdz: .*\[(stage|mesh)\.\w+\]$"):
        meshes_from_usd(tmp_path / "a.usdz")


def test_subsets_of_several_meshes_stay_with_their_mesh(tmp_path):
    """Two meshes of four triangles; the first one of the first, the last three of the second."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scan").GetPrim())
    for name, own in (("a", [0]), ("b", [1, 2, 3])):
        mesh = UsdGeom.Mesh.Define(stage, f"/scan/{name}")
        mesh.CreatePointsAttr([(i % 3, i // 3, 0) for i in range(6)])
        mesh.CreateFaceVertexCountsAttr([3] * 4)
        mesh.CreateFaceVertexIndicesAttr([0, 1, 3, 1, 4, 3, 1, 2, 4, 2, 5, 4])
        mesh.CreateSubdivisionSchemeAttr("none")
        UsdGeom.Subset.CreateGeomSubset(mesh, f"part_of_{name}", "face", own, "objects")
    stage.Save()
    found = meshes_from_usd(tmp_path / "a.usda", subsets=True)
    names = [found.objects[i].label for i in found.mesh.face_object]
    assert names == ["part_of_a", "a", "a", "a", "b", "part_of_b", "part_of_b", "part_of_b"]


@pytest.mark.fault("G8")
def test_meshes_that_stand_where_single_precision_moves_them_are_refused(tmp_path):
    stage = _stage(tmp_path / "a.usda")
    _mesh(stage, "/scan/floor", [(0, 0, 0), (4, 0, 0), (4, 4, 0)], [3], [0, 1, 2])
    stage.Save()
    assert len(meshes_from_usd(tmp_path / "a.usda").mesh.triangles) == 1
    place = UsdGeom.Xformable(stage.GetDefaultPrim()).AddTranslateOp()
    place.Set(Gf.Vec3d(450_000, 5_400_000, 0))
    stage.Save()
    with pytest.raises(InputRefused, match=r"a\.usda: coordinates reach 5400004 .*\[mesh\.far\]$"):
        meshes_from_usd(tmp_path / "a.usda")


@pytest.mark.fault("S4")
def test_text_that_is_not_utf_8_ends_in_a_sentence(tmp_path):
    """USD hands bytes on as they are, also in what it says of them."""
    for i, text in enumerate((b'#usda 1.0\ndef "\xff" {}\n', b'#usda 1.0\n(\n doc = "\xb7\n)\n')):
        (tmp_path / f"{i}.usda").write_bytes(text)
        with pytest.raises(InputRefused, match=r"\.usda: .*\[(stage\.\w+|mesh\.empty)\]$"):
            meshes_from_usd(tmp_path / f"{i}.usda")


@pytest.mark.fault("I13")
@pytest.mark.parametrize(
    ("layer", "prim"),
    [
        ("subLayers = [@./pipe.usda@]", ""),
        ("", "references = @./pipe.usda@"),
        ("", "clips = { dictionary default = { asset[] assetPaths = [@./pipe.usda@] } }"),
    ],
)
def test_a_pipe_that_a_stage_names_is_not_waited_for(tmp_path, layer, prim):
    os.mkfifo(tmp_path / "pipe.usda")
    metadata = f'defaultPrim = "a"\n    metersPerUnit = 1\n    {layer}'
    text = f'#usda 1.0\n(\n    {metadata}\n)\ndef Xform "a" (\n    {prim}\n)\n{{\n}}\n'
    (tmp_path / "a.usda").write_text(text)
    with pytest.raises(InputRefused, match=r"pipe.usda: not a regular file.*\[stage.file\]$"):
        meshes_from_usd(tmp_path / "a.usda")
