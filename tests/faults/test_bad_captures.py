"""One fault per row: what is refused, by which rule, in which words; what is survived, and how.

Each row edits a capture that is good without it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.scenes import MadeCapture, edited, make_capture, ring_of_poses, write_ply
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.inspection import inspect
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.images import read_exr
from usdbrdf.options import IngestOptions, InspectOptions

Recipe = Callable[[MadeCapture], Any]


def _mesh(change: Callable[[np.ndarray, np.ndarray, np.ndarray], Any]) -> Recipe:
    """Write the mesh again after ``change(points, triangles, labels)``."""

    def recipe(capture: MadeCapture) -> None:
        arrays = [a.copy() for a in (capture.points, capture.triangles, capture.face_object)]
        write_ply(capture.folder / "mesh.ply", *(change(*arrays) or arrays))

    return recipe


def _manifest(change: Callable[[dict[str, Any]], Any]) -> Recipe:
    def recipe(capture: MadeCapture) -> None:
        with edited(capture.manifest) as document:
            change(document)

    return recipe


def _poses(change: Callable[[np.ndarray], np.ndarray]) -> Recipe:
    def recipe(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return _manifest(recipe)


def _images(which: range, pixels: Callable[[np.ndarray], np.ndarray]) -> Recipe:
    """Replace pixels; NaN and 2 channels go past our own writer, which would refuse them."""

    def recipe(capture: MadeCapture) -> None:
        for i in which:
            image = pixels(read_exr(capture.image(i))).astype(np.float32)
            spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], "half")
            spec.channelnames = ("R", "G", "B")[: image.shape[2]]
            output = oiio.ImageOutput.create(str(capture.image(i)))
            assert output.open(str(capture.image(i)), spec)
            assert output.write_image(image)
            assert output.close()

    return recipe


def _truncate(which: range, share: float) -> Recipe:
    def recipe(capture: MadeCapture) -> None:
        for i in which:
            data = capture.image(i).read_bytes()
            capture.image(i).write_bytes(data[: int(share * len(data))])

    return recipe


def _text(change: Callable[[str], str]) -> Recipe:
    def recipe(capture: MadeCapture) -> None:
        capture.manifest.write_text(change(capture.manifest.read_text()))

    return recipe


def _with_nan(share: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(image: np.ndarray) -> np.ndarray:
        image[: max(1, round(share * len(image)))] = np.nan
        return image

    return change


def _nan_vertices(points: np.ndarray, triangles: np.ndarray, labels: np.ndarray) -> None:
    points[: len(points) // 20] = np.nan


def _index_out_of_range(points: np.ndarray, triangles: np.ndarray, labels: np.ndarray) -> None:
    triangles[::20, 1] = len(points)


def _negative_index(points: np.ndarray, triangles: np.ndarray, labels: np.ndarray) -> None:
    triangles[::20, 1] = -3


def _too_few_labels(capture: MadeCapture) -> None:
    with edited(capture.folder / "objects.json") as document:
        document["face_object_id"] = capture.face_object[:-7].tolist()


def _id_twice(capture: MadeCapture) -> None:
    with edited(capture.folder / "objects.json") as document:
        document["objects"][1]["id"] = 0


def _symlink_out(capture: MadeCapture) -> None:
    outside = capture.folder.parent / "elsewhere.exr"
    capture.image(0).rename(outside)
    capture.image(0).symlink_to(outside)


def _frame(i: int, **entries: Any) -> Recipe:
    return _manifest(lambda document: document["frames"][i].update(entries))


def _all(**entries: Any) -> Recipe:
    return _manifest(lambda document: [frame.update(entries) for frame in document["frames"]])


_MIRROR = np.diag([1.0, 1, -1, 1])
_SHEAR = np.array([[1.0, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_DEEP = '{"frames": ' + "[" * 100 + "]" * 100 + "}"

REFUSED: dict[str, tuple[Recipe, str, list[str]]] = {
    # name: recipe, rule, words of the message: the file, what was found, the cure
    "missing mesh": (
        lambda c: (c.folder / "mesh.ply").unlink(),
        "mesh.missing",
        ["mesh.ply", "no mesh", "--mesh"],
    ),
    "empty mesh": (
        _mesh(lambda p, t, o: (p, t[:0], o[:0])),
        "mesh.empty",
        ["mesh.ply", "0 faces", "Export"],
    ),
    "nan vertices": (_mesh(_nan_vertices), "mesh.nonfinite", ["mesh.ply", "limit 1%", "Export"]),
    "face index out of range": (
        _mesh(_index_out_of_range),
        "mesh.index",
        ["mesh.ply", "5", "do not exist", "Export"],
    ),
    "negative face index": (_mesh(_negative_index), "mesh.index", ["mesh.ply", "Export"]),
    "label count": (_too_few_labels, "objects.count", ["objects.json", "377", "384", "per tri"]),
    "object id twice": (_id_twice, "objects.format", ["objects.json", "id 0", "Keep one"]),
    "objects not a list": (
        lambda c: (c.folder / "objects.json").write_text('{"objects": 3}'),
        "objects.format",
        ["objects.json"],
    ),
    "scaled poses": (
        _poses(lambda m: m @ np.diag([2.5, 2.5, 2.5, 1])),
        "capture.pose",
        ["transforms.json", "scaled by 2.5", "--pose-scale 2.5"],
    ),
    "sheared poses": (_poses(lambda m: m @ _SHEAR), "capture.pose", ["sheared", "Export"]),
    "mirrored poses": (_poses(lambda m: m @ _MIRROR), "capture.pose", ["mirrored", "OpenGL"]),
    "one viewpoint": (
        _poses(lambda m: np.hstack([m[:, :3], [[2.0], [1.5], [1.5], [1]]])),
        "capture.parallax",
        ["transforms.json", "no parallax", "several places"],
    ),
    "rays miss": (
        _poses(lambda m: m + np.outer([1, 0, 0, 0], [0, 0, 0, 100])),
        "capture.convention",
        ["transforms.json", "0%", "limit 20%", "frame and unit"],
    ),
    "many frames without pose": (
        _manifest(lambda d: [f.pop("transform_matrix") for f in d["frames"][:3]]),
        "capture.pose",
        ["9 of 12", "frames/0000.exr", "transform_matrix"],
    ),
    "infinity outside a pose": (
        _text(lambda text: re.sub(r"(\"fl_x\":)[^,]*", r"\1 1e999", text, count=1)),
        "document.nonfinite",
        ["transforms.json:", "1e999"],
    ),
    "many truncated images": (
        _truncate(range(3), 0.6),
        "capture.image",
        ["9 of 12", "frames/0000.exr", "truncated", "Export"],
    ),
    "wrong channels": (
        _images(range(12), lambda image: image[..., :2]),
        "capture.image",
        ["0 of 12", "no channels R, G and B", "'G'", "Export"],
    ),
    "all nan": (
        _images(range(12), lambda image: image * np.nan),
        "capture.nonfinite",
        ["no usable pixel in 12 frames", "100%", "--max-nonfinite"],
    ),
    "all saturated": (
        _images(range(12), lambda image: image * 0 + 64),
        "capture.saturated",
        ["all 12 frames", "no HDR headroom", "shorter exposures"],
    ),
    "all black": (_images(range(12), np.zeros_like), "capture.black", ["black", "Remove"]),
    "half width": (
        _images(range(12), lambda image: image[:, ::2]),
        "capture.size",
        ["16 x 24", "32 x 24", "intrinsics", "state the w and h"],
    ),
    "cropped images": (
        _images(range(12), lambda image: image[4:, :30]),
        "capture.size",
        ["30 x 20", "32 x 24", "intrinsics"],
    ),
    "size beyond all images": (_manifest(lambda d: d.update(w=1e10)), "capture.format", ["1e+10"]),
    "absurd size": (_manifest(lambda d: d.update(w=1e300)), "capture.format", ["w is beyond"]),
    "less than a pixel": (_manifest(lambda d: d.update(h=0.5)), "capture.format", ["h is 0.5"]),
    "absurd lens": (
        _manifest(lambda d: d.update(fl_x=1e12)),
        "capture.camera",
        ["frames/0000.exr", "1e+12", "32 x 24"],
    ),
    "absurd poses": (
        _poses(lambda m: m * [[1, 1, 1, 1e200], [1] * 4, [1] * 4, [1] * 4]),
        "capture.pose",
        ["transforms.json", "finite"],
    ),
    "singular applied_transform": (
        _manifest(lambda d: d.update(applied_transform=np.diag([1, 1, 1, 0]).tolist())),
        "capture.pose",
        ["applied_transform", "Correct or remove"],
    ),
    "lone surrogate": (
        _frame(0, file_path="frames/\ud800.exr"),
        "document.json",
        ["surrogate", "Correct it"],
    ),
    "a name of 5,000 characters": (
        _frame(5, file_path="frames/" + "x" * 5000),
        "paths.outside",
        ["frames/xxx", "too long"],
    ),
    "too few frames": (
        _manifest(lambda d: d.update(frames=d["frames"][:7])),
        "capture.frames",
        ["7 frames", "needed: 8", "Add"],
    ),
    "frame listed twice": (
        _manifest(lambda d: d["frames"].append(d["frames"][4])),
        "capture.duplicate",
        ["frames/0004.exr", "twice"],
    ),
    "mesh leads out": (
        _manifest(lambda d: d.update(mesh="../mesh.ply")),
        "paths.outside",
        ["'../mesh.ply'", "inside"],
    ),
    "image leads out": (
        _frame(0, file_path="/etc/passwd"),
        "paths.outside",
        ["'/etc/passwd'", "relative"],
    ),
    "image links out": (_symlink_out, "paths.outside", ["'frames/0000.exr'", "outside"]),
    "hostile name": (
        _frame(0, file_path="../\x1b[2J\n"),
        "paths.outside",
        [r"'../\x1b[2J\n'", "outside"],
    ),
    "fisheye": (
        _manifest(lambda d: d.update(camera_model="VR180_L")),
        "capture.camera",
        ["VR180_L", "OPENCV_FISHEYE", "Undistort"],
    ),
    "a list as camera model": (
        _manifest(lambda d: d.update(camera_model=[])),
        "capture.camera",
        ["camera model []", "OPENCV_FISHEYE"],
    ),
    "distortion": (
        _frame(2, distortion_params=[0.01, "x"]),
        "capture.camera",
        ["frames/0002.exr", "distortion_params", "Correct"],
    ),
    "distortion that squeezes": (
        _manifest(lambda d: d.update(k1=1e10)),
        "capture.camera",
        ["frames/0000.exr", "k1 10000000000.0", "degrees off its axis", "Correct", "distortion"],
    ),
    "distortion that stretches": (
        _manifest(lambda d: d.update(k1=5)),
        "capture.camera",
        ["frames/0000.exr", "k1 5.0", "degrees off its axis in the corner"],
    ),
    "intrinsics in parts of the picture": (
        _manifest(lambda d: d.update(fl_x=0.6, fl_y=0.8, cx=0.5, cy=0.5)),
        "capture.camera",
        ["frames/0000.exr", "176 degrees wide", "in pixels"],
    ),
    "focal length in mm": (
        _manifest(lambda d: d.update(fl_x=2.4, fl_y=2.4)),
        "capture.camera",
        ["frames/0000.exr", "2.4, 2.4, 16, 12", "in pixels, not in mm"],
    ),
    "principal point in parts of the picture": (
        _manifest(lambda d: d.update(cx=0.5, cy=0.5)),
        "capture.camera",
        ["frames/0000.exr", "cx and cy are pixels from its corner"],
    ),
    "principal point from the middle": (
        _manifest(lambda d: d.update(cx=0, cy=-0.25)),
        "capture.camera",
        ["frames/0000.exr", "not from its middle"],
    ),
    "principal point pixels from the middle": (
        _manifest(lambda d: d.update(cx=3, cy=-2)),
        "capture.camera",
        ["frames/0000.exr", "not from its middle"],
    ),
    "distortion that turns back": (
        _manifest(lambda d: d.update(k1=-20)),
        "capture.camera",
        ["frames/0000.exr", "k1 -20.0", "turns back", "have no direction"],
    ),
    "distortion that moves aside": (
        _manifest(lambda d: d.update(p1=1e3)),
        "capture.camera",
        ["frames/0000.exr", "p1 1000.0", "moves its corners aside"],
    ),
    "panorama of another shape": (
        _manifest(lambda d: d.update(camera_model="EQUIRECTANGULAR")),
        "capture.camera",
        ["frames/0000.exr", "32 x 24", "2 : 1"],
    ),
    "no focal length": (
        _manifest(lambda d: [d.pop("fl_x"), d.pop("fl_y")]),
        "capture.camera",
        ["fl_x", "camera_angle_x"],
    ),
    "negative exposure": (_all(exposure_time=-1), "capture.format", ["exposure_time is -1"]),
    "text for a number": (_all(cx="middle"), "capture.format", ["cx is 'middle'"]),
    "not json": (_text(lambda text: text[:200]), "document.json", ["transforms.json:"]),
    "deep json": (_text(lambda text: _DEEP), "document.depth", ["transforms.json", "64 levels"]),
    "duplicate key": (
        _text(lambda text: text.replace('"w": 32', '"w": 32, "w": 64', 1)),
        "document.duplicate",
        ["transforms.json:", "'w'"],
    ),
    "no frames": (_text(lambda text: "[]"), "capture.format", ["transforms.json", '"frames"']),
}

DROPPED: dict[str, tuple[Recipe, str, list[str]]] = {
    "frame without pose": (
        _manifest(lambda d: d["frames"][3].pop("transform_matrix")),
        "capture.pose",
        ["frames/0003.exr", "1 of 12"],
    ),
    "pose with null": (_frame(3, transform_matrix=[[None] * 4] * 4), "capture.pose", ["0003"]),
    "infinity in a pose": (
        _text(lambda text: re.sub(r"(_matrix\":\s*\[\s*\[)[^,]*", r"\1 1e999", text, count=1)),
        "capture.pose",
        ["frames/0000.exr", "1 of 12", "finite"],
    ),
    "frame without file": (
        lambda c: c.image(5).unlink(),
        "capture.file",
        ["frames/0005.exr", "does not exist"],
    ),
    "empty file_path": (
        _frame(4, file_path=""),
        "capture.file",
        ["frames[4]", "its file_path is empty"],
    ),
    "no file_path": (
        _manifest(lambda d: d["frames"][4].pop("file_path")),
        "capture.file",
        ["frames[4]", "it has no file_path"],
    ),
    "truncated image": (
        _truncate(range(2, 3), 0.6),
        "capture.image",
        ["frames/0002.exr", "truncated"],
    ),
    "empty image": (_truncate(range(2, 3), 0), "capture.image", ["frames/0002.exr", "empty"]),
    "nan beyond the limit": (
        _images(range(1), _with_nan(0.3)),
        "capture.nonfinite",
        ["frames/0000.exr", "limit 1%"],
    ),
    "saturated frame": (
        _images(range(1), lambda image: image * 0 + 64),
        "capture.saturated",
        ["frames/0000.exr"],
    ),
    "black frame": (_images(range(1), np.zeros_like), "capture.black", ["frames/0000.exr"]),
    "wrong size": (
        _images(range(1), lambda image: image[:-1]),
        "capture.size",
        ["frames/0000.exr", "32 x 23"],
    ),
    "duplicate image": (
        lambda c: c.image(7).write_bytes(c.image(6).read_bytes()),
        "capture.duplicate",
        ["frames/0007.exr", "frames/0006.exr"],
    ),
}


@pytest.fixture
def capture(tmp_path: Path) -> MadeCapture:
    return make_capture(tmp_path / "capture")


def _files(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


def test_the_capture_is_good_without_a_fault(capture):
    scan = read_scan(capture.folder, IngestOptions())
    assert len(scan.frames) == 12
    assert scan.warnings == ()


@pytest.mark.fault("I1", "many truncated images")
@pytest.mark.fault("I5", "all nan")
@pytest.mark.fault("I7", "half width", "cropped images")
@pytest.mark.fault("I8", "wrong channels")
@pytest.mark.fault("C1", "many frames without pose", "too few frames")
@pytest.mark.fault("C2", "scaled poses", "sheared poses")
@pytest.mark.fault("C3", "mirrored poses")
@pytest.mark.fault("C4", "infinity outside a pose")
@pytest.mark.fault("C5", "one viewpoint")
@pytest.mark.fault("C6", "frame listed twice")
@pytest.mark.fault("C7", "rays miss")
@pytest.mark.fault("C10", "all saturated")
@pytest.mark.fault("C11", "all black")
@pytest.mark.fault("C12", "fisheye", "a list as camera model", "distortion")
@pytest.mark.fault("C12", "distortion that squeezes", "distortion that turns back")
@pytest.mark.fault("C12", "distortion that moves aside", "panorama of another shape")
@pytest.mark.fault("C12", "distortion that stretches", "intrinsics in parts of the picture")
@pytest.mark.fault("C12", "focal length in mm", "principal point in parts of the picture")
@pytest.mark.fault(
    "C12", "principal point from the middle", "principal point pixels from the middle"
)
@pytest.mark.fault("C13", "not json", "deep json", "duplicate key")
@pytest.mark.fault("G1", "missing mesh", "empty mesh")
@pytest.mark.fault("G2", "nan vertices", "face index out of range", "negative face index")
@pytest.mark.fault("G10", "label count")
@pytest.mark.fault("S1", "mesh leads out", "image leads out", "image links out")
@pytest.mark.fault("S4", "hostile name")
@pytest.mark.parametrize("fault", REFUSED)
def test_fault_is_refused(capture, fault):
    recipe, rule, words = REFUSED[fault]
    recipe(capture)
    before = _files(capture.folder.parent)
    with pytest.raises(UsdBrdfError) as refused:
        read_scan(capture.folder, IngestOptions())
    message = str(refused.value)
    assert isinstance(refused.value, InputRefused)
    assert refused.value.exit_code == 3
    assert re.fullmatch(rf"[^\n]+: [^\n]+ \[{re.escape(rule)}\]", message), message
    assert [word for word in words if word not in message] == [], message
    assert str(capture.folder) in message
    told = inspect(capture.folder, InspectOptions(checked=4))
    assert str(told.refusals[-1]) == message
    assert (told.refusals[0] is told.refusals[-1]) or told.granted
    assert _files(capture.folder.parent) == before


@pytest.mark.fault("I1", "truncated image")
@pytest.mark.fault("I3", "nan beyond the limit")
@pytest.mark.fault("I13", "empty image")
@pytest.mark.fault("C1", "frame without pose", "frame without file")
@pytest.mark.fault("C1", "empty file_path", "no file_path")
@pytest.mark.fault("C4", "infinity in a pose", "pose with null")
@pytest.mark.fault("C6", "duplicate image")
@pytest.mark.fault("C10", "saturated frame")
@pytest.mark.fault("C11", "black frame")
@pytest.mark.parametrize("fault", DROPPED)
def test_fault_of_one_frame_drops_it_with_a_warning(capture, fault):
    recipe, rule, words = DROPPED[fault]
    recipe(capture)
    scan = read_scan(capture.folder, IngestOptions())
    assert len(scan.frames) == 11
    assert scan.counts["frames_dropped"] == 1
    (warning,) = scan.warnings
    assert warning.endswith(f"[{rule}]")
    assert [word for word in words if word not in warning] == [], warning


@pytest.mark.fault("I3")
@pytest.mark.fault("I4")
def test_small_faults_are_counted_and_nothing_is_dropped(capture):
    def spoil(image: np.ndarray) -> np.ndarray:
        image[0, 0, 0] = np.nan
        image[0, 1] = np.inf
        image[0, 2] = -1e-5
        image[0, 3] = -1
        return image

    _images(range(1), spoil)(capture)
    scan = read_scan(capture.folder, IngestOptions())
    assert len(scan.frames) == 12
    assert scan.counts["pixels_unknown"] == 3
    assert scan.counts["pixels_negative_clamped"] == 1


@pytest.mark.fault("I3")
def test_the_limit_of_nonfinite_pixels_is_an_option(capture):
    _images(range(12), _with_nan(0.3))(capture)
    with pytest.raises(InputRefused, match="--max-nonfinite"):
        read_scan(capture.folder, IngestOptions())
    assert len(read_scan(capture.folder, IngestOptions(max_nonfinite=0.4)).frames) == 12


@pytest.mark.fault("C2")
def test_pose_scale_divides_the_stated_factor_out(capture):
    _poses(lambda m: m @ np.diag([2.5, 2.5, 2.5, 1]))(capture)
    scan = read_scan(capture.folder, IngestOptions(pose_scale=2.5))
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera, atol=1e-9)
    with pytest.raises(InputRefused, match=r"scaled by 2\.5 .*--pose-scale 2\.5"):
        read_scan(capture.folder, IngestOptions(pose_scale=3))


_QUARTER = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.mark.fault("C7")
@pytest.mark.parametrize(
    ("convention", "change"),
    [
        ("OpenCV axes", lambda m: m @ np.diag([1.0, -1, -1, 1])),
        ("camera-from-world matrices", np.linalg.inv),
        ("beside a mesh turned by 90 degrees about z", lambda m: _QUARTER.T @ m),
        ("beside a mesh turned by 180 degrees about z", lambda m: _QUARTER @ _QUARTER @ m),
    ],
)
def test_the_convention_that_would_hit_is_named(tmp_path, convention, change):
    capture = make_capture(tmp_path / "box", room=False)
    assert len(read_scan(capture.folder, IngestOptions()).frames) == 12
    _poses(change)(capture)
    with pytest.raises(InputRefused, match=rf"would hit: {convention}.*: \d\d%"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.fault("C7")
def test_a_thing_that_is_small_in_its_pictures_is_no_mix_up(tmp_path):
    """A box that fills less of them than the limit, and cameras that would look past it."""
    poses = ring_of_poses(12, radius=3.2, height=1.8)
    capture = make_capture(tmp_path / "box", room=False, poses=poses)
    scan = read_scan(capture.folder, IngestOptions())
    assert len(scan.frames) == 12
    assert 2 <= scan.counts["rays_hit_percent"] < 20
    # Nor is it where it stands at the origin, and any smaller unit brings the cameras nearer.
    middle = (capture.points.min(axis=0) + capture.points.max(axis=0)) / 2
    mesh = capture.triangles, capture.face_object
    write_ply(capture.folder / "mesh.ply", (capture.points - middle).astype(np.float32), *mesh)
    moved = np.outer([1, 0, 0, 0], [0, 0, 0, 1.0])
    moved[:3, 3] = middle
    _poses(lambda m: m - np.where(np.arange(4) == 3, moved, 0))(capture)
    assert len(read_scan(capture.folder, IngestOptions()).frames) == 12
    write_ply(capture.folder / "mesh.ply", capture.points, *mesh)
    _poses(lambda m: m + np.where(np.arange(4) == 3, moved, 0))(capture)
    _poses(lambda m: m + np.outer([1, 0, 0, 0], [0, 0, 0, 1.5]))(capture)
    with pytest.raises(InputRefused, match=r"of the camera rays hit the mesh"):
        read_scan(capture.folder, IngestOptions())


@pytest.mark.fault("S1")
def test_allow_outside_opens_one_folder_and_no_other(capture):
    _symlink_out(capture)
    with pytest.raises(InputRefused, match=r"\[paths.outside\]"):
        read_scan(capture.folder, IngestOptions(allow_outside=(capture.folder / "frames",)))
    scan = read_scan(capture.folder, IngestOptions(allow_outside=(capture.folder.parent,)))
    assert scan.frames.image_paths[0].name == "elsewhere.exr"


@pytest.mark.fault("C13")
@pytest.mark.parametrize("name", ["transforms.json", "mesh.ply", "objects.json"])
@pytest.mark.parametrize("seed", range(13))
def test_a_damaged_document_ends_in_a_refusal_or_in_the_scan_that_it_tells(capture, name, seed):
    """Whatever bytes are overwritten, no foreign exception comes out. What is not refused is sound:
    every frame, object and triangle is there and finite, or is said to be left out."""
    rng = np.random.default_rng(seed)
    data = bytearray((capture.folder / name).read_bytes())
    for place in rng.integers(len(data), size=rng.integers(1, 4)):
        data[place] = rng.integers(256)
    (capture.folder / name).write_bytes(bytes(data))
    message = ""
    try:
        scan = read_scan(capture.folder, IngestOptions())
    except InputRefused as refused:
        message = str(refused)
    if message:
        assert re.search(r" \[[a-z_.]+\]$", message)
        return
    assert len(scan.frames) + scan.counts.get("frames_dropped", 0) == 12
    reasons = ("broken_faces", "degenerate_faces", "duplicate_faces")
    removed = sum(scan.counts.get(reason, 0) for reason in reasons)
    # A face that came to lie so that frames see both its sides has two skins.
    twice = scan.counts.get("faces_of_two_sides", 0)
    assert len(scan.mesh.triangles) == len(capture.triangles) - removed + twice
    assert np.isfinite(scan.mesh.points).all()
    assert np.isfinite(scan.frames.world_from_camera).all()
    assert np.isfinite(scan.frames.intrinsics).all()
    assert (np.bincount(scan.mesh.face_object) > 0).all()
    assert len(scan.objects) == scan.mesh.face_object.max() + 1


def test_some_damage_is_refused_and_some_is_harmless(capture):
    """The test above would say nothing if all of it were either."""
    whole = capture.manifest.read_bytes()
    capture.manifest.write_bytes(whole.replace(b"{", b"}", 1))
    with pytest.raises(InputRefused, match=r"\[document\.json\]$"):
        read_scan(capture.folder, IngestOptions())
    capture.manifest.write_bytes(whole + b" ")
    assert len(read_scan(capture.folder, IngestOptions()).frames) == 12


def test_the_manifest_written_here_is_strict_json(capture):
    json.loads(capture.manifest.read_text(), parse_constant=lambda name: pytest.fail(name))
