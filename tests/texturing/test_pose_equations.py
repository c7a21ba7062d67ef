"""The parts of ``pose_steps``, each against numbers that are reckoned by hand: what frames say of
each other, the step that follows, and which poses are taken."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.scenes import camera_at
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.texturing import pose_steps
from usdbrdf.texturing.agreement import MeshPoints
from usdbrdf.texturing.pose_samples import LookedUp, _is_surface
from usdbrdf.texturing.pose_steps import (
    _moved,
    _patch,
    _points_of_frames,
    _Predicted,
    _predicted,
    _robust,
    _step_between,
    _stepped,
    _usual_distance,
    _where_better,
    refined_poses,
)
from usdbrdf.transport.rays import RayScene

# ``calibration.json``: the usual step, samples that count as independent, a patch's gain, the
# deviations from which a sample counts little; and the least scatter that is believed.
USUAL, INDEPENDENT, GAIN, OUTLYING, LEAST = math.radians(0.5), 0.01, 0.1, 2.0, 1e-4


def _looked(point: Any, value: Any, patch: Any = None, slope: Any = None) -> LookedUp:
    point = np.asarray(point, np.int32)
    slope = np.zeros((len(point), 6)) if slope is None else slope
    patch = np.zeros(len(point)) if patch is None else patch
    return LookedUp(
        point, np.asarray(value, np.float32), np.asarray(slope, np.float32),
        np.asarray(patch, np.int32),
    )  # fmt: skip


POINTS = np.arange(16)
LEVEL = np.linspace(-1.0, 2.0, 16).astype(np.float32)
SIGN = np.where(POINTS % 2, -1.0, 1.0)


def test_what_frames_agree_about_but_for_gains_of_patches_is_off_by_nothing():
    patch = POINTS // 8
    gains = ((0.05, -0.02), (-0.01, 0.03), (-0.04, -0.01))
    shown = [_looked(POINTS, LEVEL + np.array(gain)[patch], patch) for gain in gains]
    said = _predicted(shown, 20, OUTLYING)
    assert said.first.tolist() == [0, 16, 32, 48]
    np.testing.assert_allclose(said.off, 0, atol=2e-6)
    np.testing.assert_allclose(said.scatter, LEAST)
    np.testing.assert_allclose(said.weight, LEAST**-2, rtol=1e-3)
    # What a patch's gain left is the radiance, but for what all gains have in common.
    own = said.expected.reshape(3, 2, 8) - LEVEL.reshape(2, 8)
    np.testing.assert_allclose(own, np.broadcast_to(own[:1, :, :1], own.shape), atol=2e-6)
    assert np.abs(own).max() < 0.01


def test_a_frame_is_held_against_the_others_alone():
    """Two frames that are off by 0.01 from their mean are off by 0.02 from each other."""
    said = _predicted(
        [_looked(POINTS, LEVEL + 0.01 * SIGN), _looked(POINTS, LEVEL - 0.01 * SIGN)], 16, OUTLYING
    )
    np.testing.assert_allclose(said.off, np.concatenate([0.02 * SIGN, -0.02 * SIGN]), atol=1e-6)
    np.testing.assert_allclose(said.expected[:16], LEVEL - 0.01 * SIGN, atol=1e-6)
    np.testing.assert_allclose(said.scatter, 1.4826 * 0.01, rtol=1e-4)
    told = (1 + (1 / 1.4826 / OUTLYING) ** 2) ** -2 / (1.4826 * 0.01) ** 2
    np.testing.assert_allclose(said.weight, told, rtol=1e-4)
    # A lighter hand with what is far off makes it heavier.
    calm = _predicted(
        [_looked(POINTS, LEVEL + 0.01 * SIGN), _looked(POINTS, LEVEL - 0.01 * SIGN)], 16, 1.0
    )
    told = (1 + (1 / 1.4826) ** 2) ** -2 / (1.4826 * 0.01) ** 2
    np.testing.assert_allclose(calm.weight, told, rtol=1e-4)


def test_a_highlight_is_off_by_all_that_it_is_and_moves_nothing():
    bright = LEVEL.copy()
    bright[5] += 1
    said = _predicted([_looked(POINTS, v) for v in (LEVEL, bright, LEVEL)], 16, OUTLYING)
    wanted = np.zeros(48)
    wanted[16 + 5] = 1
    np.testing.assert_allclose(said.off, wanted, atol=1e-4)
    assert said.weight[16 + 5] < 1e-6 * said.weight[16 + 4]


def test_points_of_one_frame_alone_and_of_one_that_outweighs_the_others_tell_nothing():
    """The third frame lies between the others, which are 0.01 off, and so is all that is known:
    they are held against it, and it against nobody."""
    shown = [
        _looked([*POINTS, 16], [*(LEVEL + 0.01 * SIGN), 9.0]),
        _looked(POINTS, LEVEL - 0.01 * SIGN),
        _looked(POINTS, LEVEL),
        _looked([18, 19], [1.0, 2.0]),
        _looked([], []),
    ]
    said = _predicted(shown, 20, OUTLYING)
    assert said.first.tolist() == [0, 17, 33, 49, 51, 51]
    np.testing.assert_allclose(said.off[:16], 0.01 * SIGN, atol=1e-5)
    np.testing.assert_allclose(said.off[17:33], -0.01 * SIGN, atol=1e-5)
    assert (said.weight[:16] > 0).all()
    assert said.weight[16] == 0
    np.testing.assert_array_equal(said.weight[33:], 0)
    np.testing.assert_allclose(said.scatter[2:], [LEAST, 1, 1])


def test_weights_fall_to_a_quarter_where_a_sample_is_outlying():
    np.testing.assert_allclose(_robust(np.array([0, 2.0, -2.0, 6.0]), 2.0), [1, 0.25, 0.25, 0.01])


POSE = np.eye(4)
POSE[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the camera's x is the world's y
POSE[:3, 3] = (1, 2, 3)


def test_a_step_turns_and_moves_in_the_camera_s_own_axes():
    moved = _moved(POSE, np.array([0, 0, 0, 0.1, 0, 0.2]), 2.0)
    np.testing.assert_allclose(moved[:3, 3], [1, 2.2, 3.4])
    np.testing.assert_allclose(moved[:3, :3], POSE[:3, :3])
    turned = _moved(POSE, np.array([0.3, 0, 0, 0, 0, 0]), 2.0)
    np.testing.assert_allclose(turned[:3, 3], POSE[:3, 3])
    # About its own x, which is the world's y.
    about_y = Rotation.from_rotvec([0, 0.3, 0]).as_matrix() @ POSE[:3, :3]
    np.testing.assert_allclose(turned[:3, :3], about_y, atol=1e-12)
    step = np.array([0.02, -0.03, 0.01, 0.05, 0.07, -0.04])
    np.testing.assert_allclose(_step_between(POSE, _moved(POSE, step, 2.5), 2.5), step, atol=1e-12)


def _said(weight: Any, off: Any) -> _Predicted:
    """Of a second frame, after a first one with three samples that say something else."""
    weight, off = (np.concatenate([[7.0, 8, 9], one]) for one in (weight, off))
    return _Predicted(np.array([0, 3, len(off)]), 0 * off, off, weight, np.ones(2))


def test_clear_samples_take_a_camera_where_they_agree():
    rng = np.random.default_rng(2)
    slope, patch = rng.normal(size=(200, 6)), POINTS[np.arange(200) % 4]
    wrong, reach = np.array([0.01, -0.02, 0.015, 0.02, 0.01, -0.03]), 2.0
    # Gains of patches are free, whatever they are.
    off = slope @ (wrong * [1, 1, 1, reach, reach, reach]) + np.array([0.3, -0.2, 0.1, 5])[patch]
    looked = _looked(np.arange(200), off, patch, slope)
    found = _stepped(POSE, POSE, looked, _said(np.full(200, 1e12), off), 1, reach)
    np.testing.assert_allclose(_step_between(POSE, found, reach), -wrong, atol=1e-6)


@pytest.mark.parametrize("reach", [1.0, 2.0])
def test_samples_are_weighed_against_how_far_poses_are_usually_off(reach: float):
    """Of 16 with slope 1 and -1 by moving to the right, by moves of ``reach``."""
    slope = np.zeros((16, 6))
    slope[:, 3] = SIGN
    looked = _looked(POINTS, 0 * SIGN, None, slope)
    enough = 1 / (USUAL**2 * INDEPENDENT * 16 * reach**2)
    off = 0.006 * reach * SIGN
    for weight, share in ((enough, 1 / 2), (3 * enough, 3 / 4), (0.0, 0.0)):
        found = _stepped(POSE, POSE, looked, _said(np.full(16, weight), off), 1, reach)
        step = _step_between(POSE, found, reach)
        np.testing.assert_allclose(step, [0, 0, 0, -0.006 * share, 0, 0], atol=1e-12)
    # What nothing speaks for goes back to where it was captured.
    away = _moved(POSE, np.array([0, 0, 0, 0.01, -0.02, 0.03]), reach)
    back = _stepped(POSE, away, looked, _said(np.zeros(16), off), 1, reach)
    np.testing.assert_allclose(back, POSE, atol=1e-12)


def test_a_patch_whose_gain_is_as_little_known_as_it_varies_counts_half():
    slope = np.zeros((16, 6))
    slope[:, 3] = 1
    looked = _looked(POINTS, np.ones(16), None, slope)
    total = INDEPENDENT / GAIN**2
    said = _said(np.full(16, total / INDEPENDENT / 16), np.ones(16))
    step = _step_between(POSE, _stepped(POSE, POSE, looked, said, 1, 2.0), 2.0)
    # Half of each column is left: of the slope, which a reach of 2 doubles, and of what is off.
    wanted = -total * (0.5 * 2) * 0.5 / (total * (0.5 * 2) ** 2 + USUAL**-2)
    np.testing.assert_allclose(step, [0, 0, 0, wanted, 0, 0], rtol=1e-9, atol=1e-15)


def _cameras(count: int) -> list[Any]:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(count)
    return [camera_at(pose, np.array([50.0, 50, 30, 20]), 60, 40) for pose in poses]


def test_poses_are_taken_where_frames_agree_clearly_better_then(monkeypatch: pytest.MonkeyPatch):
    """Afterwards all agree; as captured three were off by a half, in costs, and one was not, and of
    the last one nothing is seen that others show."""
    cameras = _cameras(5)
    captured = np.array([camera.world_from_camera for camera in cameras])
    degrees = (1.9, -2.1, 0.5, 0.5, 0.5)
    steps = [np.array([math.radians(one), 0, 0, 0, 0, 0]) for one in degrees]
    refined = np.array([_moved(pose, s, 2.0) for pose, s in zip(captured, steps, strict=True)])
    after = [*[_looked(POINTS, LEVEL)] * 4, _looked(POINTS + 16, LEVEL)]
    # Outlying by just so much: 1 - 1 / (1 + 1); gains of patches do not count.
    off = OUTLYING * LEAST * SIGN
    before = [*[_looked(POINTS, LEVEL + off + 3)] * 3, _looked(POINTS, LEVEL), after[4]]
    monkeypatch.setattr(pose_steps, "_shown", lambda *_: after)

    def look_up(surface: Any, rays: Any, camera: Any, picture: Any, patch: int) -> LookedUp:
        assert patch == 4
        (i,) = np.flatnonzero((captured == camera.world_from_camera).all(axis=(1, 2)))
        assert picture is pictures[i]
        return before[i]

    monkeypatch.setattr(pose_steps, "look_up", look_up)
    pictures = [np.zeros((40, 60), np.float32) for _ in cameras]
    surface = MeshPoints(np.zeros((32, 3)), np.zeros((32, 3)), np.zeros(32, np.int32))
    rays: Any = None
    found = _where_better(surface, rays, cameras, captured, refined, pictures, 2.0)
    wanted = [refined[0], captured[1], refined[2], captured[3], captured[4]]
    np.testing.assert_array_equal(found.world_from_camera, wanted)
    np.testing.assert_allclose(found.before, [0.5, 0.5, 0.5, 0, 0], atol=2e-3)
    np.testing.assert_allclose(found.after, [0, 0.5, 0, 0, 0], atol=2e-3)


def test_a_pose_that_is_better_by_less_than_a_twentieth_is_not_taken(
    monkeypatch: pytest.MonkeyPatch,
):
    """Costs of 1 - 1 / (1 + (off / outlying)^2) of what is off, in the frames' scatter."""
    cameras = _cameras(2)
    captured = np.array([camera.world_from_camera for camera in cameras])
    refined = captured.copy()
    refined[:, 1, 3] = 0.001
    after = [_looked(POINTS, LEVEL + 0.01 * SIGN), _looked(POINTS, LEVEL - 0.01 * SIGN)]
    monkeypatch.setattr(pose_steps, "_shown", lambda *_: after)

    def cost(off: float) -> float:
        return 1 - 1 / (1 + (off / (1.4826 * 0.01) / OUTLYING) ** 2)

    surface = MeshPoints(np.zeros((16, 3)), np.zeros((16, 3)), np.zeros(16, np.int32))
    rays: Any = None
    for off, better in ((0.0204, False), (0.0215, True)):
        assert (cost(0.02) < 0.95 * cost(off)) == better
        before = [_looked(POINTS, LEVEL + (off - 0.01) * SIGN), after[1]]
        monkeypatch.setattr(
            pose_steps, "look_up",
            lambda _, __, camera, *___, seen=before: seen[int(camera.eye[0] > 0.05)],
        )  # fmt: skip
        pictures = [np.zeros((40, 60), np.float32) for _ in cameras]
        found = _where_better(surface, rays, cameras, captured, refined, pictures, 1.0)
        assert np.array_equal(found.world_from_camera[0], (captured, refined)[better][0])
        assert np.array_equal(found.world_from_camera[1], captured[1])
        assert found.before[0] == pytest.approx(cost(off), rel=1e-4)
        assert found.after[0] == pytest.approx(cost(0.02 if better else off), rel=1e-4)


