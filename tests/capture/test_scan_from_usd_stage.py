"""USD stages as captures, written by USD itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSemantics, Vt

from tests.capture.test_scan_from_scanner_app import make_export
from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage, scene_from_stage
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.options import IngestOptions
from usdbrdf.tasks.ingest import ingest
from usdbrdf.untrusted.usd_cameras import _camera


@pytest.fixture
def room():
    return truth()


def make_stage(path, room, *, parts=True, unit=1.0):
    """The room's meshes below /room; ``parts`` as prims, or else as subsets of one mesh."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/room").GetPrim())
    points = Vt.Vec3fArray.FromNumpy((room.points / unit).astype(np.float32))
    groups = enumerate(room.names) if parts else [(None, "all")]
    for i, name in groups:
        own = room.triangles if i is None else room.triangles[room.face_object == i]
        mesh = UsdGeom.Mesh.Define(stage, f"/room/{name}")
        mesh.CreatePointsAttr(points)
        mesh.CreateFaceVertexCountsAttr([3] * len(own))
        mesh.CreateFaceVertexIndicesAttr(own.ravel().tolist())
        mesh.CreateSubdivisionSchemeAttr("none")
    return stage


def _set_lens(camera, lens, *, time=None, aperture=36.0):
    """Written from the definition of a UsdGeomCamera, through the matrices that USD makes of it:
    the frustum's window has the picture's four sides."""
    fx, fy, cx, cy = lens
    sides = np.array([-cx / fx, (WIDTH - cx) / fx, (cy - HEIGHT) / fy, cy / fy])
    frustum = Gf.Frustum()
    frustum.window = Gf.Range2d(Gf.Vec2d(sides[0], sides[2]), Gf.Vec2d(sides[1], sides[3]))
    frustum.nearFar = Gf.Range1d(1.0, 10.0)
    made = Gf.Camera()
    made.SetFromViewAndProjectionMatrix(
        Gf.Matrix4d(1), frustum.ComputeProjectionMatrix(), aperture * Gf.Camera.FOCAL_LENGTH_UNIT
    )
    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    camera.CreateFocalLengthAttr().Set(made.focalLength, code)
    camera.CreateHorizontalApertureAttr().Set(made.horizontalAperture, code)
    camera.CreateVerticalApertureAttr().Set(made.verticalAperture, code)
    camera.CreateHorizontalApertureOffsetAttr().Set(made.horizontalApertureOffset, code)
    camera.CreateVerticalApertureOffsetAttr().Set(made.verticalApertureOffset, code)


def many_cameras(stage, room, *, unit=1.0, parent="/shots"):
    """Static cameras below a transform that scales, as scenes in centimetres have them."""
    group = UsdGeom.Xform.Define(stage, parent)
    group.AddScaleOp().Set(Gf.Vec3f(1 / unit))
    for i, pose in enumerate(room.world_from_camera):
        camera = UsdGeom.Camera.Define(stage, f"{parent}/IMG_{i:03d}")
        camera.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
        _set_lens(camera, room.intrinsics[i])


def test_many_cameras_find_their_pictures_by_name(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room, unit=0.01)
    many_cameras(stage, room, unit=0.01)
    stage.Save()
    for i, image in enumerate(room.images):
        for kind in ("exr", "jpg"):
            write_image(tmp_path / "shot" / "images" / f"IMG-{i:03d}.{kind}", image)
        write_image(tmp_path / "shot" / "images" / "thumbnails" / f"{i:03d}.png", image)
    assert choose_adapter(tmp_path / "shot").name == "usd"
    scan = read_scan(tmp_path / "shot" / "room.usda", IngestOptions())
    poses = room.world_from_camera.copy()
    poses[:, :3, 3] *= 100
    assert_same(scan, room, points=room.points * 100, poses=poses, names=room.names)
    assert (scan.adapter, scan.up_axis, round(scan.meters_per_unit, 9)) == ("usd", "Z", 0.01)
    assert scan.usd_geometry == tmp_path / "shot" / "room.usda"


