"""Values that went into the stage come back from it."""

import math
from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from usdbrdf.asset.properties import TEXTURING, TexturedObject
from usdbrdf.asset.readers.compose import open_edited, open_measured, open_weaker
from usdbrdf.asset.readers.scene import (
    aov_path,
    read_aovs,
    read_fit,
    read_object,
    read_shading,
    scene_from_stage,
)
from usdbrdf.errors import InputRefused

# Texture coordinates are read with the scene.
read_texturing = partial(read_object, TexturedObject, TEXTURING, corner_uv=None)


def same(a, b):
    """Equality of records that hold arrays and NaN."""
    if type(a) is not type(b):
        return False
    for field in fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            if not np.array_equal(x, y):
                return False
        elif x != y and not (isinstance(x, float) and math.isnan(x) and math.isnan(y)):
            return False
    return True


@pytest.mark.parametrize(("unit", "up_axis"), [(1.0, "Z"), (0.01, "Y")])
def test_the_scene_is_the_scan_in_metres(tmp_path, synthetic, unit, up_axis):
    scan = synthetic.make_scan(tmp_path / "capture", unit=unit, up_axis=up_axis)
    built = synthetic.build(tmp_path / "room", scan)
    scene = scene_from_stage(open_weaker(built.asset, "texturing"))
    assert [o.label for o in scene.objects] == [o.label for o in scan.objects]
    assert [o.prim_path for o in scene.objects] == list(built.prims)
    assert [(o.first_face, o.num_faces) for o in scene.objects] == [(0, 12), (12, 12), (24, 12)]
    assert scene.corner_uv is None
    order = np.argsort(scan.mesh.face_object, kind="stable")
    np.testing.assert_allclose(
        scene.points[scene.triangles],
        scan.mesh.points[scan.mesh.triangles[order]] * np.float32(unit),
        rtol=1e-6,
    )
    np.testing.assert_allclose(scene.corner_normals, scan.mesh.corner_normals[order], atol=1e-6)
    np.testing.assert_array_equal(scene.face_object, scan.mesh.face_object[order])
    assert scene.triangles.dtype == np.int32
    assert scene.points.dtype == np.float32


def test_texture_coordinates_come_back_per_corner(built):
    scene = scene_from_stage(open_weaker(built.asset, "shading"))
    expected = np.concatenate([item.corner_uv for item in built.textured])
    np.testing.assert_array_equal(scene.corner_uv, expected)
    uv = Sdf.Layer.FindOrOpen(str(built.asset.uv_layer))
    values = uv.GetAttributeAtPath("/room/geo/wall/wall.primvars:st").default
    assert len(values) == len(np.unique(built.textured[1].corner_uv.reshape(-1, 2), axis=0))


def test_records_come_back(built):
    for textured, shaded, fitted in zip(built.textured, built.shaded, built.fitted, strict=True):
        stage = open_weaker(built.asset, "shading")
        read = read_texturing(stage, textured.prim_path)
        aovs = read_aovs(stage, textured.prim_path)
        assert sorted(aovs, key=str) == sorted(textured.aovs, key=str)
        assert read.texel_size == pytest.approx(textured.texel_size)
        assert read.resolution == textured.resolution
        assert read.seen == textured.seen

        stage = open_weaker(built.asset, "material")
        aovs = read_aovs(stage, shaded.prim_path)
        assert {a.name for a in aovs} >= {a.name for a in shaded.aovs}
        assert same(read_shading(stage, shaded.prim_path), replace(shaded, aovs=()))

        stage = open_measured(built.asset)
        assert {a.name for a in read_aovs(stage, fitted.prim_path)} >= {"diffuse", "base_color"}
        # The maps are read by themselves, and the mean colour is for the material alone.
        wanted = replace(fitted, aovs=(), mean_color=(0.0, 0.0, 0.0))
        assert same(read_fit(stage, fitted.prim_path), wanted)


