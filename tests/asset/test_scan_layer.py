"""The capture as USD: meshes, camera, photographs, and the way back."""

import os
from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdMedia

from usdbrdf.asset.layers.scan_layer import is_edited
from usdbrdf.asset.layout import Asset, relative_path
from usdbrdf.asset.readers.compose import open_edited, open_weaker
from usdbrdf.asset.readers.scene import capture_camera, frames_from_stage, scene_from_stage
from usdbrdf.errors import InputRefused

UNITS = [(1.0, "Z"), (0.01, "Y")]


def stage_of(built):
    return Usd.Stage.Open(str(built.asset.root_layer))


def test_every_object_is_one_mesh_with_its_own_points(built):
    stage = stage_of(built)
    mesh = UsdGeom.Mesh.Get(stage, "/room/geo/Stuhl_No_1/Stuhl_No_1")
    points = np.array(mesh.GetPointsAttr().Get())
    assert len(points) == 8
    assert len(mesh.GetFaceVertexCountsAttr().Get()) == 12
    np.testing.assert_array_equal(
        mesh.GetExtentAttr().Get(), [points.min(axis=0), points.max(axis=0)]
    )
    assert mesh.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.none
    assert mesh.GetNormalsInterpolation() == UsdGeom.Tokens.faceVarying
    assert not mesh.GetDoubleSidedAttr().Get(), "it is closed"
    valid, reason = UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), len(points)
    )
    assert valid, reason


def test_copies_of_a_point_are_merged_and_the_surface_stays(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "capture")
    apart = replace(
        scan.mesh,
        points=scan.mesh.points[scan.mesh.triangles].reshape(-1, 3),
        triangles=np.arange(3 * len(scan.mesh.triangles), dtype=np.int32).reshape(-1, 3),
    )
    built = synthetic.build(tmp_path / "room", replace(scan, mesh=apart), upto="scan")
    scene = scene_from_stage(open_weaker(built.asset, "texturing"))
    assert len(scene.points) == 3 * 8
    order = np.argsort(scan.mesh.face_object, kind="stable")
    np.testing.assert_array_equal(
        scene.points[scene.triangles], scan.mesh.points[scan.mesh.triangles[order]]
    )


def test_only_what_encloses_nothing_has_two_sides(tmp_path, synthetic):
    """The chair loses a triangle: it has an edge now, through which one sees its back."""
    scan = synthetic.make_scan(tmp_path / "capture")
    own = np.flatnonzero(scan.mesh.face_object == 0)
    kept = np.delete(np.arange(len(scan.mesh.triangles)), own[3])
    mesh = replace(
        scan.mesh,
        triangles=scan.mesh.triangles[kept],
        corner_normals=scan.mesh.corner_normals[kept],
        face_object=scan.mesh.face_object[kept],
    )
    built = synthetic.build(tmp_path / "room", replace(scan, mesh=mesh), upto="scan")
    stage = stage_of(built)
    two_sided = [UsdGeom.Mesh.Get(stage, p).GetDoubleSidedAttr().Get() for p in built.prims]
    assert two_sided == [True, False, False]


def test_names_classes_and_kinds(built):
    stage = stage_of(built)
    prim = stage.GetPrimAtPath("/room/geo/Stuhl_No_1/Stuhl_No_1")
    assert prim.GetDisplayName() == "Stuhl Nº 1"
    assert prim.GetAttribute("usdBrdf:label").Get() == "Stuhl Nº 1"
    assert prim.GetAttribute("usdBrdf:class").Get() == "chair"
    assert list(prim.GetAttribute("semantics:labels:class").Get()) == ["chair"]
    assert prim.HasAPI("UsdBrdfObjectAPI")
    assert not prim.GetAttribute("usdBrdf:label").IsCustom()
    kinds = [
        Usd.ModelAPI(stage.GetPrimAtPath(p)).GetKind()
        for p in ("/room", "/room/geo", "/room/geo/wall")
    ]
    assert kinds == ["assembly", "group", "component"]
    # An unknown class is not written as an empty label.
    assert not stage.GetPrimAtPath("/room/geo/lamp/lamp").HasAPI("SemanticsLabelsAPI")


