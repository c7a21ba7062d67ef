"""transforms.json in its dialects."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.scenes import as_mitsubas, edited, make_capture, rescale_images, room_mesh, write_ply
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.transforms import frame_records, matches
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, write_preview_png
from usdbrdf.options import IngestOptions


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "my room", exposure_times=(0.02, 0.08))


def test_everything_the_capture_says_arrives(capture):
    scan = read_scan(capture.folder, IngestOptions())
    assert (scan.name, scan.adapter, scan.up_axis) == ("my room", "transforms", "Z")
    assert scan.meters_per_unit == 1.0
    assert [o.identifier for o in scan.objects] == list(capture.names)
    assert [o.class_name for o in scan.objects] == list(capture.names)
    assert scan.mesh.points.tobytes() == capture.points.tobytes()
    assert scan.mesh.triangles.tobytes() == capture.triangles.tobytes()
    np.testing.assert_array_equal(scan.mesh.face_object, capture.face_object)
    frames = scan.frames
    np.testing.assert_allclose(frames.world_from_camera, capture.world_from_camera, atol=1e-12)
    np.testing.assert_allclose(frames.intrinsics, np.tile(capture.intrinsics, (12, 1)))
    assert frames.resolution.tolist() == [[32, 24]] * 12
    assert frames.exposure_time[:2].tolist() == [0.02, 0.08]
    assert frames.saturation_radiance[:2].tolist() == [64, 16]
    assert frames.noise_floor_radiance[:2].tolist() == [0.001, 0.00025]
    assert (frames.encoding, frames.radiometric) == ("lin_rec709_scene", True)
    pixels = read_frame(frames, 0)
    values = {tuple(value) for value in pixels.radiance.reshape(-1, 3).tolist()}
    assert values <= set(capture.radiance.values())
    assert pixels.valid.all()


def test_the_document_itself_can_be_named(capture):
    assert len(read_scan(capture.manifest, IngestOptions()).frames) == 12


@pytest.mark.parametrize(
    "mark",
    [
        {"from_mitsuba": True},
        {"normal_mts_args": [1, 2]},
        {"normal_mts_args": [1, 2], "from_mitsuba": False},
    ],
)
def test_cameras_that_instant_ngp_knows_as_mitsubas_look_the_other_way(capture, mark):
    """x to the left, y up, z forward; they passed for OpenGL's."""
    as_mitsubas(capture, mark)
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-12)


@pytest.mark.parametrize(
    ("key", "value"), [("ftheta_p0", 0.0), ("equirectangular", True), ("orthographic", True)]
)
def test_lenses_of_instant_ngp_that_are_not_read_are_refused(capture, key, value):
    """They passed for pinholes where an angle or a focal length stands beside them. The first
    coefficient of a polynomial that begins in its centre is 0."""
    with edited(capture.manifest) as document:
        del document["camera_model"]
        document[key] = value
    said = rf"has the camera model '{key}' \(known: PINHOLE.*\[capture\.camera\]$"
    with pytest.raises(InputRefused, match=said):
        read_scan(capture.folder, IngestOptions())


def _as_opencvs(capture):
    """The same poses with y down and z forward."""
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"] = (
                np.array(frame["transform_matrix"]) * [1, -1, -1, 1]
            ).tolist()


@pytest.mark.parametrize(
    ("key", "word"),
    [
        ("camera_convention", "opencv"),
        ("convention", "OpenCV c2w"),
        ("camera_coordinate_system", "RDF"),
        ("coordinate_convention", "COLMAP"),
    ],
)
def test_cameras_that_are_said_to_be_opencvs_are(capture, key, word):
    """They passed for OpenGL's without a word."""
    _as_opencvs(capture)
    with edited(capture.manifest) as document:
        document[key] = word
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-12)
    assert any(word in said and "[capture.convention]" in said for said in scan.warnings)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"camera_convention": "OpenGL"}, None),
        ({"camera_convention": "blender", "world_convention": "opencv"}, None),
        ({"camera_convention": {"x": "right"}}, None),
        ({"distortion_convention": "opencv", "pixel_convention": "colmap"}, None),
        ({"principal_point_convention": "opencv", "intrinsics_convention": "opencv"}, None),
        ({"depth_convention": "OpenCV", "naming_convention": "colmap"}, None),
        ({"point_cloud_coordinate_system": "opencv"}, None),
        ({"pose_convention": "world_to_camera"}, "not known here"),
    ],
)
def test_axes_that_are_stated_otherwise_are_opengls_and_what_is_unknown_is_told(
    capture, said, told
):
    with edited(capture.manifest) as document:
        document |= said
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-12)
    sentences = [one for one in scan.warnings if "[capture.convention]" in one]
    assert [told in one for one in sentences] == ([True] if told else [])


