"""A scene of ScanNet++: COLMAP's text model, the laser mesh, segments and their groups."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

pytest.importorskip("pycolmap")
OPTIONS = IngestOptions(assume_srgb=True)


@pytest.fixture
def room():
    return truth()


@pytest.fixture
def scene(tmp_path, room):
    return write_scene(tmp_path / "0a5c013435", room)


def write_scene(folder, room):
    """A scene with a COLMAP model of text, a scan and its annotations; returns the folder."""
    model = folder / "dslr" / "colmap"
    model.mkdir(parents=True)
    lens = " ".join(str(number) for number in room.intrinsics[0])
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {lens}\n")
    rows = []
    for i, pose in enumerate(room.opencv):
        turn, centre = pose[:3, :3].T, pose[:3, 3]
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        numbers = " ".join(f"{n:.15f}" for n in (w, x, y, z, *(-turn @ centre)))
        rows += [f"{i + 1} {numbers} 1 DSC{i:05d}.JPG", ""]
        write_image(folder / "dslr" / "resized_images" / f"DSC{i:05d}.JPG", room.images[i])
    (model / "images.txt").write_text("\n".join(rows) + "\n")
    (model / "points3D.txt").write_text("")
    scans = folder / "scans"
    scans.mkdir()
    write_ply(scans / "mesh_aligned_0.05.ply", room.points, room.triangles)
    write_ply(scans / "mesh_aligned_0.05_semantic.ply", room.points, room.triangles)
    # Segments of vertices, which belong to one face each here; the lamp's lie in the ceiling's too.
    owner = np.zeros(len(room.points), int)
    owner[room.triangles] = room.face_object[:, None]
    segment = 1000 + np.arange(len(owner)) // 3
    segment = 100_000 * owner + segment
    (scans / "segments.json").write_text(json.dumps({"segIndices": segment.tolist()}))
    groups = []
    for i, name in enumerate(room.names):
        own = set(segment[owner == i].tolist())
        if name == "ceiling":
            own |= set(segment[owner == room.names.index("lamp")].tolist())
        row = {"id": i + 1, "objectId": i + 1, "label": name, "segments": sorted(own)}
        groups += [row] if name != "box" else []
    (scans / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    return folder


def test_photographs_and_annotated_objects(scene, room):
    assert choose_adapter(scene).name == "scannetpp"
    scan = read_scan(scene, OPTIONS)
    named = {name: f"{name}_{i + 1}" for i, name in enumerate(room.names)}
    named["box"] = "unlabelled"
    assert_same(scan, room, names=tuple(named.values()))
    assert (scan.adapter, scan.name, scan.up_axis) == ("scannetpp", "0a5c013435", "Z")
    label = np.array([each.label for each in scan.objects])[scan.mesh.face_object]
    for i, name in enumerate(room.names):
        assert (label == named[name]).sum() == (room.face_object == i).sum()


def test_what_masks_hide_is_not_looked_at(scene, room):
    for i in range(len(room.images)):
        hidden = np.ones((HEIGHT, WIDTH, 3))
        hidden[:, : WIDTH // 2] = 0
        write_image(scene / "dslr" / "resized_anon_masks" / f"DSC{i:05d}.png", hidden)
    scan = read_scan(scene, OPTIONS)
    assert len(scan.views) == len(room.images)
    assert {view.mask.parent.name for view in scan.views} == {"resized_anon_masks"}


def _no_mesh(scene):
    (scene / "scans" / "mesh_aligned_0.05.ply").unlink()


def _no_images(scene):
    for path in (scene / "dslr" / "resized_images").iterdir():
        path.unlink()


def _other_segments(scene):
    (scene / "scans" / "segments.json").write_text('{"segIndices": [1, 2, 3]}')


def _other_groups(scene):
    (scene / "scans" / "segments_anno.json").write_text('{"segGroups": [{"label": "x"}]}')


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_mesh, r"Download scans/mesh_aligned_0.05.ply.*--mesh\. \[mesh.missing\]"),
        (_no_images, r"no pictures below.*\[capture.frames\]"),
        (_other_segments, r"segIndices for each of the \d+ vertices.*\[objects.count\]"),
        (_other_groups, r"no segGroups with objectId.*\[objects.format\]"),
    ],
)
def test_refusals(scene, damage, sentence):
    damage(scene)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(scene, OPTIONS)


def _fisheye_model(scene, room):
    fx, fy, cx, cy = room.intrinsics[0]
    numbers = f"{0.8 * fx} {0.8 * fy} {cx + 1} {cy} -0.03 0.01 0 0"
    text = f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} {numbers}\n"
    (scene / "dslr" / "colmap" / "cameras.txt").write_text(text)


def _undistorted(scene, room, name="resized_undistorted_images"):
    """As dslr/undistort.py of the dataset's toolkit leaves them; its poses are in other axes."""
    _fisheye_model(scene, room)
    (scene / "dslr" / "resized_images").rename(scene / "dslr" / name)
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), room.intrinsics[0].tolist(), strict=True))
    said = {**lens, "w": WIDTH, "h": HEIGHT, "k1": 0.0, "camera_model": "PINHOLE", "frames": []}
    document = scene / "dslr" / "nerfstudio" / "transforms_undistorted.json"
    document.parent.mkdir()
    document.write_text(json.dumps(said))
    return document