def test_an_object_without_faces_is_left_out(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "capture")
    mesh = replace(scan.mesh, face_object=np.where(scan.mesh.face_object == 1, 0, 2))
    built = synthetic.build(tmp_path / "room", replace(scan, mesh=mesh), upto="scan")
    scene = scene_from_stage(open_weaker(built.asset, "texturing"))
    assert [o.identifier for o in scene.objects] == ["Stuhl_No_1", "lamp"]


@pytest.mark.parametrize(("unit", "up_axis"), UNITS)
def test_the_camera_projects_as_the_pinhole_does(tmp_path, synthetic, unit, up_axis):
    scan = synthetic.make_scan(tmp_path / "capture", unit=unit, up_axis=up_axis)
    stage = stage_of(synthetic.build(tmp_path / "room", scan, upto="scan"))
    camera = capture_camera(stage)
    points = scan.mesh.points[2:].astype(float)
    for i in range(len(scan.frames)):
        frustum = camera.GetCamera(float(i + 1)).frustum
        matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
        clip = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ matrix
        width, height = scan.frames.resolution[i]
        in_image = (clip[:, :2] / clip[:, 3:] * [1, -1] + 1) / 2 * [width, height]

        pose = scan.frames.world_from_camera[i]
        seen = (points - pose[:3, 3]) @ pose[:3, :3]
        fx, fy, cx, cy = scan.frames.intrinsics[i]
        expected = [cx - fx * seen[:, 0] / seen[:, 2], cy + fy * seen[:, 1] / seen[:, 2]]
        np.testing.assert_allclose(in_image, np.transpose(expected), atol=2e-4)


def test_the_exposure_of_every_sample_is_one(built):
    stage = stage_of(built)
    camera = capture_camera(stage)
    for time in [Usd.TimeCode.Default(), *map(float, range(1, len(built.scan.frames) + 1))]:
        assert camera.ComputeLinearExposureScale(time) == pytest.approx(1.0, rel=1e-6)
    assert camera.GetExposureTimeAttr().Get(2.0) == pytest.approx(1 / 250)


def test_what_does_not_vary_has_no_samples(built):
    stage = stage_of(built)
    prim = capture_camera(stage).GetPrim()
    assert prim.GetAttribute("xformOp:transform").GetTimeSamples() == [1, 2, 3]
    assert prim.GetAttribute("focalLength").GetTimeSamples() == [1, 2, 3]
    assert prim.GetAttribute("horizontalAperture").GetTimeSamples() == []
    assert prim.GetAttribute("usdBrdf:capture:resolution").GetTimeSamples() == []


@pytest.mark.parametrize(("unit", "up_axis"), UNITS)
@pytest.mark.parametrize("folder", ["room", "Zimmer é 椅子 (1)"])
def test_frames_come_back_in_metres(tmp_path, synthetic, unit, up_axis, folder):
    scan = synthetic.make_scan(tmp_path / "Aufnahme ü", unit=unit, up_axis=up_axis)
    built = synthetic.build(tmp_path / folder, scan, upto="scan")
    frames = frames_from_stage(open_weaker(built.asset, "texturing"))
    expected = scan.frames.world_from_camera.copy()
    expected[:, :3, 3] *= unit
    np.testing.assert_allclose(frames.world_from_camera, expected, atol=1e-12)
    np.testing.assert_allclose(frames.world_from_camera[0, :3, 3], [0, 0.2, 5.0])
    assert frames.image_paths == scan.frames.image_paths
    for name in ("intrinsics", "resolution", "exposure_time"):
        np.testing.assert_array_equal(getattr(frames, name), getattr(scan.frames, name))
    for name in ("saturation_radiance", "noise_floor_radiance"):
        np.testing.assert_array_equal(getattr(frames, name), getattr(scan.frames, name))
    assert frames.encoding == scan.frames.encoding
    assert frames.radiometric


def test_photographs_that_are_not_radiometric_are_marked(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "capture")
    dull = replace(scan.frames, radiometric=False, encoding="srgb_rec709_scene")
    built = synthetic.build(tmp_path / "room", replace(scan, frames=dull), upto="scan")
    frames = frames_from_stage(stage_of(built))
    assert not frames.radiometric
    assert frames.encoding == "srgb_rec709_scene"
    layer = Sdf.Layer.FindOrOpen(str(built.asset.layer("scan")))
    assert layer.customLayerData["usdbrdf"]["radiometric"] is False


