"""COLMAP captures, written by pycolmap itself."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.lens_scenes import CAMERAS, camera_of, capture_through, seen_through
from tests.scenes import edited, make_capture, write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import FrameRecord
from usdbrdf.capture.formats import colmap
from usdbrdf.capture.mesh_frames import mask_beside
from usdbrdf.capture.up_axis import up_axis_of
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted.colmap_models import ColmapCamera

pycolmap = pytest.importorskip("pycolmap")
OPTIONS = IngestOptions(meters_per_unit=1.0, up_axis="Z")


def reconstruction(made, cameras, names):
    """pycolmap's model of a capture: image i, called names[i], by cameras[i % len(cameras)]."""
    model = pycolmap.Reconstruction()
    for k, camera in enumerate(cameras):
        camera.camera_id = k + 1
        model.add_camera_with_trivial_rig(camera)
    for i, name in enumerate(names):
        opencv = made.world_from_camera[i] @ np.diag([1.0, -1.0, -1.0, 1.0])
        pose = pycolmap.Rigid3d(np.linalg.inv(opencv)[:3])
        image = pycolmap.Image(
            name=name, keypoints=np.array([[1.5, 2.5]]), camera_id=1 + i % len(cameras),
            image_id=i + 1,
        )  # fmt: skip
        model.add_image_with_trivial_frame(image, pose)
    return model


def colmap_capture(folder, model="OPENCV", *, text=False, sparse="sparse/0", names=None):
    """A capture through a lens as COLMAP leaves it; returns what it was made from."""
    made = capture_through(folder, model)
    names = names or [f"{i:04d}.exr" for i in range(10)]
    for i, name in enumerate(names):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        made.image(i).rename(folder / "images" / name)
    made.manifest.unlink()
    write_model(folder / sparse, reconstruction(made, [camera_of(model)], names), text=text)
    return made


def write_model(folder, model, *, text=False):
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))


@pytest.mark.parametrize(
    ("model", "text"), [("PINHOLE", True), ("OPENCV", False), ("OPENCV_FISHEYE", True)]
)
def test_colmap_and_nerfstudio_give_one_scan(tmp_path, model, text):
    made = colmap_capture(tmp_path / "colmap", model, text=text)
    capture_through(tmp_path / "nerfstudio", model)
    one = read_scan(made.folder, OPTIONS)
    other = read_scan(tmp_path / "nerfstudio", IngestOptions())
    assert (one.adapter, other.adapter) == ("colmap", "transforms")
    size = np.ptp(made.points, axis=0).max()
    difference = one.frames.world_from_camera - other.frames.world_from_camera
    assert np.abs(difference).max() < 1e-4 * size
    assert np.abs(one.frames.intrinsics - other.frames.intrinsics).max() < 0.05
    assert one.frames.resolution.tolist() == other.frames.resolution.tolist()
    assert len(one.views) == len(other.views) == (0 if model == "PINHOLE" else len(one.frames))
    assert one.mesh.points.tobytes() == other.mesh.points.tobytes()
    assert [o.label for o in one.objects] == [o.label for o in other.objects]


@pytest.mark.parametrize(
    "written", ["no rows of points", "empty rows", "no last row", "a mark", "Windows"]
)
def test_text_models_of_other_programs_lose_no_image(tmp_path, written):
    """COLMAP's own reader takes every second row for points, whatever it holds."""
    names = [f"{i:04d}.exr" if i else "0000 1.exr" for i in range(10)]
    made = colmap_capture(tmp_path / "room", "PINHOLE", text=True, names=names)
    for file in (made.folder / "sparse/0").glob("*.txt"):
        rows = file.read_text().splitlines()
        if file.name == "images.txt" and written != "Windows":
            points = {r for r in rows if r and r[0] != "#" and len(r.split()) == 3}
            assert points
            kept = [row for row in rows if row not in points]
            rows = (
                kept if written == "no rows of points" else [r.replace(*points, "") for r in rows]
            )
        text = "\n".join(rows) + "\n"
        text = text.rstrip() if written == "no last row" else text
        text = text.replace("\n", "\r\n") if written == "Windows" else text
        file.write_bytes(b"\xef\xbb\xbf" * (written == "a mark") + text.encode())
    scan = read_scan(made.folder, OPTIONS)
    assert [path.name for path in scan.frames.image_paths] == sorted(names)
    order = np.argsort(names)
    np.testing.assert_allclose(
        scan.frames.world_from_camera, made.world_from_camera[order], atol=1e-12
    )