def test_two_conventions_are_refused(capture):
    with edited(capture.manifest) as document:
        document |= {"camera_convention": "opencv", "convention": "opengl"}
    with pytest.raises(InputRefused, match=r"states two conventions.*\[capture\.convention\]$"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize("stated", [{}, {"camera_convention": "blender"}])
def test_a_frame_may_state_no_other_convention_than_the_document(capture, stated):
    """It was passed over."""
    with edited(capture.manifest) as document:
        document |= stated
        document["frames"][3]["camera_convention"] = "opencv"
    with pytest.raises(
        InputRefused, match=r"frames\[3\] states.*'opencv'.*\[capture\.convention\]$"
    ):
        read_scan(capture.folder, IngestOptions())
    _as_opencvs(capture)
    with edited(capture.manifest) as document:
        document["camera_convention"] = "OpenCV"
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-12)


def test_a_mesh_that_is_no_name_does_not_matter_where_the_user_names_one(capture):
    with edited(capture.manifest) as document:
        document["mesh"] = ["a"]
    scan = read_scan(capture.folder, IngestOptions(mesh=capture.folder / "mesh.ply"))
    assert len(scan.frames) == 12
    with pytest.raises(InputRefused, match=r"mesh is not a file name.*\[capture\.format\]$"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize("rows", [3, 4])
def test_matrices_may_be_lists_of_their_numbers(capture, rows):
    """Row by row; such that have columns first are no poses."""
    applied = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 0.25], [0, 0, 0, 1]])
    with edited(capture.manifest) as document:
        document["applied_transform"] = applied[:rows].ravel().tolist()
        for frame in document["frames"]:
            pose = applied @ np.array(frame["transform_matrix"])
            frame["transform_matrix"] = pose[:rows].ravel().tolist()
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-9)
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            pose = np.reshape(frame["transform_matrix"], (rows, 4))
            frame["transform_matrix"] = pose.T.ravel().tolist()
    with pytest.raises(InputRefused, match=r"not a finite 4 x 4 camera matrix|sheared or scaled"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (np.eye(4).tolist(), False),
        (np.eye(3).tolist(), False),
        (np.diag([1.0, -1, -1, 1]).tolist(), False),
        ([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], True),
        (np.diag([2.0, 2, 2, 1]).tolist(), True),
        ("unknown", True),
    ],
)
def test_what_mapanything_did_to_poses_is_told(capture, matrix, told):
    with edited(capture.manifest) as document:
        document["_applied_transform"] = matrix
    scan = read_scan(capture.folder, IngestOptions())
    assert any("says that its poses were moved" in said for said in scan.warnings) == told


@pytest.mark.parametrize("text", ['{"scene": "room"}', '{"frames": 3}', "[]", "{"])
def test_a_scene_meta_of_another_program_is_no_capture(tmp_path, text):
    """It took captures from the adapters that are asked later."""
    (tmp_path / "scene_meta.json").write_text(text)
    assert not matches(tmp_path)


def test_scenes_of_mapanything_are_read(capture):
    """WAI: nerfstudio's document by another name, with OpenCV's cameras and keys of its own."""
    _as_opencvs(capture)
    with edited(capture.manifest) as document:
        document |= {
            "scene_name": "room", "dataset_name": "ours", "version": "0.1",
            "shared_intrinsics": True, "camera_convention": "opencv", "scene_modalities": {},
            "_applied_transform": np.eye(4).tolist(), "_applied_transforms": {},
        }  # fmt: skip
        for i, frame in enumerate(document["frames"]):
            frame |= {"frame_name": f"{i:04d}", "image": frame["file_path"]}
    capture.manifest.rename(capture.folder / "scene_meta.json")
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.adapter == "transforms"
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-12)