def test_the_usual_distance_is_the_median_over_frames_of_theirs():
    surface = MeshPoints(
        np.array([[3.0, 0, 0], [0, 4, 0], [0, 0, 12]]), np.zeros((3, 3)), np.zeros(3, np.int32)
    )
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = (20, 0, 10)
    cameras = [camera_at(pose, np.array([50.0, 50, 30, 20]), 60, 40) for pose in poses]
    # From 20 above 20.2, 20.4, 8; from the origin 3, 4, 12; from 10 above the root of 109, 10.8, 2.
    assert _usual_distance(surface, cameras) == pytest.approx(math.sqrt(109))


def test_pictures_grow_and_weights_become_stricter_as_poses_settle(monkeypatch: pytest.MonkeyPatch):
    """Of 300 and 256 pixels three sizes: what is 64 wide then first, the whole last."""
    cameras = [*_cameras(1), camera_at(POSE, np.array([50.0, 50, 30, 20]), 60, 40)]
    surface = MeshPoints(np.zeros((7, 3)), np.zeros((7, 3)), np.zeros(7, np.int32))
    asked: list[Any] = []
    monkeypatch.setattr(pose_steps, "_points_of_frames", lambda *_: surface)
    monkeypatch.setattr(pose_steps, "_usual_distance", lambda *_: 2.5)

    def shown(_: Any, __: Any, of: Any, poses: Any, pictures: Any) -> list[str]:
        asked.append((poses[:, 0, 3].tolist(), [one.shape[1] for one in pictures]))
        assert of is cameras
        return ["first", "second"]

    def predicted(looked: Any, count: int, outlying: float) -> str:
        asked[-1] += (outlying,)
        assert (looked, count) == (["first", "second"], 7)
        return "said"

    def stepped(captured: Any, pose: Any, looked: Any, said: Any, i: int, reach: float) -> Any:
        assert (looked, said, reach) == (("first", "second")[i], "said", 2.5)
        np.testing.assert_array_equal(captured, cameras[i].world_from_camera)
        return _moved(pose, np.array([0, 0, 0, 1.0, 0, 0]), 1 + i)

    for name, stub in (("_shown", shown), ("_predicted", predicted), ("_stepped", stepped)):
        monkeypatch.setattr(pose_steps, name, stub)
    monkeypatch.setattr(pose_steps, "_where_better", lambda *given: given)
    pictures = [np.zeros((8, width), np.float32) for width in (300, 256)]
    mesh: Any = None
    *_, captured, refined, whole, reach = refined_poses(mesh, mesh, cameras, pictures)
    assert [widths for _, widths, _ in asked] == [[75, 64]] * 6 + [[150, 128]] * 5 + [
        [300, 256]
    ] * 8
    assert [outlying for *_, outlying in asked] == [4.0] * 6 + [3.0] * 5 + [2.0] * 8
    # Each step starts where the last one ended; the second camera's x is the world's y.
    assert [place[0] for place, *_ in asked] == list(range(19))
    np.testing.assert_allclose(refined[:, :3, 3], [[19, 0, 0], [1, 2 + 2 * 19, 3]])
    np.testing.assert_array_equal(captured, [camera.world_from_camera for camera in cameras])
    assert whole is pictures
    assert reach == 2.5
    # Small ones are what they are.
    asked.clear()
    refined_poses(mesh, mesh, cameras, [picture[:, :127] for picture in pictures])
    assert asked[0][1:] == ([127, 127], 2.0)
    assert len(asked) == 8