@pytest.mark.parametrize("text", [True, False])
def test_images_come_in_the_order_of_their_whole_names(tmp_path, text):
    """Of a text model COLMAP itself reads names up to the first space, and knows no order then:
    slow drifts and poses that slipped along the list were not found."""
    names = [f"IMG {i:02d}.exr" for i in range(10)]
    made = colmap_capture(tmp_path / "room", "PINHOLE", text=text, names=names)
    if text:  # as COLMAP writes them: images in any order
        file = made.folder / "sparse/0/images.txt"
        rows = [row for row in file.read_text().splitlines() if row[:1] != "#"]
        pairs = [rows[k : k + 2] for k in range(0, len(rows), 2)]
        file.write_text("\n".join(row for pair in pairs[::2] + pairs[1::2] for row in pair) + "\n")
    scan = read_scan(made.folder, OPTIONS)
    assert [path.name for path in scan.frames.image_paths] == names
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera, atol=1e-9)


def test_quaternions_need_no_length_of_1_but_some(tmp_path):
    """As other programs round or scale them; of an image that was not placed it is 0, which says
    nothing of what is up in the others."""
    made = colmap_capture(tmp_path / "room", "PINHOLE", text=True)
    file = made.folder / "sparse/0/images.txt"
    for newer in ("rigs.txt", "frames.txt"):
        file.with_name(newer).unlink()
    rows = []
    for row in file.read_text().splitlines():
        words = row.split()
        if row[:1] != "#" and len(words) == 10:
            factor = 0 if words[9] == "0003.exr" else int(words[0])
            words[1:5] = [str(factor * float(word)) for word in words[1:5]]
        rows.append(" ".join(words))
    file.write_text("\n".join(rows) + "\n")
    scan = read_scan(made.folder, OPTIONS)
    kept = np.delete(made.world_from_camera, 3, axis=0)
    np.testing.assert_allclose(scan.frames.world_from_camera, kept, atol=1e-9)
    assert any("'0003.exr': its pose is not a finite" in s for s in scan.warnings)
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up becomes y up
    poses = [np.full((4, 4), np.nan), *made.world_from_camera.copy()]
    for pose in poses[1:]:
        pose[:3] = turn @ pose[:3]
    record = FrameRecord(
        name="", image_path=file, world_from_camera=poses[0], intrinsics=(1, 1, 1, 1),
        resolution=(2, 2),
    )  # fmt: skip
    assert up_axis_of([replace(record, world_from_camera=pose) for pose in poses]) == "Y"


def test_every_model_becomes_the_lens_that_pycolmap_has():
    directions = np.random.default_rng(0).normal(size=(500, 3)) * (0.4, 0.3, 0) + (0, 0, 1)
    for name in sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID"}):
        identifier = pycolmap.CameraModelId.__members__[name]
        camera = pycolmap.Camera.create_from_model_id(1, identifier, 300.0, 640, 480)
        numbers = np.array(camera.params)
        numbers[camera.extra_params_idxs()] += 0.01 * (
            1 + np.arange(len(camera.extra_params_idxs()))
        )
        if name != "EQUIRECTANGULAR":
            numbers[camera.focal_length_idxs()] *= np.linspace(1, 1.1, 2)[
                : len(camera.focal_length_idxs())
            ]
            numbers[camera.principal_point_idxs()] += (3, -5)
        camera.params = numbers
        ours = ColmapCamera(model=name, resolution=(640, 480), parameters=tuple(numbers))
        lens, intrinsics = colmap.lens_of(ours)
        found = lens.project(directions * (1, -1, -1), intrinsics)
        np.testing.assert_allclose(found, camera.img_from_cam(directions), atol=1e-6, err_msg=name)