def test_what_lies_in_hidden_folders_is_passed_over_but_not_a_capture_in_one(tmp_path, room):
    """As programs keep small pictures there; each name is in the capture twice then."""
    folder = tmp_path / ".cache" / "shot"
    stage = make_stage(folder / "room.usda", room)
    many_cameras(stage, room)
    stage.Save()
    for i, image in enumerate(room.images):
        for place in ("images", "images/.thumbnails"):
            write_image(folder / place / f"IMG-{i:03d}.exr", image)
    assert choose_adapter(folder).name == "usd"
    assert_same(read_scan(folder, IngestOptions()), room, names=room.names)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_camera_without_a_finite_place_costs_its_picture_alone(tmp_path, room, number):
    stage = make_stage(tmp_path / "room.usda", room)
    many_cameras(stage, room)
    (place,) = UsdGeom.Camera(stage.GetPrimAtPath("/shots/IMG_003")).GetOrderedXformOps()
    place.Set(Gf.Matrix4d(*[number] * 16))
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "images" / f"IMG-{i:03d}.exr", image)
    scan = read_scan(tmp_path / "room.usda", IngestOptions())
    assert_same(scan, room, poses=np.delete(room.world_from_camera, 3, axis=0), names=room.names)
    assert any("IMG_003': its pose is not a finite" in sentence for sentence in scan.warnings)


def test_cameras_find_their_pictures_by_the_prims_above(tmp_path, room):
    """As of Blender, whose data are called otherwise, or after another object."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    for i, pose in enumerate(room.world_from_camera):
        above = UsdGeom.Xform.Define(stage, f"/shots/IMG_{i:03d}")
        above.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
        camera = UsdGeom.Camera.Define(stage, f"/shots/IMG_{i:03d}/IMG_00{9 if i == 0 else ''}")
        _set_lens(camera, room.intrinsics[i])
        write_image(tmp_path / "shot" / "images" / f"IMG_{i:03d}.exr", room.images[i])
    stage.Save()
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room, names=room.names)


def moving_camera(stage, room, names=None):
    camera = UsdGeom.Camera.Define(stage, "/room/camera")
    op = camera.AddTransformOp()
    prim = camera.GetPrim()
    if names:
        prim.AddAppliedSchema("BackPlateAPI:photograph")
    for i, pose in enumerate(room.world_from_camera):
        op.Set(Gf.Matrix4d(pose.T.tolist()), 101 + i)
        _set_lens(camera, room.intrinsics[i], time=101 + i)
        if names:
            plate = prim.CreateAttribute("backPlate:photograph:image", Sdf.ValueTypeNames.Asset)
            plate.Set(Sdf.AssetPath(names[i]), 101 + i)


def test_a_moving_camera_has_its_back_plates(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usdc", room)
    moving_camera(stage, room, [f"./plates/{9 - i}.exr" for i in range(10)])
    for i in range(5):
        UsdGeom.Camera.Define(stage, f"/cameras/view_{i}")  # of the artist
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "plates" / f"{9 - i}.exr", image)
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room, names=room.names)


@pytest.mark.parametrize("plate", ["plates/p.####.exr", "plates/p.%04d.exr"])
def test_a_sequence_is_one_name_for_all_plates(tmp_path, room, plate):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    prim = stage.GetPrimAtPath("/room/camera")
    image = prim.CreateAttribute("houdini:backgroundimage", Sdf.ValueTypeNames.Asset)
    image.Set(Sdf.AssetPath(plate))
    stage.Save()
    for i, pixels in enumerate(room.images):
        write_image(tmp_path / "shot" / "plates" / f"p.{101 + i:04d}.exr", pixels)
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room)


def test_a_moving_camera_finds_pictures_by_number_in_another_place(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    stage.Save()
    for i, image in enumerate(room.images[:-1]):
        write_image(tmp_path / "plates" / f"plate.{101 + i:04d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions(frames=tmp_path / "plates"))
    assert_same(scan, room, poses=room.world_from_camera[:-1])
    assert scan.counts["poses_without_photograph"] == 1


FEW_KEYS = (1, 1.4, 10.0), (10, 2.6, 60.0), (19, 1.5, 130.0), (28, 1.6, 200.0)


def camera_with_few_keys(stage, room, keys=FEW_KEYS, pace=30):
    """Of each key its time, x and turn; y is 1 and a unit more per ``pace`` of time."""
    camera = UsdGeom.Camera.Define(stage, "/room/camera")
    place, turn = camera.AddTranslateOp(), camera.AddRotateXYZOp()
    for time, x, turned in keys:
        place.Set(Gf.Vec3d(x, 1 + time / pace, 1.5), time)
        turn.Set(Gf.Vec3f(72.0, 5.0, turned), time)
    _set_lens(camera, room.intrinsics[0])
    return camera


def named_plate(prim):
    prim.AddAppliedSchema("BackPlateAPI:photograph")
    return prim.CreateAttribute("backPlate:photograph:image", Sdf.ValueTypeNames.Asset)


def poses_at(camera, times):
    return np.array([np.array(camera.ComputeLocalToWorldTransform(t)).T for t in times])


def test_a_plates_name_lasts_and_its_picture_was_taken_when_it_begins(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    camera = camera_with_few_keys(stage, room)
    plate = named_plate(camera.GetPrim())
    for i, image in enumerate(room.images):
        plate.Set(Sdf.AssetPath(f"./plates/{9 - i}.exr"), 1 + 3 * i)
        write_image(tmp_path / "shot" / "plates" / f"{9 - i}.exr", image)
    stage.Save()
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room, poses=poses_at(camera, range(1, 29, 3)))


def test_a_sequence_that_is_named_by_one_of_its_pictures(tmp_path, room):
    """As of programs that keep the file which was chosen in the dialog."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    named_plate(stage.GetPrimAtPath("/room/camera")).Set(Sdf.AssetPath("./plates/p2.0103.exr"))
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "plates" / f"p2.{101 + i:04d}.exr", image)
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room)