@pytest.mark.parametrize("name", ["resized_undistorted_images", "undistorted_images"])
def test_undistorted_photographs_have_the_lens_that_was_written_with_them(scene, room, name):
    _undistorted(scene, room, name)
    masks = {"resized_undistorted_images": "resized_undistorted_masks"}
    folder = scene / "dslr" / masks.get(name, "undistorted_anon_masks")
    write_image(folder / "DSC00003.png", np.ones((HEIGHT, WIDTH, 3)))
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room)
    assert any("1 masks are used" in warning for warning in scan.warnings)


def test_undistorted_photographs_without_their_lens_are_refused(scene, room):
    document = _undistorted(scene, room)
    document.write_text("{}")
    with pytest.raises(InputRefused, match=r"does not state a PINHOLE.*\[capture.camera\]"):
        read_scan(scene, OPTIONS)
    document.unlink()
    with pytest.raises(InputRefused, match=r"not there.*resized_images\. \[capture.camera\]"):
        read_scan(scene, OPTIONS)


def test_original_photographs_have_their_own_masks(scene, room):
    (scene / "dslr" / "resized_images").rename(scene / "dslr" / "original_images")
    for i in range(len(room.images)):
        mask = np.ones((HEIGHT, WIDTH, 3))
        write_image(scene / "dslr" / "original_anon_masks" / f"DSC{i:05d}.png", mask)
    scan = read_scan(scene, OPTIONS)
    assert any("10 masks are used" in warning for warning in scan.warnings)


def _telephone(scene):
    """As iphone/prepare_iphone_data.py leaves a scene of which dslr/ was not downloaded."""
    dslr, iphone = scene / "dslr", scene / "iphone"
    iphone.mkdir()
    (dslr / "colmap").rename(iphone / "colmap")
    (dslr / "resized_images").rename(iphone / "rgb")
    dslr.rmdir()
    text = (iphone / "colmap" / "images.txt").read_text()
    for path in sorted((iphone / "rgb").iterdir()):
        name = f"frame_{10 * int(path.stem[3:]):06d}.jpg"
        text = text.replace(path.name, name)
        path.rename(path.with_name(name))
    (iphone / "colmap" / "images.txt").write_text(text)
    (iphone / "pose_intrinsic_imu.json").write_text("{}")
    return iphone


def test_a_telephones_pictures_where_there_is_no_dslr(scene, room):
    _telephone(scene)
    assert choose_adapter(scene).name == "scannetpp"
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room)
    assert "floor_1" in [each.label for each in scan.objects]


def test_a_telephones_video_is_to_be_extracted(scene):
    iphone = _telephone(scene)
    for path in (iphone / "rgb").iterdir():
        path.unlink()
    with pytest.raises(InputRefused, match=r"no pictures in iphone/rgb.*\[capture.frames\]"):
        read_scan(scene, OPTIONS)