@pytest.mark.parametrize("gone", ["rigs", "frames"])
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_images_have_poses_where_one_of_rigs_and_frames_is_gone(tmp_path, gone, suffix):
    made = colmap_capture(tmp_path, "PINHOLE", text=suffix == ".txt")
    whole = read_scan(tmp_path, OPTIONS)
    (made.folder / "sparse/0" / f"{gone}{suffix}").unlink()
    one = read_scan(tmp_path, OPTIONS)
    np.testing.assert_allclose(one.frames.world_from_camera, whole.frames.world_from_camera)


def test_several_cameras_in_subfolders_with_missing_images(tmp_path):
    made = make_capture(tmp_path / "room")
    names = [f"{'left' if i % 2 else 'right é'}/{i // 2:02d}.exr" for i in range(12)]
    for i, name in enumerate(names):
        (made.folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        made.image(i).rename(made.folder / "images" / name)
    made.manifest.unlink()
    pinhole = pycolmap.Camera(model="PINHOLE", width=32, height=24, params=list(made.intrinsics))
    other = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=64, height=48, params=[2 * made.intrinsics[0], 32, 24]
    )
    write_model(made.folder / "sparse/0", reconstruction(made, [pinhole, other], names))
    (made.folder / "images" / names[3]).unlink()
    scan = read_scan(made.folder, OPTIONS)
    order = sorted(set(range(12)) - {3}, key=lambda i: names[i])
    assert [p.name for p in scan.frames.image_paths] == [names[i].split("/")[1] for i in order]
    np.testing.assert_allclose(
        scan.frames.world_from_camera, made.world_from_camera[order], atol=1e-9
    )
    np.testing.assert_allclose(scan.frames.intrinsics, np.tile(made.intrinsics, (11, 1)))
    assert any("1 of 12 frames dropped, 'left/01.exr'" in w for w in scan.warnings)
    assert any("scaled to the size" in w for w in scan.warnings)


def undistorted_beside(made):
    """dense/ with pinhole images, as image_undistorter leaves it."""
    dense, camera = made.folder / "dense", camera_of("PINHOLE")
    names = [f"{i:04d}.exr" for i in range(10)]
    (dense / "images").mkdir(parents=True)
    for i, name in enumerate(names):
        write_exr(dense / "images" / name, seen_through(camera, made.world_from_camera[i], made))
    write_model(dense / "sparse", reconstruction(made, [camera], names))
    return dense


def test_the_distorted_model_goes_with_distorted_images(tmp_path):
    made = colmap_capture(tmp_path / "room")
    undistorted_beside(made)
    scan = read_scan(made.folder, OPTIONS)
    assert {view.photograph.parent for view in scan.views} == {made.folder / "images"}


@pytest.mark.parametrize("place", ["dense", "colmap_dense"])
def test_without_distorted_images_the_undistorted_model_is_taken(tmp_path, place):
    """The second is what those have who follow instant-ngp, beside colmap_sparse."""
    sparse = "sparse/0" if place == "dense" else "colmap_sparse/0"
    made = colmap_capture(tmp_path / "room", sparse=sparse)
    dense = undistorted_beside(made).rename(made.folder / place)
    shutil.rmtree(made.folder / "images")
    scan = read_scan(made.folder, OPTIONS)
    assert scan.views == ()
    assert {path.parent for path in scan.frames.image_paths} == {dense / "images"}
    np.testing.assert_allclose(scan.frames.intrinsics[0], CAMERAS["PINHOLE"][2])