def test_a_sequence_has_no_picture_between_its_numbers(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    camera = camera_with_few_keys(stage, room)
    for time in (1.25, 2.75):
        camera.GetOrderedXformOps()[0].Set(Gf.Vec3d(1.4 + time / 50, 1 + time / 30, 1.5), time)
    named_plate(camera.GetPrim()).Set(Sdf.AssetPath("./plates/p.####.exr"))
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "plates" / f"p.{1 + i:04d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room, poses=poses_at(camera, range(1, 11)))
    assert scan.counts["poses_without_photograph"] == 2


@pytest.mark.parametrize("before", [Sdf.ValueBlock(), Sdf.AssetPath("")])
def test_a_camera_without_a_plate_at_first_has_those_that_follow(tmp_path, room, before):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room, [f"./plates/{9 - i}.exr" for i in range(10)])
    prim = stage.GetPrimAtPath("/room/camera")
    prim.GetAttribute("backPlate:photograph:image").Set(before, 90)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "plates" / f"{9 - i}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    assert scan.counts["poses_without_photograph"] == 1


def test_one_sequence_may_follow_another(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    plate = named_plate(stage.GetPrimAtPath("/room/camera"))
    for name, time in (("a", 101), ("b", 106)):
        plate.Set(Sdf.AssetPath(f"./plates/{name}.####.exr"), time)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "plates" / f"{'ab'[i > 4]}.{101 + i:04d}.exr", image)
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room)


def test_a_plate_that_is_there_is_no_sequence_and_neither_is_a_folder(tmp_path, room):
    folder = tmp_path / "take #1"
    stage = make_stage(folder / "room.usda", room)
    moving_camera(stage, room, [f"./plates/%d/#{9 - i}.exr" for i in range(10)])
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(folder / "plates" / "%d" / f"#{9 - i}.exr", image)
    assert_same(read_scan(folder, IngestOptions()), room)