def test_poses_with_columns_first_are_called_so(capture):
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()
    with pytest.raises(InputRefused, match=r"its pose is transposed.*\[capture\.pose\]$"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize("key", ["sk_x", "skew"])
def test_skew_is_the_number_beside_the_focal_length(capture, key):
    """It was read as none."""
    with edited(capture.manifest) as document:
        document[key] = 3.0
    (record, *_) = frame_records(capture.manifest, IngestOptions(), Findings())
    fx, fy, cx, cy = capture.intrinsics
    matrix = np.array([[fx, 3.0, cx], [0, fy, cy], [0, 0, 1]])
    points = np.array([[0.2, -0.3, 1.0], [0.1, 0.4, 1.0], [-0.5, 0.1, 1.0]])
    imaged = record.lens.project(points * [1, -1, -1], record.intrinsics)
    np.testing.assert_allclose(imaged, (points @ matrix.T)[:, :2], atol=1e-9)


@pytest.mark.parametrize("focal", ["fl_x", "camera_angle_x", "x_fov"])
def test_skew_is_of_whatever_states_the_focal_length(capture, focal):
    """It was refused beside an angle."""
    fx, width = capture.intrinsics[0], 32
    angle = 2 * np.arctan(width / 2 / fx)
    value = {"fl_x": fx, "camera_angle_x": angle, "x_fov": np.degrees(angle)}[focal]
    with edited(capture.manifest) as document:
        for holder in (document, *document["frames"]):
            holder.pop("fl_x", None)
        document |= {"skew": 3.0, focal: value}
    (record, *_) = frame_records(capture.manifest, IngestOptions(), Findings())
    assert record.lens.skew == pytest.approx(3.0 / fx)


@pytest.mark.parametrize("key", ["b1", "p3", "sk_y"])
def test_terms_of_a_lens_that_are_not_read_are_refused_unless_they_are_nothing(capture, key):
    with edited(capture.manifest) as document:
        document[key] = 0
    assert len(read_scan(capture.folder, IngestOptions()).frames) == 12
    with edited(capture.manifest) as document:
        document["frames"][2][key] = 1e-3
    with pytest.raises(InputRefused, match=rf"has {key} 0\.001.*\[capture\.camera\]$"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize("angle", [45, 80])
def test_an_angle_in_degrees_is_no_other_angle(tmp_path, angle):
    """45 in radians has the tangent of an angle that a lens may have."""
    made = make_capture(tmp_path / "room")
    with edited(made.manifest) as document:
        for holder in (document, *document["frames"]):
            holder.pop("fl_x", None)
            holder.pop("fl_y", None)
        document["camera_angle_x"] = angle
    said = (
        rf"transforms\.json: camera_angle_x is {angle}, but it is in radians.*\[capture\.camera\]$"
    )
    with pytest.raises(InputRefused, match=said):
        read_scan(made.folder, IngestOptions())


def test_intrinsics_from_the_angle_and_from_the_image_header(capture):
    with edited(capture.manifest) as document:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del document[key]
        document["camera_angle_x"] = 2 * math.atan(0.5 * 32 / 19.2)
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.intrinsics[3], capture.intrinsics)


def test_angles_may_be_instant_ngps_degrees(capture):
    with edited(capture.manifest) as document:
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del document[key]
        document["x_fov"] = math.degrees(2 * math.atan(0.5 * 32 / 19.2))
        document["y_fov"] = math.degrees(2 * math.atan(0.5 * 24 / 19.2))
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.intrinsics[3], capture.intrinsics)
    with edited(capture.manifest) as document:
        document["y_fov"] = 190
    with pytest.raises(InputRefused, match="y_fov is 190, but it is in degrees, below 180"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize("model", ["pinhole", "Perspective", "opencv", None])
def test_camera_models_may_be_written_in_any_letters_or_left_open(capture, model):
    with edited(capture.manifest) as document:
        document["camera_model"] = model
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.intrinsics[3], capture.intrinsics)