@pytest.mark.parametrize("size", ["same", "other"])
def test_undistorted_images_in_the_place_of_distorted_ones_are_not_undistorted_twice(
    tmp_path, size
):
    made = colmap_capture(tmp_path / "room")
    dense = undistorted_beside(made)
    if size == "other":
        model = reconstruction(made, [camera_of("PINHOLE")], [f"{i:04d}.exr" for i in range(10)])
        for i in range(10):
            path = dense / "images" / f"{i:04d}.exr"
            write_exr(path, read_exr(path)[:30])
        model.cameras[1].height = 30
        write_model(dense / "sparse", model)
    shutil.rmtree(made.folder / "images")
    shutil.copytree(dense / "images", made.folder / "images")
    scan = read_scan(made.folder, OPTIONS)
    assert scan.views == ()
    assert len(scan.frames) == 10


def test_a_model_without_points_and_with_colmaps_own_mesh_and_masks(tmp_path):
    made = colmap_capture(tmp_path / "room", "PINHOLE", sparse="sparse")
    (made.folder / "sparse" / "points3D.bin").unlink()
    (made.folder / "dense").mkdir()
    (made.folder / "mesh.ply").rename(made.folder / "dense" / "meshed-poisson.ply")
    (made.folder / "masks").mkdir()
    # COLMAP's name, and those that other programs give.
    for name in ("0003.exr.png", "0005.png", "0007_mask.png"):
        shutil.copy(make_mask(tmp_path / "mask.png"), made.folder / "masks" / name)
    scan = read_scan(made.folder, IngestOptions())
    assert [view is not None for view in scan.views] == [i in (3, 5, 7) for i in range(10)]
    assert any("[colmap.scale]" in warning for warning in scan.warnings)
    assert any("3 masks" in warning for warning in scan.warnings)


@pytest.mark.parametrize(
    ("scale", "degrees", "elsewhere"), [(1, 0, False), (1.3, 0, True), (1, 30, True)]
)
def test_a_mesh_off_the_points_of_the_model_is_told(tmp_path, scale, degrees, elsewhere):
    """As of another program, or aligned since; cameras inside of it hit it anyhow."""
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    model = pycolmap.Reconstruction(made.folder / "sparse/0")
    corners = made.points[made.triangles[:: len(made.triangles) // 100]].astype(np.float64)
    for place in corners.mean(axis=1):
        model.add_point3D(place + 0.01, pycolmap.Track(), np.zeros(3, np.uint8))
    write_model(made.folder / "sparse/0", model)
    middle = made.points.mean(axis=0)
    turn = Rotation.from_euler("xyz", [degrees, 0, degrees], degrees=True).as_matrix()
    points = scale * (made.points - middle) @ turn.T + middle
    write_ply(made.folder / "mesh.ply", points, made.triangles, made.face_object)
    told = [s for s in read_scan(made.folder, OPTIONS).warnings if "[mesh.frame]" in s]
    assert len(told) == elsewhere
    assert all("half of the points of COLMAP's model lie farther off" in said for said in told)


@pytest.mark.parametrize(
    ("turn", "axis", "upright"),
    [
        (np.eye(3), "Z", ""),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "Y", ""),  # z up becomes y up
        (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), "Z", "-Y"),  # as COLMAP starts
    ],
)
def test_the_way_up_is_that_of_upright_cameras(tmp_path, turn, axis, upright):
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    model = pycolmap.Reconstruction(made.folder / "sparse/0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn), np.zeros(3)))
    write_model(made.folder / "sparse/0", model)
    write_ply(made.folder / "mesh.ply", made.points @ turn.T, made.triangles, made.face_object)
    scan = read_scan(made.folder, IngestOptions())
    assert scan.up_axis == axis
    assert any(f"taken are metres and {axis}." in warning for warning in scan.warnings)
    told = [warning for warning in scan.warnings if "[capture.up-axis]" in warning]
    assert len(told) == bool(upright)
    assert not told or f"upright along {upright}, not along Z" in told[0]
    assert not told or f"try --up-axis {upright}." in told[0]


def test_masks_of_subfolders_are_not_mixed_up(tmp_path):
    (tmp_path / "masks/left").mkdir(parents=True)
    for name in ("left/0001.jpg.png", "0001.png", "0002.jpg"):
        make_mask(tmp_path / "masks" / name)
    found = {
        name: mask_beside(tmp_path, name, OPTIONS)
        for name in ("left/0001.jpg", "right/0001.jpg", "0001.jpg", "0002.jpg")
    }
    masks = tmp_path / "masks"
    assert found == {
        "left/0001.jpg": masks / "left/0001.jpg.png",
        "right/0001.jpg": None,
        "0001.jpg": masks / "0001.png",
        "0002.jpg": masks / "0002.jpg",
    }


def test_a_name_too_long_for_a_mask_has_none(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in ("n" * 244 + ".jpg", "n" * 300, "n/" * 3000):
        assert mask_beside(tmp_path, name, OPTIONS) is None


def make_mask(path):
    from usdbrdf.files.images import write_preview_png

    write_preview_png(path, np.full((36, 48, 3), 255, np.uint8))
    return path


def test_the_larger_of_two_reconstructions_is_taken(tmp_path):
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    few = reconstruction(made, [camera_of("PINHOLE")], ["0000.exr", "0001.exr"])
    shutil.move(made.folder / "sparse/0", made.folder / "sparse/1")
    write_model(made.folder / "sparse/0", few)
    scan = read_scan(made.folder, OPTIONS)
    assert len(scan.frames) == 10
    assert any("2 COLMAP models" in w and "sparse/1" in w for w in scan.warnings)


def test_nerfstudios_document_comes_first(tmp_path):
    made = make_capture(tmp_path / "room")
    write_model(
        made.folder / "colmap/sparse/0",
        reconstruction(made, [camera_of("PINHOLE")], ["0000.exr", "0001.exr"]),
    )
    assert choose_adapter(made.folder).name == "transforms"


def _cut(made):
    path = made.folder / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:100])