def test_the_second_camera_of_a_pair_without_pictures_is_told(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    for i, (image, pose) in enumerate(zip(room.images, room.world_from_camera, strict=True)):
        for side in ("left", "right"):
            camera = UsdGeom.Camera.Define(stage, f"/shots/{side}_{i}")
            camera.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
            _set_lens(camera, room.intrinsics[i])
            camera.CreateStereoRoleAttr(side)
        named_plate(stage.GetPrimAtPath(f"/shots/left_{i}")).Set(f"./plates/{i}.exr")
        write_image(tmp_path / "shot" / "plates" / f"{i}.exr", image)
    UsdGeom.Camera.Define(stage, "/views/persp")  # a program's own
    stage.Save()
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    assert any("10 cameras beside" in one and "/shots/right_0" in one for one in scan.warnings)


@pytest.mark.parametrize("plate", ["./plates/3.exr", f"./{'1' * 5000}.exr"])
def test_a_camera_that_moves_before_one_picture_is_left_out(tmp_path, room, plate):
    """Whose name may hold any number of digits."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    many_cameras(stage, room)
    for i, image in enumerate(room.images):
        prim = stage.GetPrimAtPath(f"/shots/IMG_{i:03d}")
        named_plate(prim).Set(Sdf.AssetPath(f"./plates/{i}.exr"))
        write_image(tmp_path / "shot" / "plates" / f"{i}.exr", image)
    moving_camera(stage, room)
    named_plate(stage.GetPrimAtPath("/room/camera")).Set(Sdf.AssetPath(plate))
    stage.Save()
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    assert any("'/room/camera': it names one picture for 10 times" in w for w in scan.warnings)


def test_a_sequence_in_a_stage_of_another_rate_has_its_whole_times(tmp_path, room):
    """Of a layer of 24 frames a second, in a stage of 25, 120 comes out as 125.00000000000001."""
    stage = make_stage(tmp_path / "shot" / "parts" / "room.usda", room)
    stage.SetTimeCodesPerSecond(24)
    keys = (120, 1.4, 10.0), (240, 2.6, 60.0), (360, 1.5, 130.0), (480, 1.6, 200)
    camera = camera_with_few_keys(stage, room, keys, pace=600)
    named_plate(camera.GetPrim()).Set(Sdf.AssetPath("../plates/p.####.exr"))
    stage.Save()
    whole = Usd.Stage.CreateNew(str(tmp_path / "shot" / "shot.usda"))
    whole.SetTimeCodesPerSecond(25)
    UsdGeom.SetStageUpAxis(whole, "Z")
    UsdGeom.SetStageMetersPerUnit(whole, 1.0)
    whole.GetRootLayer().subLayerPaths.append("./parts/room.usda")
    whole.SetDefaultPrim(whole.GetPrimAtPath("/room"))
    whole.Save()
    times = (125, 150, 200, 225, 250, 300, 375, 425, 450, 500)
    for time, image in zip(times, room.images, strict=True):
        write_image(tmp_path / "shot" / "plates" / f"p.{time:04d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    camera = UsdGeom.Camera(whole.GetPrimAtPath("/room/camera"))
    assert 125.0 not in UsdGeom.Xformable(camera).GetTimeSamples()
    assert_same(scan, room, poses=poses_at(camera, times))


def test_a_name_that_is_written_again_lasts(tmp_path, room):
    """As of programs that write every attribute at every frame."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/room/camera"))
    plate = named_plate(camera.GetPrim())
    for i in range(10):
        for time in (101 + i, 101.25 + i, 101.5 + i):
            plate.Set(Sdf.AssetPath(f"./plates/{9 - i}.exr"), time)
        write_image(tmp_path / "shot" / "plates" / f"{9 - i}.exr", room.images[i])
    stage.Save()
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room)


