"""Whether poses, mesh and frames agree, and under which reading of the poses they would."""

from __future__ import annotations

import json
import math
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import camera_at, edited, make_capture, write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.conventions import CONVENTIONS
from usdbrdf.cli import main
from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.options import IngestOptions
from usdbrdf.texturing.agreement import (
    MIN_COSINE,
    Agreement,
    MeshPoints,
    agreement,
    is_doubtful,
    logarithms_in_frame,
    other_convention,
    points_of_surface,
    seen_points,
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


@pytest.mark.fault("C17")
@pytest.mark.parametrize(("by", "named"), [(1, "1 after"), (-1, "1 before"), (-2, "2 before")])
@pytest.mark.parametrize("command", ["inspect", "ingest"])
def test_poses_that_slipped_along_the_list_are_refused(
    capture, tmp_path, capsys, by, named, command
):
    """As of who sorted frames and poses by different keys, or dropped one of either."""
    with edited(capture.manifest) as document:
        # Frames that follow each other show other things.
        frames = document["frames"] = [document["frames"][7 * i % 24] for i in range(24)]
        poses = [frame["transform_matrix"] for frame in frames]
        for i, frame in enumerate(frames):
            frame["transform_matrix"] = poses[(i - by) % len(poses)]
    out = ["-o", str(tmp_path / "out")] if command == "ingest" else []
    assert main([command, str(capture.folder), *out]) == 3
    err = capsys.readouterr().err
    assert f"with the poses read as those of the frames {named} them in the list" in err
    assert err.endswith("Pair frames and poses anew. [capture.convention]\n")


@pytest.mark.parametrize(
    ("factors", "named"),
    [
        ((100, 100, 100), "metres and a mesh in centimetres (scale the mesh by 0.01)"),
        ((1 / 0.3048,) * 3, "metres and a mesh in feet (scale the mesh by 0.3048)"),
    ],
)
def test_a_mesh_of_another_unit_is_told(capture, factors, named, capsys):
    """Also where frames seem to agree: most of what they show is of one colour."""
    middle = np.array([2.0, 1.5, 1.25])
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            for row, own in zip(frame["transform_matrix"], middle, strict=False):
                row[3] -= own
    points = (capture.points - middle) * factors
    write_ply(
        capture.folder / "mesh.ply", points.astype(np.float32), capture.triangles,
        capture.face_object,
    )  # fmt: skip
    assert main(["inspect", str(capture.folder)]) == 3
    err = capsys.readouterr().err
    assert err.endswith("[capture.convention]\n")
    assert named in err
    if factors[0] == 1 / 0.3048:
        differ = float(re.search(r"\(differ by (\d+)%", err)[1]) / 100
        assert not is_doubtful(Agreement(0.1, differ, 1000, 0.0, 0.5))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_beside_a_mirrored_mesh_its_cameras_see_what_they_saw(axis):
    (mirrored,) = (
        read for name, read in CONVENTIONS.items() if f"mirrored in {'xyz'[axis]}" in name
    )
    pose = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    lens = np.array([20.0, 20, 16, 12])
    point = np.array([[1.3, 2.2, 1.0]])
    seen = camera_at(pose, lens, 32, 24).project(point)
    point[:, axis] *= -1
    camera = replace(camera_at(pose, lens, 32, 24), world_from_camera=mirrored(pose))
    np.testing.assert_allclose(camera.project(point), seen)


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


def test_of_photographs_the_pixels_that_points_lie_in_are_looked_at_alone():
    """Other readings of the poses look them up again and again, and they have millions."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    rays = RayScene(points, np.array([[0, 1, 2]], np.int32))
    places = np.array([[0.0, 0, 0], [0.1, 0.2, 0]])
    surface = MeshPoints(places, np.tile([0.0, 0, 1], (2, 1)), np.zeros(2, np.int32))
    pose, size = np.eye(4), 3000
    pose[2, 3] = 2
    camera = camera_at(pose, np.full(4, size / 2), size, size)
    image, mask = np.ones((size, size, 3), np.float32), np.zeros((size, size), bool)
    pixels = FramePixels(
        radiance=image, valid=~mask, clipped=mask, dark=mask, unknown=mask, transparent=mask,
        num_clamped=0,
    )  # fmt: skip
    logarithms_in_frame(surface, rays, camera, pixels)
    tracemalloc.start()
    try:
        shown = logarithms_in_frame(surface, rays, camera, pixels)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(shown, 0)
    assert most < size * size / 10


def test_few_samples_say_nothing():
    assert agreement(np.full((100, 4), np.nan, np.float32)) is None
    assert agreement(np.zeros((100, 4), np.float32)) is None
    good, bad = Agreement(0.05, 0.1, 5000, 0, 0.5), Agreement(0.5, 0.9, 5000, 0, 0.55)
    assert other_convention(bad, {"a": bad, "b": good, "c": None}) == "b"
    assert other_convention(bad, {"b": good._replace(samples=900)}) == ""
    assert other_convention(bad, {"a": bad._replace(ratio=0.8, scatter=0.44)}) == ""
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


def _in_three_frames(points: int, off: float) -> np.ndarray:
    """Logarithms around 1 and -1, of which two frames are off by so much, either way."""
    level = np.where(np.arange(points) % 2, 1.0, -1.0)
    return (level[:, None] + np.array([off, -off, 0])).astype(np.float32)


def test_agreement_is_how_far_frames_are_off_the_others_as_a_share_of_all_contrast():
    """Of three samples each lies nearer to their median by sqrt(2 / 3) than to the truth."""
    shown = _in_three_frames(200, 0.06)
    found = agreement(shown)
    assert found is not None
    assert found.samples == 600
    assert found.scatter == pytest.approx(0.04 * math.sqrt(1.5), rel=1e-5)
    assert found.ratio == pytest.approx(found.scatter, rel=1e-5)
    # Twice the contrast is half of the share, and one unit is as good as another.
    again = agreement(2 * shown + 7)
    assert again is not None
    assert again.scatter == pytest.approx(2 * found.scatter, rel=1e-4)
    assert again.ratio == pytest.approx(found.ratio, rel=1e-4)
    # Points that one frame alone shows say nothing.
    lonely = np.full((300, 3), np.nan, np.float32)
    lonely[:, 1] = 50
    assert agreement(np.concatenate([shown, lonely])) == found


def test_some_frames_are_judged_by_all():
    shown = _in_three_frames(600, 0.06)
    for judged, scatter in (
        ([True, False, False], 0.06), ([False, False, True], 0), ([True, False, True], 0.03),
    ):  # fmt: skip
        found = agreement(shown, np.array(judged))
        assert found is not None
        assert found.samples == 600 * sum(judged)
        assert found.scatter == pytest.approx(scatter * math.sqrt(1.5), rel=1e-5, abs=1e-7)
    assert agreement(shown[:166]) is None
    assert agreement(shown[:167]) is not None
    assert agreement(shown[:499], np.array([True, False, False])) is None


def test_another_reading_must_be_clearly_better_good_and_see_as_much():
    def of(ratio: float, samples: int = 1000) -> Agreement:
        return Agreement(0.5 * ratio, ratio, samples, 0.0, 0.5)

    given = of(0.9)
    assert is_doubtful(given)
    assert is_doubtful(None)
    assert is_doubtful(of(0.66))
    assert not is_doubtful(of(0.64))
    others = {"a": of(0.3), "b": of(0.04, 499), "c": None, "d": of(0.1, 500)}
    assert other_convention(given, others) == "d"
    assert other_convention(None, {"b": of(0.04, 249), "d": of(0.1, 250)}) == "d"
    for told, ratio, named in ((of(0.8), 0.59, "a"), (of(0.8), 0.61, ""), (None, 0.64, "a")):
        assert other_convention(told, {"a": of(ratio), "c": None}) == named
    assert other_convention(of(1.2), {"a": of(0.64)}) == "a"
    assert other_convention(of(1.2), {"a": of(0.66)}) == ""
    assert other_convention(of(0.02), others) == ""
    assert other_convention(given, {}) == ""


def test_frames_that_see_a_spot_each_do_not_agree_better_than_those_that_see_it_all():
    """A book, seen from in front and from behind, of covers that are plain in the middle: from
    a thousand times as far each frame shows one colour, and these agree within 2 %."""
    rng = np.random.default_rng(0)
    side = np.where(np.arange(16) % 2, 1.0, -1.0)
    shown = np.where(np.arange(600)[:, None] % 2 == np.arange(16) % 2, side, np.nan)
    printed = rng.normal(0, 0.6, (600, 1))
    near = shown + printed + rng.normal(0, 0.2, shown.shape)
    spot = shown + rng.normal(0, 0.02, 16)
    given, other = agreement(near.astype(np.float32)), agreement(spot.astype(np.float32))
    assert given.inside < 0.5
    assert other.ratio < 0.5 * given.ratio
    assert other.inside > 0.9
    assert other_convention(given, {"millimetres": other}) == ""
    # As much detail in the frames, and it is the better one.
    fine = (shown + printed + rng.normal(0, 0.02, shown.shape)).astype(np.float32)
    assert other_convention(given, {"turned": agreement(fine)}) == "turned"


def test_readings_that_differ_by_chance_are_no_better():
    """A cube turned by a quarter looks as it did: other points of it are asked, of which some few
    lie on an edge."""
    side = np.where(np.arange(1000) % 2, 1.0, -1.0)

    def on_edge(points: int) -> Agreement:
        shown = np.tile(side[:, None], 4).astype(np.float32)
        shown[:points, 0] *= -1
        found = agreement(shown)
        assert found is not None
        # Of each point on an edge one of four samples is off by 2, of a spread of 1.
        assert found.ratio == pytest.approx(points * 2 * math.sqrt(4 / 3) / 4000, rel=1e-3)
        assert found.error == pytest.approx(found.ratio * math.sqrt(1 / points - 1e-3), rel=1e-3)
        return found

    few = on_edge(12)._replace(ratio=0.12, scatter=0.12, error=0.12 / math.sqrt(12))
    fewer = on_edge(6)._replace(ratio=0.06, scatter=0.06, error=0.06 / math.sqrt(6))
    assert other_convention(few, {"turned": fewer}) == ""
    assert other_convention(on_edge(300), {"turned": on_edge(150)}) == "turned"
    # The chance is small enough, but so is what frames differ by.
    assert other_convention(on_edge(170), {"turned": on_edge(20)}) == ""


def test_points_are_even_over_a_mesh_by_area():
    """Of two triangles of 1 1/2 and 1/2 m^2, the smaller one turned to the side."""
    points = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]], np.float32)
    mesh = ScanMesh(
        points=points, triangles=np.array([[0, 1, 2], [0, 4, 3]], np.int32),
        corner_normals=np.zeros((2, 3, 3), np.float32), face_object=np.array([4, 2], np.int32),
    )  # fmt: skip
    found = points_of_surface(mesh, 4000)
    large = found.owner == 4
    assert set(found.owner.tolist()) == {2, 4}
    assert abs(large.sum() - 3000) < 4 * math.sqrt(4000 * 3 / 16)
    np.testing.assert_allclose(found.normal[large], np.tile([0.0, 0, 1], (large.sum(), 1)))
    np.testing.assert_allclose(np.abs(found.normal[~large, 0]), 1)
    x, y, z = found.point[large].T
    assert ((x >= 0) & (y >= 0) & (x / 3 + y <= 1 + 1e-9) & (z == 0)).all()
    # The mean is the middle, and each of three corners has a ninth of the points beside it.
    middle, error = np.array([x.mean() / 3, y.mean()]), 4 * math.sqrt(1 / 18 / 3000)
    np.testing.assert_allclose(middle, 1 / 3, atol=error)
    for part in (x / 3 > 2 / 3, y > 2 / 3, x / 3 + y < 1 / 3):
        assert part.mean() == pytest.approx(1 / 9, abs=4 * math.sqrt(8 / 81 / 3000))
    again = points_of_surface(mesh, 4000)
    np.testing.assert_array_equal(again.point, found.point)


def test_a_camera_sees_what_faces_it_within_its_picture_and_is_not_hidden():
    """From 2 above a floor; a board of half its width 0.6 above it."""
    points = np.array(
        [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0], [0, -9, 0.6], [9, -9, 0.6], [9, 9, 0.6],
         [0, 9, 0.6]], np.float32,
    )  # fmt: skip
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    rays = RayScene(points, triangles)
    pose = np.eye(4)
    pose[2, 3] = 2
    camera = camera_at(pose, np.array([20.0, 20, 16, 12]), 32, 24)
    # A pixel is 0.1 wide on the floor: x from -1.6, y from 1.2 downwards.
    place = [
        (-0.55, 0.25, 0), (-1.45, 0, 0), (-1.55, 0, 0), (-0.5, 1.05, 0), (-0.5, 1.15, 0),
        (-0.5, -1.05, 0), (-0.5, -1.15, 0), (0.5, 0.05, 0), (0.5, 0.05, 0.6), (0.5, 0.05, 0.594),
        (0.5, 0.05, 0.585), (0, 0, 3),
    ]  # fmt: skip
    normal = np.tile([0.0, 0, 1], (len(place), 1))
    surface = MeshPoints(np.array(place, np.float64), normal, np.zeros(len(place), np.int32))
    seen, column, row = seen_points(surface, rays, camera)
    # What lies behind the board by less than a half per cent of the way passes for the board.
    assert np.flatnonzero(seen).tolist() == [0, 1, 3, 5, 8, 9]
    assert (column[0], row[0]) == (10, 9)
    assert (column[1], row[2], row[3]) == (1, 1, 22)
    assert not seen_points(surface._replace(normal=-normal), rays, camera)[0].any()
    for cosine, visible in ((MIN_COSINE * 1.02, True), (MIN_COSINE * 0.98, False)):
        way = np.array([0.0, 0, 2]) - surface.point[0]
        way /= np.linalg.norm(way)
        across = np.cross(way, [1.0, 0, 0])
        across /= np.linalg.norm(across)
        leaning = cosine * way + math.sqrt(1 - cosine**2) * across
        tilted = surface._replace(normal=np.tile(leaning, (len(place), 1)))
        assert seen_points(tilted, rays, camera)[0][0] == visible


def test_frames_that_show_a_spot_each_agree_about_nothing():
    """As of a plain room from so far that all of its mesh lies in a pixel of each frame."""
    given = Agreement(0.1, 0.2, 5000, 0.0, 0.5)
    near, spot = (Agreement(0.0, 0.0, 5000, 0.0, variety) for variety in (0.4, 1e-7))
    assert other_convention(given, {"near": near}) == "near"
    assert other_convention(given, {"spot": spot}) == ""
    assert other_convention(None, {"near": near}) == "near"


def test_variety_is_within_frames_alone():
    rng = np.random.default_rng(3)
    point = rng.normal(size=(800, 1))
    each = np.tile(np.arange(4.0), (800, 1))
    varied, plain = agreement(point + 0.01 * each), agreement(each)
    assert varied.variety == pytest.approx(np.abs(point - np.median(point)).mean(), rel=1e-6)
    assert plain.variety == pytest.approx(0, abs=1e-9)