def _outside(made):
    names = ["../../x.exr", *(f"{i:04d}.exr" for i in range(1, 10))]
    write_model(made.folder / "sparse/0", reconstruction(made, [camera_of("PINHOLE")], names))


def _wide(made):
    camera = camera_of("PINHOLE")
    camera.width = 1 << 40
    names = [f"{i:04d}.exr" for i in range(10)]
    write_model(made.folder / "sparse/0", reconstruction(made, [camera], names))


def _without_poses(made):
    write_model(made.folder / "sparse/0", pycolmap.Reconstruction())


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_without_poses, ["no image of this COLMAP model has a pose", "[colmap.model]"]),
        (_wide, ["1099511627776 x 36 pixels", "[capture.camera]"]),
        (_cut, ["sparse/0", "cannot read this model", "[colmap.model]"]),
        (_outside, ["x.exr", "[paths.outside]"]),
        (lambda made: shutil.rmtree(made.folder / "images"), ["none of", "[colmap.images]"]),
        (lambda made: (made.folder / "mesh.ply").unlink(), ["--mesh", "[mesh.missing]"]),
    ],
    ids=["no poses", "wide", "cut off", "outside", "no images", "no mesh"],
)
def test_what_is_refused(tmp_path, edit, words):
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    edit(made)
    with pytest.raises(InputRefused) as refusal:
        read_scan(made.folder, OPTIONS)
    for word in words:
        assert word in str(refusal.value)


def test_without_pycolmap_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    monkeypatch.setattr("usdbrdf.untrusted.colmap_models.find_spec", lambda name: None)
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[colmap\]"):
        read_scan(made.folder, OPTIONS)


def test_old_documents_of_nerfstudio_had_turned_the_world(tmp_path):
    made = make_capture(tmp_path / "room")
    legacy = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"] = (legacy @ frame["transform_matrix"]).tolist()
    (made.folder / "colmap/sparse/0").mkdir(parents=True)
    scan = read_scan(made.folder, replace(OPTIONS))
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera, atol=1e-9)
    assert any("[capture.legacy]" in warning for warning in scan.warnings)