@pytest.mark.parametrize("written", ["once", "at each time"])
def test_a_camera_that_stands_still_has_one_picture_however_often_it_is_written(
    tmp_path, room, written
):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    many_cameras(stage, room)
    for i, (image, pose) in enumerate(zip(room.images, room.world_from_camera, strict=True)):
        camera = UsdGeom.Camera(stage.GetPrimAtPath(f"/shots/IMG_{i:03d}"))
        (place,) = camera.GetOrderedXformOps()
        plate = named_plate(camera.GetPrim())
        plate.Set(Sdf.AssetPath(f"./plates/IMG_{i:03d}.exr"))
        for time in range(12):
            place.Set(Gf.Matrix4d(pose.T.tolist()), time)
            _set_lens(camera, room.intrinsics[i], time=time)
            if written != "once":
                plate.Set(Sdf.AssetPath(f"./plates/IMG_{i:03d}.exr"), time)
        write_image(tmp_path / "shot" / "plates" / f"IMG_{i:03d}.exr", image)
    stage.Save()
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room)


def test_a_camera_that_usd_interpolates_between_equal_keys_stands_still():
    stage = Usd.Stage.CreateInMemory()
    camera = UsdGeom.Camera.Define(stage, "/camera")
    place, turn = camera.AddTranslateOp(), camera.AddRotateXYZOp()
    named_plate(camera.GetPrim()).Set(Sdf.AssetPath("/plates/IMG_003.exr"))
    for time in (0, 37):
        place.Set(Gf.Vec3d(0.1, 2.7182, 1.4142), time)
        turn.Set(Gf.Vec3f(72.123, 5.456, 130.789), time)
    assert len(np.unique(poses_at(camera, range(38)), axis=0)) > 1
    assert _camera(camera).images == ("/plates/IMG_003.exr",)
    place.Set(Gf.Vec3d(0.1, 2.7182, 1.5), 37)
    assert len(_camera(camera).images) == 38


def test_a_camera_with_few_keys_is_where_usd_interpolates_it(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    keys = (1, 1.4, 10.0), (6, 2.6, 60.0), (12, 1.5, 130.0)
    camera = camera_with_few_keys(stage, room, keys, pace=10)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"plate.{1 + i:04d}.exr", image)
    poses = poses_at(camera, range(1, 11))
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room, poses=poses)