def test_patches_are_a_fortieth_of_a_picture_and_four_pixels_at_least():
    sizes = [_patch(np.zeros((5, width), np.float32)) for width in (60, 160, 199, 200, 400)]
    assert sizes == [4, 4, 4, 5, 10]


def test_points_are_what_some_pixels_show_and_their_normals_face_who_sees_them(
    monkeypatch: pytest.MonkeyPatch,
):
    """Of two squares before nothing: the lower one faces up, the upper one away."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    points = np.concatenate([square, 0.3 * square + np.float32([0, 0, 1])]) - np.float32([0, 0, 9])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], np.int32)
    mesh = ScanMesh(
        points=points, triangles=triangles, corner_normals=np.zeros((4, 3, 3), np.float32),
        face_object=np.array([3, 3, 5, 5], np.int32),
    )  # fmt: skip
    rays = RayScene(points, triangles)
    pose = np.eye(4)
    pose[2, 3] = 4 - 9
    camera = camera_at(pose, np.array([40.0, 40, 20, 15]), 40, 30)
    found = _points_of_frames(mesh, rays, [camera, camera])
    origins, towards = camera.rays(camera.pixels())
    hit = rays.closest(origins, towards).face
    assert 0 < (hit >= 0).sum() < 1200
    assert len(found.point) == 2 * (hit >= 0).sum()
    np.testing.assert_allclose(found.normal, np.tile([0.0, 0, 1], (len(found.point), 1)))
    upper = found.point[:, 2] > -8.5
    assert upper.sum() == 2 * (hit >= 2).sum()
    np.testing.assert_array_equal(found.owner, np.where(upper, 5, 3))
    np.testing.assert_allclose(found.point[:, 2], np.where(upper, -8, -9), atol=1e-5)
    # So many of all frames, shared out.
    monkeypatch.setattr(pose_steps, "_POINTS", 151)
    wide = camera_at(pose, np.array([400.0, 400, 20, 15]), 40, 30)  # sees nothing else
    some = _points_of_frames(mesh, rays, [wide, wide]).point
    assert len(some) == 2 * 76
    assert len(np.unique(some[:76], axis=0)) == 76
    monkeypatch.setattr(pose_steps, "_MOST_SAMPLES", 200)
    assert len(_points_of_frames(mesh, rays, [wide, wide]).point) == 2 * 50


def test_a_value_s_sixteen_pixels_show_its_surface():
    """In pixels: those from one before its own to two behind, each way, and no others."""
    row, column = np.mgrid[:8, :8].astype(np.float32)
    flat = np.stack([column, row, 0 * row], axis=-1)
    face, at = np.zeros((8, 8), np.int32), np.array([3.5, 4.5, 0.0])
    towards = np.array([0.0, 0.6, 0.8])
    # Along the plane any pixel may lie; off it, those of the farthest row, at 6, are 0.9 away.
    assert _is_surface(3, 4, at, np.array([0.0, 0.0, 1.0]), 1e-9, face, flat)
    assert _is_surface(3, 4, at, towards, 0.901, face, flat)
    assert not _is_surface(3, 4, at, towards, 0.899, face, flat)
    ahead = np.array([0.0, 0.0, -1.0])
    used = [(j, i) for j in range(3, 7) for i in range(2, 6)]
    for j in range(8):
        for i in range(8):
            hole, step = face.copy(), flat.copy()
            hole[j, i], step[j, i, 2] = -1, 3
            assert _is_surface(3, 4, at, ahead, 2.5, hole, flat) == ((j, i) not in used)
            assert _is_surface(3, 4, at, ahead, 2.5, face, step) == ((j, i) not in used)
            step[j, i, 2] = 2.4
            assert _is_surface(3, 4, at, ahead, 2.5, face, step)