@pytest.mark.parametrize("old", [True, False])
def test_the_model_beside_a_document_tells_whether_its_world_was_turned(tmp_path, old):
    """Documents without applied_transform that other programs write lie as the model does."""
    made = make_capture(tmp_path / "room")
    camera = pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[19.2, 19.2, 16, 12])
    names = [f"{i:04d}.png" for i in range(12)]
    write_model(made.folder / "colmap/sparse/0", reconstruction(made, [camera], names))
    legacy = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    with edited(made.manifest) as document:
        for frame in document["frames"] if old else ():
            frame["transform_matrix"] = (legacy @ frame["transform_matrix"]).tolist()
    scan = read_scan(made.folder, OPTIONS)
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera, atol=1e-9)
    told = [sentence for sentence in scan.warnings if "[capture.legacy]" in sentence]
    assert ["state applied_transform" in sentence for sentence in told] == [False] * old


def _images_through(made, folder, model, scale=1):
    camera = camera_of(model, scale)
    folder.mkdir(parents=True)
    for i in range(10):
        write_exr(folder / f"{i:04d}.exr", seen_through(camera, made.world_from_camera[i], made))


@pytest.mark.parametrize("folder", ["sparse_txt", "model", "sparse/final", "sparse/0/text"])
def test_a_folder_of_a_model_alone_may_be_called_anything(tmp_path, folder):
    made = colmap_capture(tmp_path / "room", "PINHOLE", text="t" in folder, sparse=folder)
    assert choose_adapter(made.folder).name == "colmap"
    scan = read_scan(made.folder, OPTIONS)
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera, atol=1e-9)


def test_a_folder_that_holds_several_captures_is_none(tmp_path):
    """Each has its images beside its model."""
    colmap_capture(tmp_path / "rooms" / "one", "PINHOLE", sparse="")
    with pytest.raises(InputRefused, match=r"one/ in it is one \(colmap\)"):
        choose_adapter(tmp_path / "rooms")


@pytest.mark.parametrize("named", ["sparse", "sparse/0"])
def test_the_model_alone_says_which_folder_holds_its_images(tmp_path, named):
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    with pytest.raises(InputRefused, match=rf"Name {made.folder}, where they are\. \[colmap"):
        read_scan(made.folder / named, OPTIONS)


@pytest.fixture
def splats(tmp_path):
    """A scene as gaussian-splatting's convert.py leaves it."""
    made = capture_through(tmp_path / "scene", "OPENCV")
    made.manifest.unlink()
    shutil.rmtree(made.folder / "frames")
    names = [f"{i:04d}.exr" for i in range(10)]
    for model, images, sparse in (
        ("OPENCV", "input", "distorted/sparse/0"),
        ("PINHOLE", "images", "sparse/0"),
    ):
        _images_through(made, made.folder / images, model)
        write_model(made.folder / sparse, reconstruction(made, [camera_of(model)], names))
    for k in (2, 4):
        _images_through(made, made.folder / f"images_{k}", "PINHOLE", 1 / k)
    return made


def _taken(scan):
    return {(v.photograph if v else p).parent.name for v, p in _with_views(scan)}


def _with_views(scan):
    views = scan.views or [None] * len(scan.frames)
    return zip(views, scan.frames.image_paths, strict=True)


@pytest.mark.parametrize(
    ("gone", "taken", "bends"),
    [
        ((), "images", False),
        (("input", "distorted"), "images", False),
        (("images",), "images_2", False),
        (("images", "images_2", "input", "distorted"), "images_4", False),
        (("images", "images_2", "images_4"), "input", True),
        (("images", "images_2", "images_4", "sparse"), "input", True),
    ],
)
def test_folders_as_those_have_them_who_train_splats(splats, gone, taken, bends):
    """Each model goes with its images: those that were undistorted never with the lens's."""
    for name in gone:
        shutil.rmtree(splats.folder / name)
    scan = read_scan(splats.folder, OPTIONS)
    assert _taken(scan) == {taken}
    assert bool(scan.views) == bends
    scale = {"images_2": 0.5, "images_4": 0.25}.get(taken, 1)
    if not bends:
        expected = np.array(CAMERAS["PINHOLE"][2]) * scale
        np.testing.assert_allclose(scan.frames.intrinsics[0], expected)


