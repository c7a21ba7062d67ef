"""Whether poses, mesh and frames agree, and under which reading of the poses they would."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import edited, make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.capture.adapters import read_scan
from usdbrdf.cli import main
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.texturing.agreement import (
    Agreement,
    agreement,
    logarithms_in_frame,
    other_convention,
    points_of_surface,
)
from usdbrdf.transport.rays import RayScene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
READINGS = {
    "OpenCV axes": lambda m: m @ FLIP,
    "camera-from-world matrices": np.linalg.inv,
    "rotations transposed": lambda m: np.block([[m[:3, :3].T, m[:3, 3:]], [m[3:]]]),
    "y-up poses": lambda m: (
        np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]) @ m
    ),
}


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "room", frames=24, noise=0.03, noise_floor_radiance=0)


def _columns(scan):
    rays = RayScene(scan.mesh.points, scan.mesh.triangles)
    surface = points_of_surface(scan.mesh)
    frames = scan.frames
    return surface, np.stack(
        [
            logarithms_in_frame(surface, rays, frames.camera(i), read_frame(frames, i))
            for i in range(len(frames))
        ],
        axis=1,
    )


def test_points_show_the_radiance_of_their_object(capture):
    scan = read_scan(capture.folder, IngestOptions())
    surface, logarithm = _columns(scan)
    # 0.7 m and more above the ground and inside are walls, by the room's measures.
    x, y, z = surface.point.T
    wall = ((x < 1e-3) | (x > 4 - 1e-3) | (y < 1e-3) | (y > 3 - 1e-3)) & (z > 0.1) & (z < 2.3)
    shown = logarithm[wall]
    assert np.isfinite(shown).sum() > 1000
    expected = np.log(np.mean(capture.radiance["walls"]))
    assert np.nanmedian(np.abs(shown - expected)) < 0.02
    found = agreement(logarithm)
    assert found.scatter < 0.08
    assert found.ratio < 0.2


def test_a_capture_that_agrees_is_told_so(capture, tmp_path, capsys):
    assert main(["inspect", str(capture.folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["agreement"] < 0.2
    assert main(["ingest", str(capture.folder), "-o", str(tmp_path / "out"), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["steps"]["ingest"]["agreement"] < 0.2
    assert "warning" not in err


@pytest.mark.parametrize("name", READINGS)
def test_the_convention_that_fits_is_named(capture, name, capsys):
    """All rays hit a closed room whatever the poses say, or too few do: either way one is named."""
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"] = READINGS[name](np.array(frame["transform_matrix"])).tolist()
    assert main(["inspect", str(capture.folder)]) == 3
    err = capsys.readouterr().err
    assert err.endswith("[capture.convention]\n")
    assert name in err


def test_poses_that_fit_under_no_reading_raise_a_doubt(capture, tmp_path, capsys):
    rng = np.random.default_rng(1)
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
            frame["transform_matrix"] = pose.tolist()
    assert main(["inspect", str(capture.folder)]) == 0
    assert "[capture.agreement]" in capsys.readouterr().out
    call = ["ingest", str(capture.folder), "-o", str(tmp_path / "out"), "--json", "--strict"]
    assert main(call) == 7
    told, err = capsys.readouterr()
    warnings = json.loads(told)["steps"]["ingest"]["warnings"]
    (warning,) = [one for one in warnings if one.endswith("[capture.agreement]")]
    assert warning in err
    assert str(tmp_path) not in warning


def test_few_samples_say_nothing():
    assert agreement(np.full((100, 4), np.nan, np.float32)) is None
    assert agreement(np.zeros((100, 4), np.float32)) is None
    good, bad = Agreement(0.05, 0.1, 5000), Agreement(0.5, 0.9, 5000)
    assert other_convention(bad, {"a": bad, "b": good, "c": None}) == "b"
    assert other_convention(bad, {"b": good._replace(samples=900)}) == ""
    assert other_convention(bad, {"a": bad._replace(ratio=0.8)}) == ""
    assert other_convention(None, {"b": good}) == "b"


def test_estimated_exposures_reach_every_reader_of_frames(capture, tmp_path, capsys):
    wrong = {3: 2**0.5, 11: 2**-0.5}
    for i, factor in wrong.items():
        write_exr(capture.image(i), np.float32(factor) * read_exr(capture.image(i)), half=False)
    out = tmp_path / "out"
    arguments = ["ingest", str(capture.folder), "-o", str(out), "--json", "--exposure", "estimate"]
    assert main(arguments) == 0
    printed, err = capsys.readouterr()
    told = json.loads(printed)["steps"]["ingest"]
    assert any("[capture.exposure]" in warning for warning in told["warnings"])
    found = told["estimated_exposures"]
    assert found == {f"{i:04d}.exr": pytest.approx(factor, rel=0.03) for i, factor in wrong.items()}
    assert "2 of 24 frames" in err
    assert "[capture.exposure]" in err
    frames = AssetMaps(open_weaker(Asset.at(out), "texturing")).frames
    true = {i: read_exr(capture.image(i)) / factor for i, factor in wrong.items()}
    for i, image in true.items():
        np.testing.assert_allclose(read_frame(frames, i).radiance, image, rtol=0.03)
    limit = frames.saturation_radiance
    np.testing.assert_allclose(limit[11] / limit[3], 2.0, rtol=0.05)


def test_what_is_stated_is_believed_unless_asked(capture):
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.gain is None
    twice = replace(scan.frames, gain=np.full(24, 2.0))
    np.testing.assert_allclose(
        2 * read_frame(twice, 0).radiance, read_frame(scan.frames, 0).radiance
    )