def _write_nerfstudio(folder, room, *, bad=()):
    """transforms.json as the dataset has it: other axes than the mesh, the last two frames for
    tests."""
    axes = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    fx, fy, cx, cy = room.intrinsics[0].tolist()
    rows = [
        {
            "file_path": f"DSC{i:05d}.JPG",
            "transform_matrix": (axes @ pose).tolist(),
            "is_bad": i in bad,
        }
        for i, pose in enumerate(room.world_from_camera)
    ]
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT}
    document = {**lens, "camera_model": "PINHOLE", "frames": rows[:-2], "test_frames": rows[-2:]}
    folder.mkdir(exist_ok=True, parents=True)
    (folder / "transforms.json").write_text(json.dumps(document))


def _without_model(scene, room, **how):
    """As who downloads what nerfstudio needs has a scene; the lens of the document bends light."""
    _write_nerfstudio(scene / "dslr" / "nerfstudio", room, **how)
    for path in (scene / "dslr" / "colmap").iterdir():
        path.unlink()
    (scene / "dslr" / "colmap").rmdir()


def test_a_scene_without_a_model_is_read_from_its_document(scene, room):
    _without_model(scene, room, bad=(3,))
    mask = scene / "dslr" / "resized_anon_masks" / "DSC00004.png"
    write_image(mask, np.ones((HEIGHT, WIDTH, 3)))
    assert choose_adapter(scene).name == "scannetpp"
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room, poses=np.delete(room.world_from_camera, 3, axis=0))
    assert "floor_1" in [each.label for each in scan.objects]
    assert [view.mask for view in scan.views if view and view.mask] == [mask]
    said = [one for one in scan.warnings if "axes" in one]
    assert len(said) == 1
    assert "transforms.json: belongs to a scene of ScanNet++, so its axes" in said[0]
    assert "state applied_transform" not in said[0]


def test_undistorted_photographs_of_a_scene_without_a_model(scene, room):
    _without_model(scene, room)
    document = scene / "dslr" / "nerfstudio" / "transforms.json"
    undistorted = document.with_name("transforms_undistorted.json")
    undistorted.write_bytes(document.read_bytes())
    said = {**json.loads(document.read_text()), "camera_model": "OPENCV_FISHEYE", "k1": 0.1}
    document.write_text(json.dumps(said))
    name = "resized_undistorted_images"
    (scene / "dslr" / "resized_images").rename(scene / "dslr" / name)
    assert_same(read_scan(scene, OPTIONS), room)
    undistorted.unlink()
    with pytest.raises(InputRefused, match=r"undistorted.json: not there, nor .*capture.camera\]"):
        read_scan(scene, OPTIONS)


def test_a_telephones_model_without_pictures_is_not_taken_for_the_document_with_them(scene, room):
    _write_nerfstudio(scene / "dslr" / "nerfstudio", room)
    (scene / "iphone").mkdir()
    (scene / "dslr" / "colmap").rename(scene / "iphone" / "colmap")
    assert_same(read_scan(scene, OPTIONS), room)


@pytest.mark.parametrize("named", ["../resized_anon_masks/DSC00004.png", ""])
def test_masks_of_a_scene_are_its_folders_whatever_its_document_calls_them(scene, room, named):
    _without_model(scene, room)
    document = scene / "dslr" / "nerfstudio" / "transforms.json"
    said = json.loads(document.read_text())
    said["frames"][4]["mask_path"] = named
    document.write_text(json.dumps(said))
    assert_same(read_scan(scene, OPTIONS), room)


def test_pictures_that_are_named_are_those_of_the_camera_that_they_lie_at(scene, room):
    shutil.copytree(scene / "dslr" / "colmap", scene / "iphone" / "colmap")
    (scene / "dslr" / "resized_images").rename(scene / "iphone" / "rgb")
    images = scene / "dslr" / "colmap" / "images.txt"
    images.write_text(images.read_text().replace("DSC", "P"))
    options = replace(OPTIONS, frames=scene / "iphone" / "rgb")
    assert_same(read_scan(scene, options), room)