def test_errors_and_confidence_come_back(built):
    stage = open_measured(built.asset)
    found = read_fit(stage, built.prims[0])
    assert (found.phi_error, found.psi_error) == (0.03125, 0.125)
    assert (found.phi_confidence, found.psi_confidence) == ("high", "low")
    # What is not known is not authored, so that no schema's fallback passes for a measurement.
    wall = stage.GetPrimAtPath(built.prims[1])
    for name in ("phi", "psi", "phiError", "psiError"):
        assert not wall.GetAttribute(f"usdBrdf:fit:{name}").HasAuthoredValue()
    assert math.isnan(read_fit(stage, built.prims[1]).phi_error)


def test_how_well_a_lamp_is_known(built):
    lamp = next(item for item in built.shaded if item.emitter)
    expected = {"measured": (False, None), "estimated": (False, 0.125), "lowerBound": (True, None)}
    for status, (bound, error) in expected.items():
        changed = {**lamp.__dict__, "radiance_status": status}
        built.shaded = tuple(
            type(lamp)(**changed) if item.emitter else item for item in built.shaded
        )
        built.write_layer("shading")
        stage = open_weaker(built.asset, "material")
        prim = stage.GetPrimAtPath(lamp.prim_path)
        assert prim.GetAttribute("usdBrdf:emitter:lowerBound").Get() is bound
        authored = prim.GetAttribute("usdBrdf:emitter:radianceError")
        assert authored.HasAuthoredValue() is (error is not None)
        read = read_shading(stage, lamp.prim_path)
        assert read.radiance_status == status
        if error is not None:
            assert read.radiance_error == error


def test_what_earlier_versions_did_not_author(built):
    lamp = next(item for item in built.shaded if item.emitter)
    stage = open_measured(built.asset)
    for bound, status in ((True, "lowerBound"), (False, "measured")):
        edited = without(built, stage, "emitter:radianceStatus", "fit:phiConfidence")
        edited.GetPrimAtPath(lamp.prim_path).GetAttribute("usdBrdf:emitter:lowerBound").Set(bound)
        assert read_shading(edited, lamp.prim_path).radiance_status == status
        found = read_fit(edited, built.prims[0])
        assert (found.phi_confidence, found.psi_confidence) == ("none", "low")


def without(built, stage, *names):
    """The stage flattened into one layer, with opinions about these attributes removed."""
    flat = Usd.Stage.Open(stage.Flatten())
    for path in built.prims:
        for name in names:
            flat.GetPrimAtPath(path).RemoveProperty(f"usdBrdf:{name}")
    return flat


def test_before_a_stage_ran_there_is_nothing_to_read(built):
    stage = open_weaker(built.asset, "texturing")
    for read in (read_texturing, read_shading, read_fit):
        assert read(stage, built.prims[0]) is None
    assert aov_path(stage, built.prims[0], "lit") is None


def test_maps_are_found_as_files(built):
    stage = open_weaker(built.asset, "shading")
    path = aov_path(stage, built.prims[0], "lit")
    assert path == built.asset.folder / "textures" / "Stuhl_No_1.lit.exr"
    assert path.is_file()
    path.unlink()
    assert aov_path(stage, built.prims[0], "lit") == path
    assert aov_path(stage, "/room/geo/wall/wall", "lit") is None


def test_a_stage_never_sees_its_own_layer_nor_the_artists(built):
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    prim = Sdf.CreatePrimInLayer(edits, "/room/geo/Stuhl_No_1/Stuhl_No_1")
    prim.SetInfo("active", False)
    edits.Save()
    weaker = open_weaker(built.asset, "shading")
    names = {layer.GetDisplayName() for layer in weaker.GetUsedLayers() if not layer.anonymous}
    scan = {"scan.usdc", "scan.interface.usda", "photographs.usdc"}
    assert names == scan | {"texturing.usda", "texturing_uv.usdc"}
    assert len(scene_from_stage(weaker).objects) == 3
    assert len(scene_from_stage(open_edited(built.asset)).objects) == 2


def test_a_layer_that_was_written_again_is_read_again(built):
    held = open_measured(built.asset)  # keeps the old layers alive, as a long session would
    before = read_fit(held, built.prims[0])
    built.fitted = tuple(type(f)(**{**f.__dict__, "cost": 0.75}) for f in built.fitted)
    built.write_layer("material")
    assert before.cost == 0.5
    assert read_fit(open_measured(built.asset), built.prims[0]).cost == 0.75