def test_a_photograph_that_is_gone_keeps_its_path(built):
    built.scan.frames.image_paths[1].unlink()
    frames = frames_from_stage(open_edited(built.asset))
    assert frames.image_paths == built.scan.frames.image_paths


def test_the_asset_finds_its_photographs_after_both_moved_together(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "a" / "capture")
    built = synthetic.build(tmp_path / "a" / "out" / "room", scan, upto="scan")
    (tmp_path / "a").rename(tmp_path / "b")
    moved = Asset(tmp_path / "b" / "out" / "room", built.asset.name)
    frames = frames_from_stage(open_weaker(moved, "texturing"))
    assert len(frames.image_paths) == 3
    assert all(path.is_file() for path in frames.image_paths)


def test_paths_pass_through_links_to_folders(tmp_path):
    (tmp_path / "disk" / "asset" / "layers").mkdir(parents=True)
    (tmp_path / "work").symlink_to(tmp_path / "disk" / "asset")
    image = tmp_path / "frame.exr"
    image.touch()
    relative = relative_path(image, tmp_path / "work" / "layers")
    assert relative == "../../../frame.exr"
    real = os.path.realpath(tmp_path / "work" / "layers")
    assert os.path.samefile(os.path.join(real, relative), image)


def test_a_file_name_that_usd_cannot_hold_is_refused(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "capture")
    paths = (tmp_path / "two\nlines.exr", *scan.frames.image_paths[1:])
    scan = replace(scan, frames=replace(scan.frames, image_paths=paths))
    with pytest.raises(InputRefused, match=r"two\\nlines.+Rename.+\[stage\.asset_path\]"):
        synthetic.build(tmp_path / "room", scan, upto="scan")


def test_render_settings_show_the_capture(built):
    stage = stage_of(built)
    settings = stage.GetPrimAtPath(stage.GetMetadata("renderSettingsPrimPath"))
    assert settings.GetTypeName() == "RenderSettings"
    assert settings.GetAttribute("resolution").Get() == Gf.Vec2i(8, 6)
    (product,) = settings.GetRelationship("products").GetTargets()
    names = [
        path.name
        for path in stage.GetPrimAtPath(product).GetRelationship("orderedVars").GetTargets()
    ]
    assert names == ["beauty", "diffuse", "specular", "emission", "albedo", "normal", "depth"]
    assert settings.GetAttribute("renderingColorSpace").Get() == "lin_rec709_scene"
    (camera,) = settings.GetRelationship("camera").GetTargets()
    assert stage.GetPrimAtPath(camera) == capture_camera(stage).GetPrim()


def test_the_photographs_are_muted_plates_of_the_camera(built):
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    edits.subLayerPaths = [f"./layers/{built.asset.photographs_layer.name}"]
    edits.Save()
    stage = stage_of(built)
    camera = capture_camera(stage).GetPrim()
    assert "BackPlateAPI:photograph" in camera.GetMetadata("apiSchemas").GetAppliedItems()
    plate = camera.GetAttribute("backPlate:photograph:image")
    image = camera.GetAttribute("usdBrdf:capture:image")
    assert plate.GetTimeSamples() == image.GetTimeSamples() == [1, 2, 3]
    for time in (Usd.TimeCode.Default(), 1, 2, 3):
        assert plate.Get(time) == image.Get(time)
        assert not os.path.isabs(plate.Get(time).path)
    assert camera.GetAttribute("backPlate:photograph:plateVisibility").Get() == "mute"


def test_the_thumbnail_is_there(built):
    stage = stage_of(built)
    previews = UsdMedia.AssetPreviewsAPI(stage.GetDefaultPrim())
    thumbnail = previews.GetDefaultThumbnails().defaultImage
    assert thumbnail.path == "../previews/lit.png"
    assert os.path.isfile(thumbnail.resolvedPath)
    # What the scan layer says of the asset is not lost.
    assert stage.GetDefaultPrim().GetAssetInfo()["name"] == "room"


def test_it_is_known_whether_an_artist_wrote_anything(built):
    assert not is_edited(built.asset)
    before = built.asset.edits_layer.read_text()
    built.asset.edits_layer.write_text(before + '\nover "elsewhere" {}\n')
    assert is_edited(built.asset)
    built.asset.edits_layer.unlink()
    assert is_edited(built.asset)
