"""The committed sample capture is complete and agrees with itself. Needs no renderer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from usdbrdf.files.images import read_exr

STUDY = Path(__file__).resolve().parents[2] / "samples" / "study"
LARGEST_FOLDER = 8_000_000  # bytes; it is cloned with the source
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3), ("object_id", "<i4")])

Array = npt.NDArray[Any]


def document(name: str) -> Any:
    return json.loads((STUDY / name).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def capture() -> dict[str, Any]:
    return dict(document("transforms.json"))


@pytest.fixture(scope="module")
def mesh() -> tuple[Array, Array]:
    """(V, 3) points and the faces of the PLY, read without any of our own code."""
    header, body = (STUDY / "mesh.ply").read_bytes().split(b"end_header\n", 1)
    count = {
        words[1]: int(words[2])
        for words in (line.split() for line in header.decode().splitlines())
        if words[0] == "element"
    }
    points = np.frombuffer(body, "<f4", 3 * count["vertex"]).reshape(-1, 3)
    faces = np.frombuffer(body, FACE, offset=points.nbytes)
    assert len(faces) == count["face"]
    return points, faces


def test_it_is_complete_and_small(capture: dict[str, Any]) -> None:
    files = {p.relative_to(STUDY).as_posix(): p.stat().st_size for p in STUDY.rglob("*.*")}
    views = [f"truth/{view['file_path']}" for view in document("truth/views.json")["frames"]]
    needed = [frame["file_path"] for frame in capture["frames"]] + views
    needed += ["mesh.ply", "objects.json", "transforms.json", "README.md", "truth/views.json"]
    needed += ["truth/objects.json", "truth/albedo_vertex.npz"]
    assert set(needed) == set(files)
    assert len(views) >= 2
    assert sum(files.values()) <= LARGEST_FOLDER


def test_objects_mesh_and_truth_speak_of_the_same_things(mesh: tuple[Array, Array]) -> None:
    labels, truth = document("objects.json")["objects"], document("truth/objects.json")
    points, faces = mesh
    assert len(labels) >= 8
    assert [item["id"] for item in labels] == list(range(len(labels)))
    assert [(t["id"], t["name"]) for t in truth] == [(o["id"], o["name"]) for o in labels]
    assert np.array_equal(np.unique(faces["object_id"]), np.arange(len(labels)))
    assert np.all(faces["count"] == 3)
    assert np.array_equal(np.unique(faces["vertices"]), np.arange(len(points)))
    with np.load(STUDY / "truth/albedo_vertex.npz") as stored:
        albedo = stored["albedo"]
    assert albedo.shape == points.shape
    assert albedo.min() >= 0
    assert albedo.max() <= 1


def test_materials_cover_a_range_and_two_lamps_are_lit(capture: dict[str, Any]) -> None:
    truth = document("truth/objects.json")
    classes = [item["class_name"] for item in document("objects.json")["objects"]]
    lit = [item["id"] for item in truth if max(item["emission"]) > 0]
    assert lit == [k for k, name in enumerate(classes) if name == "lamp"]
    assert len(lit) == 2
    phi, psi = (np.array([item[key] for item in truth]) for key in ("phi", "psi"))
    assert phi.min() >= 0
    assert psi.min() >= 0
    assert max(phi.max(), psi.max()) <= 1
    assert np.sum((phi <= 0.2) & (psi >= 0.5)) >= 4
    assert np.sum(phi >= 0.6) >= 3
    brightest = max(max(truth[k]["emission"]) for k in lit)
    assert brightest < 0.95 * max(frame["saturation_radiance"] for frame in capture["frames"])


def test_exposures_come_in_turn_and_frames_stay_within_their_limits(
    capture: dict[str, Any],
) -> None:
    frames = capture["frames"]
    times = [frame["exposure_time"] for frame in frames]
    assert len(set(times)) == 3
    assert times == (times[:3] * len(times))[: len(times)]
    for frame in frames:
        full = frame["saturation_radiance"]
        assert full * frame["exposure_time"] == pytest.approx(0.8 / 15)
        assert 0 < frame["noise_floor_radiance"] < 0.002 * full
        pixels = read_exr(STUDY / frame["file_path"])
        assert pixels.shape == (capture["h"], capture["w"], 3)
        assert np.isfinite(pixels).all()
        assert pixels.min() >= 0
        assert pixels.max() <= 1.001 * full
        assert np.mean(pixels >= frame["noise_floor_radiance"]) > 0.5


def test_poses_are_rigid_and_held_out_views_are_not_among_the_frames(
    capture: dict[str, Any],
) -> None:
    poses = np.array([frame["transform_matrix"] for frame in capture["frames"]])
    views = document("truth/views.json")
    held_out = np.array([view["transform_matrix"] for view in views["frames"]])
    for pose in [*poses, *held_out]:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    for view, pose in zip(views["frames"], held_out, strict=True):
        assert np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1).min() > 0.05
        pixels = read_exr(STUDY / "truth" / view["file_path"])
        assert pixels.shape == (views["h"], views["w"], 3)
        assert np.isfinite(pixels).all()


def test_the_globe_is_where_the_poses_say_and_as_bright(
    capture: dict[str, Any], mesh: tuple[Array, Array]
) -> None:
    points, faces = mesh
    lamp = next(t for t in document("truth/objects.json") if t["name"] == "globe_lamp")
    corners = points[faces["vertices"][faces["object_id"] == lamp["id"]]]
    centre = np.append((corners.min((0, 1)) + corners.max((0, 1))) / 2, 1.0)
    seen = []
    for frame in capture["frames"]:
        x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ centre
        column = capture["cx"] + capture["fl_x"] * x / max(-z, 1e-9)
        row = capture["cy"] - capture["fl_y"] * y / max(-z, 1e-9)
        if -z < 0.2 or not (3 < column < capture["w"] - 3 and 3 < row < capture["h"] - 3):
            continue
        pixel = read_exr(STUDY / frame["file_path"])[int(row), int(column)]
        expected = np.minimum(lamp["emission"], frame["saturation_radiance"])
        # It reflects a little besides, and the sensor is noisy.
        np.testing.assert_allclose(pixel, expected, rtol=0.08)
        seen.append(frame["exposure_time"])
    assert len(set(seen)) == 3