def test_a_missing_layer_is_named(built):
    built.asset.layer("texturing").unlink()
    with pytest.raises(InputRefused, match=r"texturing\.usda is missing.+\[asset\.incomplete\]"):
        open_weaker(built.asset, "shading")


def test_a_damaged_layer_is_named(built):
    built.asset.layer("texturing").write_text("#usda 1.0\nover nonsense {")
    with pytest.raises(InputRefused, match=r"texturing\.usda.+\[stage\.open\]"):
        open_weaker(built.asset, "shading")


def test_a_stage_without_our_objects_is_refused():
    with pytest.raises(InputRefused, match=r"usdBrdf:label.+\[stage\.objects\]"):
        scene_from_stage(Usd.Stage.CreateInMemory())


def labelled_mesh(stage, path, points, counts, indices):
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(counts)
    mesh.CreateFaceVertexIndicesAttr(indices)
    mesh.GetPrim().CreateAttribute("usdBrdf:label", Sdf.ValueTypeNames.String).Set("x")
    return mesh


SQUARE = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)]


def test_polygons_become_triangles_and_missing_normals_are_made():
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 0.5)
    labelled_mesh(stage, "/m", SQUARE, [4], [0, 1, 2, 3])
    scene = scene_from_stage(stage)
    np.testing.assert_array_equal(scene.triangles, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(scene.points.max(axis=0), [1, 1, 0])
    np.testing.assert_allclose(scene.corner_normals, np.broadcast_to([0, 0, 1], (2, 3, 3)))


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_triangles_are_counter_clockwise_seen_from_outside(left_handed, mirrored):
    """Outside is where the authored normals point; a mirror and the orientation both turn faces."""
    stage = Usd.Stage.CreateInMemory()
    indices = [3, 2, 1, 0] if left_handed else [0, 1, 2, 3]
    mesh = labelled_mesh(stage, "/m", SQUARE, [4], indices)
    mesh.CreateNormalsAttr([(0, 0, 1)] * 4)
    if left_handed:
        mesh.CreateOrientationAttr("leftHanded")
    mesh.AddScaleOp().Set((-3 if mirrored else 3, 1, 2))
    mesh.AddTranslateOp().Set((0, 0, 5))
    scene = scene_from_stage(stage)
    a, b, c = scene.points[scene.triangles].transpose(1, 0, 2)
    facing = np.cross(b - a, c - a)
    assert ((facing * scene.corner_normals[:, 0]).sum(axis=1) > 0).all()
    np.testing.assert_allclose(scene.corner_normals, np.broadcast_to([0, 0, 1], (2, 3, 3)))


@pytest.mark.parametrize(
    ("interpolation", "normals", "expected"),
    [
        ("vertex", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, -1)], [[2, 0, 1], [2, 1, -2]]),
        ("faceVarying", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, -1)], [[2, 0, 1], [2, 1, -2]]),
        ("uniform", [(1, 0, 0)], [[0, 0, 0], [0, 0, 0]]),
        ("constant", [(0, 1, 0)], [[1, 1, 1], [1, 1, 1]]),
        ("vertex", [(0, 0, 1)], [[2, 2, 2], [2, 2, 2]]),  # too few: made from the shape
    ],
)
def test_normals_of_every_interpolation(interpolation, normals, expected):
    stage = Usd.Stage.CreateInMemory()
    mesh = labelled_mesh(stage, "/m", SQUARE, [4], [0, 1, 2, 3])
    mesh.CreateNormalsAttr(normals)
    mesh.SetNormalsInterpolation(interpolation)
    axes = {0: (1, 0, 0), 1: (0, 1, 0), 2: (0, 0, 1), -2: (0, 0, -1)}
    wanted = [[axes[corner] for corner in triangle] for triangle in expected]
    np.testing.assert_allclose(scene_from_stage(stage).corner_normals, wanted, atol=1e-6)