def test_intrinsics_of_a_frame_come_before_those_of_all(capture):
    with edited(capture.manifest) as document:
        document["frames"][4].update(fl_x=21.0, fl_y=22.0, cx=15.0, cy=11.0)
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.intrinsics[4].tolist() == [21, 22, 15, 11]
    np.testing.assert_allclose(scan.frames.intrinsics[5], capture.intrinsics)


@pytest.mark.fault("I7")
@pytest.mark.parametrize("factor", [0.5, 2])
def test_images_scaled_by_one_number_have_their_intrinsics_scaled(capture, factor):
    rescale_images(capture, factor)
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.resolution.tolist() == [[32 * factor, 24 * factor]] * 12
    np.testing.assert_allclose(scan.frames.intrinsics[3], factor * capture.intrinsics)
    (warning,) = scan.warnings
    assert f"{32 * factor:.0f} x {24 * factor:.0f} pixels" in warning
    assert "12 of 12 frames" in warning


@pytest.mark.fault("I7")
@pytest.mark.parametrize("factor", [0.5, 2])
@pytest.mark.parametrize("state", ["cx, cy", "angle"])
def test_images_of_another_size_are_noticed_where_no_size_is_stated(capture, factor, state):
    with edited(capture.manifest) as document:
        for key in ("w", "h", *(("cx", "cy") if state == "angle" else ())):
            del document[key]
        if state == "angle":
            document["camera_angle_x"] = 2 * math.atan(0.5 * 32 / document["fl_x"])
    assert len(read_scan(capture.folder, IngestOptions()).frames) == 12
    rescale_images(capture, factor)
    with pytest.raises(InputRefused, match=r"of about 32 pixels.* state the w and h.*size\]$"):
        read_scan(capture.folder, IngestOptions())


def test_applied_transform_and_scale_are_undone(capture):
    applied = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, -2], [0, -1, 0, 3], [0, 0, 0, 1]])
    with edited(capture.manifest) as document:
        document["applied_transform"] = applied[:3].tolist()
        document["applied_scale"] = 2.0
        for frame in document["frames"]:
            stored = applied @ np.array(frame["transform_matrix"])
            stored[:3, 3] *= 2
            frame["transform_matrix"] = stored.tolist()
    scan = read_scan(capture.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-9)


def test_where_no_up_axis_is_stated_it_is_that_of_upright_cameras(capture):
    from_z_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    assert read_scan(capture.folder, IngestOptions()).warnings == ()
    points, triangles, face_object, _ = room_mesh()
    write_ply(capture.folder / "mesh.ply", points @ from_z_up[:3, :3].T, triangles, face_object)
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"] = (from_z_up @ np.array(frame["transform_matrix"])).tolist()
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.up_axis == "Y"
    assert any("--up-axis Z" in warning for warning in scan.warnings)
    scan = read_scan(capture.folder, IngestOptions(up_axis="Z"))
    assert (scan.up_axis, scan.warnings) == ("Z", ())
    with edited(capture.manifest) as document:
        document["up_axis"] = "Y"
    scan = read_scan(capture.folder, IngestOptions())
    assert (scan.up_axis, scan.warnings) == ("Y", ())


@pytest.mark.fault("C2")
def test_almost_rigid_poses_are_snapped_and_the_user_hears_of_it(capture):
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"][0][0] += 2e-4
    scan = read_scan(capture.folder, IngestOptions())
    axes = scan.frames.world_from_camera[:, :3, :3]
    gram = np.einsum("nij,nik->njk", axes, axes)
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (12, 1, 1)), atol=1e-12)
    assert any("made rigid" in warning for warning in scan.warnings)


def test_opencv_without_distortion_is_a_pinhole(capture):
    with edited(capture.manifest) as document:
        document.update(camera_model="OPENCV", k1=0, k2=0.0, p1=0, p2=0)
    assert len(read_scan(capture.folder, IngestOptions()).frames) == 12