def test_images_of_full_size_are_taken_although_one_is_missing(splats):
    (splats.folder / "images/0004.exr").unlink()
    scan = read_scan(splats.folder, OPTIONS)
    assert (len(scan.frames), _taken(scan)) == (9, {"images"})
    assert any("1 of 10 frames dropped, '0004.exr'" in said for said in scan.warnings)


def test_the_only_folder_that_holds_the_images_is_theirs(splats):
    for name in ("images_2", "images_4", "input", "distorted"):
        shutil.rmtree(splats.folder / name)
    (splats.folder / "work").mkdir()
    (splats.folder / "images").rename(splats.folder / "work/my pictures")
    scan = read_scan(splats.folder, OPTIONS)
    assert _taken(scan) == {"my pictures"}
    assert any("are taken from work/my pictures/, the only folder" in s for s in scan.warnings)
    shutil.copytree(splats.folder / "work/my pictures", splats.folder / "work/some copies")
    with pytest.raises(InputRefused, match="my pictures, work/some copies all hold the"):
        read_scan(splats.folder, OPTIONS)
    named = replace(OPTIONS, frames=splats.folder / "work/my pictures")
    assert _taken(read_scan(splats.folder, named)) == {"my pictures"}
    shutil.rmtree(splats.folder / "work")
    with pytest.raises(InputRefused, match=r"none of the images .* is there, first '0000\.exr'"):
        read_scan(splats.folder, OPTIONS)


@pytest.mark.parametrize("layer", ["normals", "depth_anything", "work/mono_depth", "sky Masks"])
def test_layers_are_not_taken_for_the_photographs(splats, layer):
    """However many they are, and wherever these are."""
    for name in ("images_2", "images_4", "input", "distorted"):
        shutil.rmtree(splats.folder / name)
    shutil.copytree(splats.folder / "images", splats.folder / layer)
    (splats.folder / "images").rename(splats.folder / "pics")
    (splats.folder / "pics/0004.exr").unlink()
    scan = read_scan(splats.folder, OPTIONS)
    assert (len(scan.frames), _taken(scan)) == (9, {"pics"})
    assert any("are taken from pics/, the only folder" in said for said in scan.warnings)
    shutil.rmtree(splats.folder / "pics")
    with pytest.raises(InputRefused, match="none of the images that the COLMAP model names is th"):
        read_scan(splats.folder, OPTIONS)


def test_of_several_folders_that_with_most_images_is_taken(splats):
    for name in ("images_2", "images_4", "input", "distorted"):
        shutil.rmtree(splats.folder / name)
    (splats.folder / "images").rename(splats.folder / "pics")
    shutil.copytree(splats.folder / "pics", splats.folder / "segovia/images_2")
    (splats.folder / "some").mkdir()
    shutil.copy(splats.folder / "pics/0004.exr", splats.folder / "some")
    scan = read_scan(splats.folder, OPTIONS)
    assert _taken(scan) == {"pics"}
    assert any("from pics/, the folder that holds most of them" in s for s in scan.warnings)


def test_the_only_mesh_beside_the_model_is_taken(tmp_path):
    made = colmap_capture(tmp_path / "room", "PINHOLE")
    (made.folder / "mesh.ply").rename(made.folder / "scan of the room.ply")
    scan = read_scan(made.folder, OPTIONS)
    assert len(scan.mesh.points) == len(made.points)
    (made.folder / "scan of the room.ply").rename(made.folder / "room.stl")
    with pytest.raises(InputRefused, match=r"no mesh that is read \(room\.stl .*poisson_mesher"):
        read_scan(made.folder, OPTIONS)