def _alone(folder, room):
    """The document with what it names beside it."""
    _write_nerfstudio(folder, room)
    for i, image in enumerate(room.images):
        write_image(folder / f"DSC{i:05d}.JPG", image)
    write_ply(folder / "mesh.ply", room.points, room.triangles)
    return folder / "transforms.json"


def test_a_document_that_has_bad_frames_alone_keeps_its_axes(tmp_path, room):
    document = _alone(tmp_path, room)
    said = json.loads(document.read_text())
    said["frames"] += said.pop("test_frames")
    document.write_text(json.dumps(said))
    kept = read_scan(tmp_path, OPTIONS)
    assert not any("undone" in one for one in kept.warnings)
    document.write_text(json.dumps(said | {"test_frames": []}))
    undone = read_scan(tmp_path, OPTIONS)
    assert any("test_frames, as documents of ScanNet++ have" in one for one in undone.warnings)
    moved = kept.frames.world_from_camera - undone.frames.world_from_camera
    assert np.abs(moved).max() > 0.1


@pytest.mark.parametrize("old", [True, False])
def test_axes_that_a_model_beside_knows_are_told_as_they_are(scene, tmp_path, room, old):
    document = _alone(tmp_path / "alone", room)
    model = document.parent / "colmap" / "sparse"
    model.mkdir(parents=True)
    (scene / "dslr" / "colmap").rename(model / "0")
    if not old:
        said = json.loads(document.read_text())
        for row, pose in zip(said["frames"], room.world_from_camera, strict=False):
            row["transform_matrix"] = pose.tolist()
        for row, pose in zip(said["test_frames"], room.world_from_camera[-2:], strict=True):
            row["transform_matrix"] = pose.tolist()
        document.write_text(json.dumps(said))
    scan = read_scan(document.parent, OPTIONS)
    assert_same(scan, room)
    assert sum("undone" in said for said in scan.warnings) == old


def test_frames_that_are_said_to_be_bad_are_left_out(scene, room):
    _write_nerfstudio(scene / "dslr" / "nerfstudio", room, bad=(3, 9))
    scan = read_scan(scene, OPTIONS)
    assert len(scan.frames) == 8
    assert not {"DSC00003.JPG", "DSC00009.JPG"} & {path.name for path in scan.frames.image_paths}
    assert any(
        "dslr/nerfstudio/transforms.json: 2 of 10 frames are left out" in said
        for said in scan.warnings
    )


def test_a_document_within_a_scene_names_the_scene(scene, room):
    _write_nerfstudio(scene / "dslr" / "nerfstudio", room)
    with pytest.raises(InputRefused, match=rf"the scene of ScanNet\+\+ in .*{scene.name}, whose"):
        read_scan(scene / "dslr" / "nerfstudio", OPTIONS)


def test_a_model_within_a_scene_names_the_scene(scene, room):
    """From above, where one keeps several scenes, and from the folder of its photographs."""
    with pytest.raises(InputRefused, match=rf"{scene.name}/ in it is one \(scannetpp\). Name that"):
        choose_adapter(scene.parent)
    said = rf"no mesh\. Name the scene of ScanNet\+\+, {scene}, which has one in scans/"
    with pytest.raises(InputRefused, match=said):
        read_scan(scene / "dslr", OPTIONS)
    mesh = scene / "scans" / "mesh_aligned_0.05.ply"
    assert_same(read_scan(scene / "dslr", replace(OPTIONS, mesh=mesh)), room)


def test_the_document_alone_has_its_axes_undone_and_its_test_frames(tmp_path, room):
    _write_nerfstudio(tmp_path, room, bad=(3,))
    for i, image in enumerate(room.images):
        write_image(tmp_path / f"DSC{i:05d}.JPG", image)
    write_ply(tmp_path / "mesh.ply", room.points, room.triangles)
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, poses=np.delete(room.world_from_camera, 3, axis=0))
    assert any("test_frames" in said for said in scan.warnings)