@pytest.mark.parametrize(("pace", "first"), [(24, 0), (24, 1), (1, 1001), (1, 50)])
def test_pictures_counted_one_by_one_are_those_of_the_time_samples_in_order(
    tmp_path, room, pace, first
):
    """As a camera that is keyed once a second, and stills that were numbered by themselves; by
    number they would lie between its first two keys, or nowhere."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    keys = [(pace * i, 1.4 + 0.12 * i, 10 + 36.0 * i) for i in range(10)]
    camera = camera_with_few_keys(stage, room, keys, pace=pace * 10)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"p{first + i:04d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room, poses=poses_at(camera, range(0, 10 * pace, pace)))
    (told,) = (one for one in scan.warnings if "[capture.times]" in one)
    assert "time samples of their camera in order" in told


def test_pictures_between_keys_and_those_without_a_camera_are_told(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    keys = (1, 1.4, 10.0), (6, 2.6, 60.0), (12, 1.5, 130.0)
    camera_with_few_keys(stage, room, keys, pace=10)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"plate.{4 + i:04d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert len(scan.frames) == 9
    (told,) = (one for one in scan.warnings if "[capture.times]" in one)
    assert "7 of 9 pictures lie between the time samples" in told
    assert any("1 of 10 pictures have no camera" in one for one in scan.warnings)


def test_a_plate_that_comes_back_after_another_is_nobodys(tmp_path, room):
    """The others stay."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    names = "abcdaefghi"
    moving_camera(stage, room, [f"./plates/{name}.exr" for name in names])
    stage.Save()
    for name, image in zip(names, room.images, strict=True):
        write_image(tmp_path / "shot" / "plates" / f"{name}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room, poses=np.delete(room.world_from_camera, (0, 4), axis=0))
    (told,) = (one for one in scan.warnings if "[capture.duplicate]" in one)
    assert "2 of 10 frames dropped" in told
    assert "'a.exr' again, after another" in told


def test_a_moving_camera_that_names_the_picture_of_one_that_stands_is_left_out(tmp_path, room):
    """Whose number would make it the name of a sequence."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    many_cameras(stage, room)
    for i, image in enumerate(room.images):
        prim = stage.GetPrimAtPath(f"/shots/IMG_{i:03d}")
        named_plate(prim).Set(Sdf.AssetPath(f"./plates/{100 + i}.exr"))
        write_image(tmp_path / "shot" / "plates" / f"{100 + i}.exr", image)
    moving_camera(stage, room)
    named_plate(stage.GetPrimAtPath("/room/camera")).Set(Sdf.AssetPath("./plates/103.exr"))
    stage.Save()
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    assert any(
        "'/room/camera': it moves, and names pictures of /shots/" in w for w in scan.warnings
    )


def test_cameras_that_a_program_keeps_for_itself_are_no_lost_photographs(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    many_cameras(stage, room)
    for name in ("persp", "top", "front", "side", "lookdev"):
        UsdGeom.Camera.Define(stage, f"/views/{name}")
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"IMG_{i:03d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    assert scan.counts["poses_without_photograph"] == 5


def test_cameras_of_a_rig_have_pictures_by_their_names_and_numbers(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    rig = UsdGeom.Xform.Define(stage, "/rig")
    moves = rig.AddTransformOp()
    for i in range(5):
        moves.Set(Gf.Matrix4d(room.world_from_camera[i].T.tolist()), 1 + i)
    offset = np.eye(4)
    offset[:3, 3] = 0.1, 0, 0.05
    poses = []
    for name, pose in (("left", np.eye(4)), ("right", offset)):
        camera = UsdGeom.Camera.Define(stage, f"/rig/{name}")
        camera.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
        _set_lens(camera, room.intrinsics[0])
        poses += [room.world_from_camera[i] @ pose for i in range(5)]
    stage.Save()
    for i in range(5):
        write_image(tmp_path / "shot" / "images" / "left" / f"{i + 1:04d}.exr", room.images[i])
        name = f"right_{i + 1:04d}.exr"
        write_image(tmp_path / "shot" / "images" / name, room.images[5 + i])
    assert_same(read_scan(tmp_path / "shot", IngestOptions()), room, poses=np.array(poses))


def test_subsets_with_labels_are_objects(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room, parts=False)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/room/all"))
    for i, name in enumerate(room.names[:-1]):
        faces = np.flatnonzero(room.face_object == i).tolist()
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, f"part_{name}", "face", faces, "parts")
        UsdSemantics.LabelsAPI.Apply(subset.GetPrim(), "class").CreateLabelsAttr([f"a {name}"])
    # Another division of the same faces, which says nothing of objects.
    UsdGeom.Subset.CreateGeomSubset(mesh, "red", "face", [0, 1], "materialBind")
    many_cameras(stage, room)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"IMG_{i:03d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    names = (*(f"part_{name}" for name in room.names[:-1]), "all")
    assert_same(scan, room, names=names)
    assert {o.label: o.class_name for o in scan.objects} == {
        **{f"part_{name}": f"a {name}" for name in room.names[:-1]},
        "all": "",
    }
    assert scan.usd_geometry is None
    assert any("face subsets" in warning for warning in scan.warnings)
    for i, each in enumerate(scan.objects):
        faces = (room.face_object == names.index(each.label)).sum()
        assert (scan.mesh.face_object == i).sum() == faces


def test_labels_of_a_group_are_the_classes_of_its_meshes(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    UsdSemantics.LabelsAPI.Apply(stage.GetPrimAtPath("/room"), "category").CreateLabelsAttr(["hut"])
    lamp = stage.GetPrimAtPath("/room/lamp")
    lamp.CreateAttribute("semantic:Semantics:params:semanticData", Sdf.ValueTypeNames.String).Set(
        "light"
    )
    many_cameras(stage, room)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"IMG_{i:03d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert {o.class_name for o in scan.objects if o.label != "lamp"} == {"hut"}
    assert [o.class_name for o in scan.objects if o.label == "lamp"] == ["light"]


def test_a_mesh_from_elsewhere_has_the_unit_of_the_stage(tmp_path, room):
    stage = Usd.Stage.CreateNew(str(tmp_path / "room.usda"))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.1)
    many_cameras(stage, room)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "pictures" / f"IMG_{i:03d}.png", image)
    write_obj(tmp_path / "room.obj", room)
    options = IngestOptions(
        mesh=tmp_path / "room.obj", frames=tmp_path / "pictures", assume_srgb=True
    )
    scan = read_scan(tmp_path / "room.usda", options)
    assert_same(scan, room, names=room.names)
    assert (scan.up_axis, scan.meters_per_unit, scan.frames.radiometric) == ("Y", 0.1, False)


def _no_cameras(stage, room, folder):
    stage.RemovePrim("/shots")


def _orthographic(stage, room, folder):
    for i in range(len(room.world_from_camera)):
        camera = UsdGeom.Camera(stage.GetPrimAtPath(f"/shots/IMG_{i:03d}"))
        camera.CreateProjectionAttr("orthographic")


def _no_pictures(stage, room, folder):
    for path in folder.glob("images/*"):
        path.unlink()


def _other_names(stage, room, folder):
    for path in folder.glob("images/*"):
        path.rename(path.with_stem(f"view {path.stem}"))


def _plate_elsewhere(stage, room, folder):
    prim = stage.GetPrimAtPath("/shots/IMG_000")
    plate = prim.CreateAttribute("backPlate:photograph:image", Sdf.ValueTypeNames.Asset)
    plate.Set(Sdf.AssetPath("../../elsewhere.exr"))


def _no_mesh(stage, room, folder):
    for name in room.names:
        stage.RemovePrim(f"/room/{name}")


def _opencv_axes(stage, room, folder):
    for i, pose in enumerate(room.opencv):
        camera = UsdGeom.Xformable(stage.GetPrimAtPath(f"/shots/IMG_{i:03d}"))
        away = pose @ np.diag([-1.0, 1, -1, 1])  # and away from the room
        away[:3, 3] += 100 * away[:3, 2]
        camera.GetOrderedXformOps()[0].Set(Gf.Matrix4d(away.T.tolist()))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_cameras, r"no camera\..*\[stage.camera\]"),
        (_orthographic, r"10 cameras, none of them perspective.*\[stage.camera\]"),
        (_no_pictures, r"no pictures below .*--frames\. \[capture.frames\]"),
        (_other_names, r"none of 10 pictures.*belongs to any of 10 cameras.*\[capture.frames\]"),
        (_plate_elsewhere, r"leads outside the capture.*\[paths.outside\]"),
        (_no_mesh, r"no visible mesh.*--mesh\. \[mesh.empty\]"),
        (_opencv_axes, r"camera rays hit the mesh.*\[capture.convention\]"),
    ],
)
def test_refusals(tmp_path, room, damage, sentence):
    folder = tmp_path / "shot"
    stage = make_stage(folder / "room.usda", room)
    many_cameras(stage, room)
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"IMG_{i:03d}.exr", image)
    damage(stage, room, folder)
    stage.Save()
    with pytest.raises(InputRefused, match=sentence):
        read_scan(folder, IngestOptions())


def test_pictures_in_another_place_are_inputs_and_the_stage_is_referenced(tmp_path, room):
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "plates" / f"plate.{101 + i}.exr", image)
    asset = Asset(tmp_path / "asset", "room")
    options = IngestOptions(frames=tmp_path / "plates")
    assert ingest(tmp_path / "shot" / "room.usda", asset, options).summary["adapter"] == "usd"
    composed = open_weaker(asset, "texturing")
    np.testing.assert_allclose(
        frames_from_stage(composed).world_from_camera, room.world_from_camera, atol=1e-6
    )
    assert len(scene_from_stage(composed).objects) == len(room.names)
    assert not ingest(tmp_path / "shot" / "room.usda", asset, options).reran
    write_image(tmp_path / "plates" / "plate.103.exr", room.images[2] * 0.5)
    assert ingest(tmp_path / "shot" / "room.usda", asset, options).reran


def test_frames_that_a_format_does_not_ask_for_are_refused(tmp_path):
    export, _ = make_export(tmp_path)
    options = IngestOptions(frames=tmp_path / "elsewhere", assume_srgb=True)
    with pytest.raises(UsageError, match=r"'scanner-app' says itself.*\[usage.option\]"):
        read_scan(export, options)
    with pytest.raises(UsageError, match=r"no such folder.*\[usage.option\]"):
        read_scan(tmp_path / "capture", options)


@pytest.mark.parametrize(
    ("plate", "file", "told"),
    [
        ("./plates/P.####.EXR", "plates/p.{:04d}.exr", "10 pictures of other names"),
        ("./Plates/p.####.exr", "plates/p.{:04d}.exr", ""),
        ("D:\\shoot\\plates\\p.####.exr", "plates/p.{:04d}.exr", "lie elsewhere"),
        ("./plates/p.####.jpg", "plates/p.{:04d}.exr", "10 pictures of other names"),
    ],
)
def test_plates_are_found_by_other_spellings_of_their_names(tmp_path, room, plate, file, told):
    """As the pictures are that other documents name."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    moving_camera(stage, room)
    named_plate(stage.GetPrimAtPath("/room/camera")).Set(Sdf.AssetPath(plate))
    stage.Save()
    for i, pixels in enumerate(room.images):
        write_image(tmp_path / "shot" / file.format(101 + i), pixels)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    warnings = [said for said in scan.warnings if "[capture.file]" in said or "moved]" in said]
    assert len(warnings) == bool(told)
    assert not told or told in warnings[0]


def test_a_camera_named_by_its_picture_and_suffix_takes_no_other_picture(tmp_path, room):
    """A stray copy NAME.exr.exr has the suffix in its stem."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room)
    for i, pose in enumerate(room.world_from_camera):
        camera = UsdGeom.Camera.Define(stage, f"/shots/A{i}_exr")
        camera.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
        _set_lens(camera, room.intrinsics[i])
        write_image(tmp_path / "shot" / "images" / f"A{i}.exr", room.images[i])
    stage.Save()
    write_image(tmp_path / "shot" / "images" / "A0.exr.exr", room.images[5])
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert_same(scan, room)
    assert "A0.exr" in [path.name for path in scan.frames.image_paths]


@pytest.mark.parametrize("states", [True, False])
def test_a_stage_in_metres_that_does_not_say_so_is_told(tmp_path, room, states):
    """USD takes centimetres then, of which the room would be a toy."""
    stage = make_stage(tmp_path / "shot" / "room.usda", room, unit=1.0)
    many_cameras(stage, room)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    if not states:
        stage.ClearMetadata("metersPerUnit")
    stage.Save()
    for i, image in enumerate(room.images):
        write_image(tmp_path / "shot" / "images" / f"IMG_{i:03d}.exr", image)
    scan = read_scan(tmp_path / "shot", IngestOptions())
    assert scan.meters_per_unit == 0.01
    said = [sentence for sentence in scan.warnings if "[capture.unit]" in sentence]
    assert len(said) == (not states)
    assert states or "State --meters-per-unit 1 if it is" in said[0]
