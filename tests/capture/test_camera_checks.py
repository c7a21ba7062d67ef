"""What is said where few rays of the cameras hit the mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes import edited, make_capture, write_ply
from usdbrdf.capture import camera_checks
from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

PROBE = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def _shares(monkeypatch, *, own, others, framed):
    def hit(scene, frames, read):
        return own if np.array_equal(read(PROBE), PROBE) else others

    monkeypatch.setattr(camera_checks, "_hit_share", hit)
    monkeypatch.setattr(camera_checks, "_units", lambda scene, frames: {})
    monkeypatch.setattr(camera_checks, "_framed_share", lambda scene, frames: framed)


def test_of_a_mesh_of_a_part_no_other_reading_of_the_poses_is_named(monkeypatch):
    """Of a figure in a room, seen closely: any rays hit a little more or less of it."""
    _shares(monkeypatch, own=0.18, others=0.21, framed=0.5)
    with pytest.raises(InputRefused, match=r"18% of .* None of 17 usual conventions does"):
        camera_checks.refuse_rays_that_miss(None, None, Path("room"))
    _shares(monkeypatch, own=0.18, others=0.21, framed=0.9)
    assert camera_checks.refuse_rays_that_miss(None, None, Path("room")) == 0.18


def test_readings_that_hit_clearly_more_are_named(monkeypatch):
    _shares(monkeypatch, own=0.12, others=0.5, framed=0.9)
    with pytest.raises(InputRefused, match=r"Other readings of the poses would hit: .*50%"):
        camera_checks.refuse_rays_that_miss(None, None, Path("room"))


@pytest.mark.fault("C7")
@pytest.mark.parametrize(
    ("larger", "rule", "unit"),
    [
        (1000.0, "convention", "would hit: positions in millimetres and a mesh in metres"),
        (100.0, "convention", "would hit: positions in centimetres and a mesh in metres"),
        (0.001, "parallax", "have not if they are positions in metres and a mesh in millimetres"),
    ],
)
@pytest.mark.parametrize("axes", [1, -1], ids=["OpenGL", "OpenCV"])
def test_the_unit_that_would_fit_is_named(tmp_path, larger, rule, unit, axes):
    """Also where the axes are mixed up too."""
    made = make_capture(tmp_path / "scan")
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"]) @ np.diag([1, axes, axes, 1])
            pose[:3, 3] *= larger if rule == "convention" else 1
            frame["transform_matrix"] = pose.tolist()
    if rule == "parallax":
        write_ply(made.folder / "mesh.ply", made.points / larger, made.triangles, made.face_object)
    with pytest.raises(InputRefused, match=rf"{unit} .*\[capture\.{rule}\]$"):
        read_scan(made.folder, IngestOptions())


@pytest.mark.parametrize(
    ("times", "stated", "told"),
    [
        (100.0, {}, "0.01 if it is"),
        (1000.0, {}, "0.001 if it is"),
        (100.0, {"meters_per_unit": 1.0}, ""),
        (1.0, {}, ""),
        (5.0, {}, ""),
    ],
)
def test_a_room_of_hundreds_of_metres_whose_unit_is_not_stated_is_told(
    tmp_path, times, stated, told
):
    """In centimetres, most likely; what is stated is believed, and nothing is rescaled."""
    made = make_capture(tmp_path / "scan", subdivisions=1)
    with edited(made.manifest) as document:
        document.pop("meters_per_unit", None)
        document.update(stated)
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] *= times
            frame["transform_matrix"] = pose.tolist()
    write_ply(made.folder / "mesh.ply", made.points * times, made.triangles, made.face_object)
    scan = read_scan(made.folder, IngestOptions())
    said = [sentence for sentence in scan.warnings if "[capture.unit]" in sentence]
    assert len(said) == bool(told)
    assert told in "".join(said)
    assert scan.meters_per_unit == 1.0
    given = read_scan(made.folder, IngestOptions(meters_per_unit=1.0))
    assert not any("[capture.unit]" in sentence for sentence in given.warnings)
