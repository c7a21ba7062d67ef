"""What people name that is no capture: the sentence says what lies there and what to do."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.scenes import make_capture
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.delivery.publish import publish
from usdbrdf.errors import InputRefused
from usdbrdf.job.stamp import STATE_FOLDER
from usdbrdf.options import IngestOptions, InspectOptions
from usdbrdf.tasks.inspect import inspect

DOCUMENTS = [
    ("castle.nvm", "NVM_V4\n\n11\n", "VisualSFM", "COLMAP"),
    ("castle.baf", "1\n11\n", "Meshroom", "cameras.sfm"),
    ("castle.mg", '{"header": {}}', "Meshroom", "cameras.sfm"),
    ("sfm_data.bin", "\x00", "OpenMVG", "ConvertSfM_DataFormat"),
    ("mine.json", '[{"cameras": {}, "shots": {}}]', "OpenSfM", "reconstruction.json"),
    ("1234.json", '{"t_00": 1, "fx": 700, "blur_score": 5}', "Polycam", "holds keyframes/"),
    ("metadata.json", '{"K": [], "poses": []}', "Record3D", "in which rgb/ lies beside it"),
    ("room.r3d", "PK\x03\x04", "Record3D", "which is a ZIP file"),
    ("metadata", '{"K": [], "poses": []}', "Record3D", "the folder that has metadata and rgbd/"),
    ("scene0000_00.sens", "\x04", "ScanNet", "reader.py (--export_color_images --export_poses"),
    ("groundtruth.txt", "# ground truth trajectory\n", "TUM RGB-D", "a transforms.json"),
    ("run.txt", "#\n# timestamp tx ty tz qx qy qz qw\n", "TUM RGB-D", "fuse the depths"),
    ("frame-000000.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "7-Scenes", "fuse the"),
    ("color.traj", "1.5 0.1 0.2 0.3 0 0 0\n", "ARKitScenes", "the video's folder"),
    ("41254.1_2.pincam", "256 192 211 211 128 96\n", "ARKitScenes", "the video's folder"),
    ("cameras.json", '[{"id": 0, "img_name": "1"}]', "Gaussian splatting", "trained on"),
    ("meta_data.json", '{"frames": [{"camtoworld": []}]}', "SDFStudio", "COLMAP"),
    ("cameras_sphere.npz", "PK\x03\x04", "NeuS", "COLMAP"),
    ("cameras.npz", "PK\x03\x04", "IDR", "COLMAP"),
    ("room.psx", '<document version="1.2.0"/>', "Metashape", "Export Cameras"),
    ("room.rcproj", "<RealityCaptureProject/>", "RealityScan", "camera parameters"),
    ("scene.mvs", "MVS", "OpenMVS", "COLMAP"),
    ("at.xmz", "PK\x03\x04", "ContextCapture", "Unzip it"),
    ("opk.txt", "# Label X Y Z Omega Phi Kappa\n", "Metashape", "Export Cameras"),
    ("a_calibrated_external_camera_parameters.txt", "imageName X", "Pix4D", "1_initial/params/"),
    (
        "a.csv",
        "#cameras 1\n#name,X/Lon,Y/Lat,Z/Alt,yaw,pitch,roll\n",
        "RealityScan",
        "the lens too",
    ),
    ("d.csv", "Name,X,Y,Z,Omega,Phi,Kappa\n", "RealityScan", "camera parameters"),
    ("e.csv", "#name,x,y,z\n", "RealityScan", "camera parameters"),
    ("b.csv", "# name, x, y, z, omega, phi, kappa\n", "RealityScan", "camera parameters"),
    ("c.txt", "imageName X Y Z Omega Phi Kappa\n", "Pix4D", "1_initial/params/"),
    ("shots.geojson", '{"type": "FeatureCollection"}', "OpenDroneMap", "reconstruction.json"),
    ("Orientation-1.jpg.xml", "<?xml?>\n<ExportAPERO>\n", "MicMac", "COLMAP"),
    ("pose_intrinsic_imu.json", '{"0": {}}', "ScanNet++'s telephone", "holds dslr/"),
    (
        "traj_w_c.txt",
        "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n",
        "Replica for Semantic-NeRF",
        "mesh in it",
    ),
    ("poses.txt", "#timestamp x y z qx qy qz qw id\n1 0 0 0 0 0 0 1 1\n", "RTAB-Map", "beside it"),
    (
        "scene_00000_00.jsonl",
        '{"timestamp": 1, "intrinsics": [], "exposure_duration": 0.01}',
        "MultiScan",
        "the video's frames",
    ),
    ("recording.vrs", "Vision", "Project Aria", "projectaria_tools"),
    ("data.jsonl", '{"time": 1.0}', "Spectacular AI", "sai-cli process"),
    ("1.json", '{"orientation": [[1]], "pixel_aspect_ratio": 1}', "Nerfies", "a transforms.json"),
    ("camera_path.json", '{"keyframes": []}', "nerfstudio's renders", "of the photographs"),
    ("extri.yml", "%YAML:1.0\n", "EasyMocap", "a transforms.json"),
    ("CameraTrajectory.txt", "1.5 0 0 0 0 0 0 1\n", "ORB-SLAM", "fuse the"),
    ("poses.txt", "1e0 0 0 0 0 1 0 0 0 0 1 0\n", "KITTI", "a transforms.json"),
    ("data.csv", "#timestamp, p_RS_R_x [m]", "EuRoC", "a transforms.json"),
    ("run.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n", "Stray Scanner", "odometry.csv"),
    ("pano-poses.csv", "# pano poses v1.0: ID; filename", "NavVis", "EQUIRECTANGULAR"),
    ("00000000_cam.txt", "extrinsic\n1 0 0 0\n", "MVSNet", "a transforms.json"),
    ("metadata_cameras.csv", "camera_name\ncam_00\n", "Hypersim", "a transforms.json"),
    ("sensors.txt", "# kapture format: 1.1\n", "kapture", "kapture_export_colmap"),
    ("meta.ini", "# MVE view meta data\n", "MVE", "COLMAP"),
    ("00000000.txt", "CONTOUR\n1 0 0 0\n", "PMVS", "COLMAP"),
    ("0000.jpg.camera", "1 0 0\n", "Strecha's benchmark", "a transforms.json"),
    ("scan_alignment.mlp", "<!DOCTYPE MeshLabDocument>", "MeshLab", "a transforms.json"),
    ("run.bag", "#ROSBAG V2.0\n", "ROS", "COLMAP"),
    ("shot.blend", "BLENDER-v400", "Blender", "as USD"),
    ("shot.hiplc", "070707", "Houdini", "as USD"),
    ("shot.ma", "//Maya ASCII 2024 scene\n", "Maya", "as USD"),
    ("shot.c4d", "QC4D", "Cinema 4D", "as USD"),
    ("shot.chan", "1 0 0 0 0 0 0 50\n", "Nuke", "as USD"),
    ("00.txt", 3 * "1e0 0 0 0 0 1 0 0 0 0 1 0\n", "KITTI", "a transforms.json"),
    ("trajectory_gt.txt", 3 * f"{'1.5 ' * 16}\n", "Replica for NICE-SLAM", "traj.txt"),
    ("groundtruth.txt", 3 * "1311868164.36 0 0 0 0 0 0 1\r\n", "TUM RGB-D", "fuse the"),
    (
        "0007.txt",
        3 * "1 0 -0.5 1e-3\n" + "0 -0.0 0e0 1.0e+00\n",
        "a data set with a file of each camera",
        "in it",
    ),
    ("database.db", "SQLite format 3\x00", "COLMAP", "colmap mapper"),
]


def _refused(path: Path) -> str:
    with pytest.raises(InputRefused) as refusal:
        read_scan(path, IngestOptions())
    said = str(refusal.value).replace(str(path), "")
    assert len(said) < 320
    return said


@pytest.mark.parametrize(("name", "content", "program", "how"), DOCUMENTS)
def test_cameras_of_other_programs_are_named_with_their_way_in(
    tmp_path, name, content, program, how
):
    document = tmp_path / name
    document.write_text(content)
    (tmp_path / "images").mkdir()
    (tmp_path / "images/0001.jpg").write_bytes(b"")
    for path in (document, tmp_path):
        said = _refused(path)
        assert f"{name} holds the cameras of {program}, which are not read as they lie." in said
        assert how in said


def test_of_several_stages_one_is_to_be_named(tmp_path):
    for name in ("geo.usda", "scene.usdc"):
        (tmp_path / name).write_text("#usda 1.0\n")
    (tmp_path / "0001.exr").write_bytes(b"")
    said = "it holds 2 USD files, first geo.usda. Name the one that has cameras and meshes"
    assert said in _refused(tmp_path)


def test_a_document_that_names_no_program_is_none_of_theirs(tmp_path):
    (tmp_path / "run.out").write_text("all went well")
    document = tmp_path / "settings.json"
    document.write_text(json.dumps({"quality": "high"}))
    assert "neither pictures nor cameras" in _refused(tmp_path)
    assert "this is not a transforms.json" in _refused(document)


def test_tables_of_other_numbers_are_no_cameras(tmp_path):
    for name, row in (("points.xyz", "1 2 3\n"), ("weights.txt", "1 0 0 0\n")):
        (tmp_path / name).write_text(row * 5)
    for rows in (3, 4):
        (tmp_path / f"boxes_{rows}.txt").write_text("12 40 3.5 1\n" * rows)
    assert "neither pictures nor cameras" in _refused(tmp_path)


def test_documents_that_only_look_like_theirs_are_not(tmp_path):
    """A log of a program, metadata and cameras that are not those of Record3D or of splats, and
    markers that were measured."""
    (tmp_path / "run.log").write_text("0 0 1\nall went well\n")
    (tmp_path / "metadata.json").write_text('{"title": "a room"}')
    (tmp_path / "other.json").write_text('{"poses": []}')
    (tmp_path / "metadata.jsonl").write_text('{"file_name": "1.png", "text": "a room"}\n')
    (tmp_path / "markers.csv").write_text("Name,X,Y,Z\nT1,0.1,0.2,0.3\n")
    assert "it holds neither pictures nor cameras" in _refused(tmp_path)


def test_cameras_deep_in_a_folder_are_found(tmp_path):
    """As Polycam has them, beside a mesh at the top."""
    (tmp_path / "keyframes/cameras").mkdir(parents=True)
    (tmp_path / "keyframes/cameras/12.json").write_text('{"t_00": 1}')
    (tmp_path / "raw.glb").write_bytes(b"")
    assert "no keyframes/cameras with keyframes/images" in _refused(tmp_path)
    (tmp_path / "keyframes").rename(tmp_path / "mine")
    assert "12.json holds the cameras of Polycam" in _refused(tmp_path)


def test_photographs_divided_into_training_and_test_are_named_by_their_documents(tmp_path):
    for part, frames in (("test", 1), ("train", 9), ("val", 2)):
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({"frames": [{}] * frames}))
    (tmp_path / "r_0.png").write_bytes(b"")
    said = _refused(tmp_path)
    assert "transforms_train.json holds the cameras of some of its pictures. Name that file" in said


def test_a_file_of_a_colmap_model_is_answered_by_its_folder(tmp_path):
    (tmp_path / "images.bin").write_bytes(b"")
    said = _refused(tmp_path / "images.bin")
    assert "images.bin is a part of a COLMAP model. Name the folder that holds the model" in said


def test_a_document_of_another_program_that_has_frames_too_is_named(tmp_path):
    document = tmp_path / "meta_data.json"
    document.write_text('{"frames": [{"rgb_path": "0_rgb.png", "camtoworld": []}]}')
    assert "meta_data.json holds the cameras of SDFStudio" in _refused(document)


def test_photographs_alone_need_cameras(tmp_path):
    for i in range(3):
        (tmp_path / f"{i}.JPG").write_bytes(b"")
    said = _refused(tmp_path)
    assert "it holds 3 pictures, but nothing known here says where the cameras stood" in said
    assert "COLMAP, Metashape, RealityScan" in said


def test_a_scan_without_cameras_needs_its_programs_document(tmp_path):
    (tmp_path / "textured.obj").write_text("")
    (tmp_path / "0.jpg").write_bytes(b"")
    said = _refused(tmp_path)
    assert "it holds 1 picture and the mesh textured.obj, but nothing" in said
    assert "Bring the document that the scanning program writes of its cameras" in said


def test_the_folder_above_a_capture_names_the_one_to_ask_for(tmp_path):
    (tmp_path / "export/scene").mkdir(parents=True)
    (tmp_path / "export/scene/transforms.json").write_text("{}")
    said = _refused(tmp_path)
    assert said.startswith(": no capture itself, but export/scene/ in it is one (transforms). Name")


def test_a_folder_of_assets_or_versions_is_no_capture_and_none_in_it_is(built, tmp_path):
    """Their layers of cameras, meshes and photographs are what a capture of USD holds."""
    publish(built.asset.folder, tmp_path / "versions")
    shutil.copytree(tmp_path / "versions/v001", tmp_path / "versions/v002")
    (built.asset.folder / STATE_FOLDER).mkdir(exist_ok=True)
    for folder, what in (
        (tmp_path / "versions", "v001/ is a published version of an asset, v002/ is a published"),
        (built.asset.folder.parent, "room/ is an asset"),
    ):
        said = inspect(folder, InspectOptions(), plugins=False).refusals[0]
        assert f": no capture; in it {what}" in str(said)
        assert str(said).endswith("report and view look at assets. [capture.asset]")
    # Beside an asset there may be what is to become one, and that is what to speak of.
    (built.asset.folder.parent / "0.jpg").write_bytes(b"")
    assert "pictures, but nothing known here" in _refused(built.asset.folder.parent)
    make_capture(tmp_path / "versions/west", subdivisions=1)
    assert "west/ in it is one (transforms). Name" in _refused(tmp_path / "versions")


@pytest.mark.parametrize("name", ["Transforms.json", "transforms (1).json", "transforms.json.txt"])
def test_a_document_by_another_name_says_what_it_is_to_be_called(tmp_path, name):
    made = make_capture(tmp_path / "room", subdivisions=1)
    made.manifest.rename(made.folder / name)
    said = rf"{re.escape(name)} has poses as a transforms\.json has\. Call it transforms\.json"
    with pytest.raises(InputRefused, match=said):
        choose_adapter(made.folder)


@pytest.mark.parametrize("part", ["frames", "frames/0003.exr", "mesh.ply"])
def test_a_part_of_a_capture_names_the_folder_to_ask_for(tmp_path, monkeypatch, part):
    """It was to have its cameras found, which are there."""
    made = make_capture(tmp_path / "room", subdivisions=1)
    said = rf" of the capture in {re.escape(str(made.folder))}\. Name that folder"
    with pytest.raises(InputRefused, match=said):
        choose_adapter(made.folder / part)
    monkeypatch.chdir(made.folder / "frames")
    with pytest.raises(InputRefused, match=said):
        choose_adapter(Path())


@pytest.mark.parametrize(
    ("name", "text"), [("scene.usda", "#usda 1.0\n"), ("transforms.json", "{}"), ("shot.abc", "")]
)
def test_what_lies_above_by_chance_is_no_capture_to_ask_for(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures/0001.jpg").write_bytes(b"")
    assert "nothing known here says where the cameras stood" in _refused(tmp_path / "pictures")


def test_folders_above_that_nobody_named_are_passed_over_where_they_cannot_be_read(
    tmp_path, monkeypatch
):
    """Their permissions were told of, not what is wrong with the folder that was named."""
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures/0001.jpg").write_bytes(b"")

    def denied(path):
        if path == tmp_path:
            raise PermissionError(13, "Permission denied", str(path))
        return False

    monkeypatch.setattr("usdbrdf.capture.formats.metashape.matches", denied)
    assert "nothing known here says where the cameras stood" in _refused(tmp_path / "pictures")


def test_a_stage_whose_prims_are_called_as_a_programs_words_is_none_of_its_documents(tmp_path):
    (tmp_path / "geo.usda").write_text('#usda 1.0\ndef Xform "geo"\n{\n}\n')
    (tmp_path / "shot.usda").write_text('#usda 1.0\ndef Xform "shots"\n{\n}\n')
    assert "it holds 2 USD files" in _refused(tmp_path)


@pytest.mark.parametrize("name", ["images.bin", "cameras.txt"])
def test_half_a_colmap_model_is_said_to_be_one(tmp_path, name):
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0" / name).write_bytes(b"")
    (tmp_path / "0001.jpg").write_bytes(b"")
    assert f"it holds {name} of a COLMAP model, which is not whole" in _refused(tmp_path)


@pytest.mark.parametrize("name", ["cameras.fbx", "scene.gltf", "scan.glb"])
def test_cameras_within_a_scene_are_to_be_exported(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    (tmp_path / "0001.jpg").write_bytes(b"")
    assert "Export them with the mesh as USD, or bring the" in _refused(tmp_path)


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("capture.zip", "is an archive. Unpack it"),
        ("scan.tar.gz", "is an archive. Unpack it"),
        ("walk.MOV", "is a video, which does not say where its camera stood. Extract frames"),
        ("IMG_1.HEIC", "is a picture of a kind that is not read here"),
        ("office.las", "holds points or splats alone. Make a mesh"),
    ],
)
def test_what_is_no_capture_yet_says_how_it_becomes_one(tmp_path, name, said, alone):
    (tmp_path / name).write_bytes(b"PK\3\4" + bytes(100))
    with pytest.raises(InputRefused) as refused:
        choose_adapter(tmp_path / name if alone else tmp_path)
    assert f"{name} {said}" in str(refused.value)