def test_options_come_before_the_document(capture, tmp_path):
    (capture.folder / "mesh.ply").rename(tmp_path / "fused.ply")
    (capture.folder / "objects.json").rename(tmp_path / "names.json")
    with edited(tmp_path / "names.json") as document:
        document["objects"] = document["objects"][:2]
    options = IngestOptions(
        mesh=tmp_path / "fused.ply",
        objects=tmp_path / "names.json",
        up_axis="Y",
        meters_per_unit=0.01,
        encoding="lin_ap1_scene",
    )
    scan = read_scan(capture.folder, options)
    names = [o.identifier for o in scan.objects]
    assert names == ["floor", "ceiling", "object_2", "object_3", "object_4"]
    assert (scan.up_axis, scan.meters_per_unit) == ("Y", 0.01)
    assert scan.frames.encoding == "lin_ap1_scene"


@pytest.mark.fault("I10")
def test_photographs_need_a_word_of_consent(capture):
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            image = np.clip(read_exr(capture.image(i)) * 255, 0, 255).astype(np.uint8)
            frame["file_path"] = f"frames/{i:04d}.png"
            write_preview_png(capture.folder / frame["file_path"], image)
    with pytest.raises(InputRefused, match=r"0000\.png: .* --assume-srgb\. \[capture\.ldr\]"):
        read_scan(capture.folder, IngestOptions())
    scan = read_scan(capture.folder, IngestOptions(assume_srgb=True))
    assert (scan.frames.radiometric, scan.frames.encoding) == (False, "srgb_rec709_scene")
    assert any("not radiometric" in warning for warning in scan.warnings)
    with edited(capture.manifest) as document:
        document["frames"][0]["file_path"] = "frames/0000.exr"
    with pytest.raises(InputRefused, match="images of one kind"):
        read_scan(capture.folder, IngestOptions(assume_srgb=True))


def test_frames_without_saturation_are_accepted_with_a_warning(capture):
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            del frame["saturation_radiance"], frame["exposure_time"]
    scan = read_scan(capture.folder, IngestOptions())
    assert np.isinf(scan.frames.saturation_radiance).all()
    assert (scan.frames.exposure_time == 1).all()
    assert any("no saturation" in warning for warning in scan.warnings)


@pytest.mark.parametrize("encoding", ["acesfilm", "srgb_rec709_scene"])
def test_an_encoding_that_cannot_be_is_a_usage_error(capture, encoding):
    with pytest.raises(UsageError, match=rf"--encoding '?{encoding}.*\[usage.option\]"):
        read_scan(capture.folder, IngestOptions(encoding=encoding))


def test_labels_may_come_as_a_list(capture):
    with edited(capture.folder / "objects.json") as document:
        document["face_object_id"] = [4] * 100 + [-1] * (len(capture.triangles) - 100)
    scan = read_scan(capture.folder, IngestOptions())
    assert [o.label for o in scan.objects] == ["unlabelled", "box"]
    assert np.bincount(scan.mesh.face_object).tolist() == [len(capture.triangles) - 100, 100]


@pytest.mark.fault("S5")
def test_names_of_any_kind_pass_through_the_whole_reader(tmp_path):
    capture = make_capture(tmp_path / "a #1 [x] é 椅子")
    with edited(capture.folder / "objects.json") as document:
        for entry, name in zip(
            document["objects"], ["椅子", "../x", "", "chair/é", "chair/é"], strict=True
        ):
            entry["name"] = name
    scan = read_scan(capture.folder, IngestOptions())
    identifiers = [o.identifier for o in scan.objects]
    assert len(set(identifiers)) == 5
    assert all(name.isidentifier() and name.isascii() for name in identifiers)
    assert [o.label for o in scan.objects][:3] == ["椅子", "../x", "object_2"]


@pytest.mark.parametrize("tiles", [True, False])
def test_pictures_may_be_cut_out_of_larger_ones(tmp_path, tiles):
    """The axis of such lies outside of them, or in the corner of some; in that of all it is an
    offset from the middle."""
    made = make_capture(tmp_path)
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame["cx"], frame["cy"] = (-5, 12) if tiles and i else (2, 1)
    if not tiles:
        with pytest.raises(InputRefused, match=r"not from its middle.*\[capture\.camera\]$"):
            read_scan(made.folder, IngestOptions())
        return
    scan = read_scan(made.folder, IngestOptions())
    assert len(scan.frames) == len(document["frames"])
    assert any("lie outside of their images, as of crops alone" in said for said in scan.warnings)
