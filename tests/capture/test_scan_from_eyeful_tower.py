"""A room of Eyeful Tower, written as its README and its converter from Metashape have it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from tests.scenes import edited
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.eyeful_tower import frame_records
from usdbrdf.capture.formats.named_pictures import pictures_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

# From z up to y up.
TURN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_FULL = 4  # times the size of the pictures


@pytest.fixture
def room():
    return truth()


@pytest.fixture
def capture(tmp_path, room):
    return write_rig(tmp_path / "office1a", room)


def write_rig(folder, room):
    """The room as this data set has its own; returns the folder."""
    rows = []
    for i, pose in enumerate(room.opencv):
        name = f"{i % 2}/{i % 2}_REN{i:04d}"
        fx, fy, cx, cy = room.intrinsics[i] * _FULL
        camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        row = {"cameraId": name, "width": WIDTH * _FULL, "height": HEIGHT * _FULL}
        row |= {"K": camera.T.tolist(), "T": np.linalg.inv(TURN @ pose).T.tolist()}
        row |= {"distortionModel": "RadialAndTangential", "distortion": [0.0] * 5}
        rows.append({**row, "frameId": i, "sensorId": i % 2})
        write_image(folder / "images-2k" / f"{name}.exr", room.images[i])
        write_image(folder / "images-jpeg-2k" / f"{name}.jpg", room.images[i])
    gone = {**rows[0], "cameraId": "1/1_REN0999"}  # a picture that was taken out of the data
    (folder / "cameras.json").write_text(json.dumps({"KRT": [*rows, gone]}))
    write_obj(folder / "mesh.obj", room, room.points @ TURN[:3, :3].T)
    (folder / "cameras.xml").write_text("<document><chunk><sensors/></chunk></document>")
    (folder / "transforms.json").write_text('{"frames": []}')
    return folder


def test_a_room_of_the_rig(capture, room):
    assert choose_adapter(capture).name == "eyeful-tower"
    scan = read_scan(capture, IngestOptions())
    # The rig's cameras one after another.
    order = sorted(range(len(room.images)), key=lambda i: (i % 2, i))
    points = room.points @ TURN[:3, :3].T
    assert_same(scan, room, points=points, poses=(TURN @ room.world_from_camera)[order])
    assert (scan.up_axis, scan.meters_per_unit) == ("Y", 1.0)
    assert scan.frames.encoding == "lin_p3d65_scene"
    assert scan.counts["poses_without_photograph"] == 1
    plain = read_scan(capture, IngestOptions(encoding="lin_rec709_scene"))
    assert plain.frames.encoding == "lin_rec709_scene"


def test_the_fisheye_of_the_first_rig_is_equidistant(capture, room):
    terms = [-0.02, 0.004, -0.001, 0.0, 0.0, 0.0, 0.003, -0.002]
    with edited(capture / "cameras.json") as document:
        for row in document["KRT"]:
            row |= {"distortionModel": "Fisheye", "distortion": terms}
    pictures = pictures_of(capture, IngestOptions(), "images-2k")
    record = frame_records(capture / "cameras.json", pictures, Findings())[0]
    points = np.random.default_rng(0).uniform((-2, -2, -1), (2, 2, -0.3), (50, 3))
    x, y, z = points[:, 0], -points[:, 1], -points[:, 2]
    angle, across = np.arctan2(np.hypot(x, y), z), np.hypot(x, y)
    u, v = angle * x / across, angle * y / across
    r2 = u**2 + v**2
    bend = 1 - 0.02 * r2 + 0.004 * r2**2 - 0.001 * r2**3
    p1, p2 = terms[6:]
    du = u * bend + 2 * p1 * u * v + p2 * (r2 + 2 * u**2)
    dv = v * bend + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v
    fx, fy, cx, cy = room.intrinsics[0] * _FULL
    expected = np.stack([cx + fx * du, cy + fy * dv], axis=1)
    np.testing.assert_allclose(record.lens.project(points, record.intrinsics), expected, atol=1e-6)


def _no_mesh(capture):
    (capture / "mesh.obj").unlink()


def _no_pictures(capture):
    for path in capture.glob("images*"):
        path.rename(capture / f"away-{path.name}")


def _other_lens(capture):
    with edited(capture / "cameras.json") as document:
        document["KRT"][3]["distortionModel"] = "Pinhole"


def _no_terms(capture):
    with edited(capture / "cameras.json") as document:
        del document["KRT"][3]["distortion"]


def _more_terms(capture):
    """A fisheye of six radial terms and two tangential ones, as Project Aria has it."""
    with edited(capture / "cameras.json") as document:
        terms = [-0.02, 0.004, -0.001, 0.0, 0.002, 0.0, 0.003, -0.002]
        document["KRT"][3] |= {"distortionModel": "Fisheye", "distortion": terms}


def _sixth_term(capture):
    with edited(capture / "cameras.json") as document:
        document["KRT"][3]["distortion"] = [0.0] * 5 + [0.1]


def _other_names(capture):
    with edited(capture / "cameras.json") as document:
        for row in document["KRT"]:
            row["cameraId"] = f"x{row['cameraId']}y"


def _no_list(capture):
    (capture / "cameras.json").write_text('{"KRT": 1}')


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_mesh, r"no mesh\. Download mesh.obj.*--mesh\. \[mesh.missing\]"),
        (_no_pictures, r"no pictures below.*\[capture.frames\]"),
        (_other_lens, r"the lens of '1/1_REN0003' is 'Pinhole'.*\[capture.camera\]"),
        (_no_terms, r"the lens of '1/1_REN0003' is 'RadialAndTangential', not.* with its terms"),
        (_more_terms, r"the lens of '1/1_REN0003' has more terms than its model Fisheye"),
        (_sixth_term, r"has more terms than its model RadialAndTangential.*\[capture.camera\]"),
        (_other_names, r"none of its 11 cameras has a picture in images-2k.*\[capture.frames\]"),
        (_no_list, r"no list \"KRT\".*\[capture.format\]"),
    ],
)
def test_refusals(capture, damage, sentence):
    damage(capture)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(capture, IngestOptions())


def test_alembic_names_the_way_out(tmp_path):
    (tmp_path / "shot.abc").write_bytes(b"Ogawa")
    for path in (tmp_path, tmp_path / "shot.abc"):
        assert choose_adapter(path).name == "alembic"
        with pytest.raises(InputRefused, match=r"as USD.*\[capture.format\]"):
            read_scan(path, IngestOptions())
