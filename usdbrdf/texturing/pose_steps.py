"""Small steps of the cameras, after which the frames agree better about the surface.

Each frame is held against what the other frames show at the same points of the mesh: the logarithm
of the radiance, but for a gain of each small patch of the picture, for which shading that changes
with the view does not count. Gauss-Newton on the six degrees of freedom of each camera, from
pictures of few pixels to those of many; weights take what no step explains, such as highlights, out
(S. Geman and D. McClure, "Statistical methods for tomographic image reconstruction", 1987). What
the pixels do not tell stays as captured: steps are drawn to 0 by how far poses are usually off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Double, Float, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh, across_triangles
from usdbrdf.texturing.agreement import MeshPoints
from usdbrdf.texturing.pose_samples import LookedUp, halved, look_up
from usdbrdf.transport.rays import RayScene

_USUAL = math.radians(calibration.number("pose_steps.usual"))
_FARTHEST = calibration.number("pose_steps.farthest")
_INDEPENDENT = calibration.number("pose_steps.independent")
_OUTLYING = calibration.number("pose_steps.outlying")
_GAIN = calibration.number("pose_steps.gain")
_PATCHES = calibration.count("pose_steps.patches")
_BETTER = calibration.number("pose_steps.better")
# Points of the mesh, and points times frames, at most; pixels of a picture's width at the start.
_POINTS, _MOST_SAMPLES, _COARSEST = 1 << 16, 1 << 25, 64
# Pixels to a side of a patch, at least.
_SMALLEST = 4
_SEED = 0
# Steps in the smallest pictures, in larger ones, and in the largest; and reweightings in each.
_STEPS, _ROUNDS = (6, 5, 8), 4
_LEAST = 1e-4


class PoseSteps(NamedTuple):
    """Of N frames: refined poses (N, 4, 4), and how far each differs from what the others show, in
    its own scatter, as captured and as refined, (N,); equal where it keeps its pose."""

    world_from_camera: Double
    before: Double
    after: Double


def refined_poses(
    mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera], pictures: Sequence[Float]
) -> PoseSteps:
    """The poses of cameras after small steps; a frame that would not agree clearly better keeps its
    own. The mesh holds all of them together: what moves along one face is parallax on another.

    pictures  the frames' ``logarithms``, in any size
    """
    surface = _points_of_frames(mesh, rays, cameras)
    captured = np.array([camera.world_from_camera for camera in cameras])
    poses = captured
    # Turned by an angle, or moved by as much of this length, a camera's picture moves alike.
    reach = _usual_distance(surface, cameras)
    smaller = [list(pictures)]
    while min(picture.shape[1] for picture in smaller[0]) >= 2 * _COARSEST:
        smaller.insert(0, [halved(picture) for picture in smaller[0]])
    sizes = len(smaller)
    steps = [_STEPS[0], *[_STEPS[1]] * (sizes - 2), _STEPS[2]][-sizes:]
    rounds = [k for k, count in enumerate(steps) for _ in range(count)]
    for k in progress(rounds, total=len(rounds), label="poses", unit="steps"):
        shown = _shown(surface, rays, cameras, poses, smaller[k])
        said = _predicted(shown, len(surface.point), _OUTLYING * (sizes - k + 1) / 2)
        poses = np.array([
            _stepped(captured[i], pose, looked, said, i, reach)
            for i, (pose, looked) in enumerate(zip(poses, shown, strict=True))
        ])  # fmt: skip
    return _where_better(surface, rays, cameras, captured, poses, pictures, reach)


def _points_of_frames(mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera]) -> MeshPoints:
    """What some pixels of all frames show, the same for equal cameras."""
    rng = np.random.default_rng(_SEED)
    count = -(-min(_POINTS, _MOST_SAMPLES // len(cameras)) // len(cameras))
    across = across_triangles(mesh.points, mesh.triangles)
    points, normals, owners = [], [], []
    for camera in cameras:
        face, point = visible_faces(rays, camera.at_width(min(camera.width, 8 * _COARSEST)))
        chosen = rng.choice(face.size, min(count, face.size), replace=False)
        chosen = chosen[face.ravel()[chosen] >= 0]
        point, face = point.reshape(-1, 3)[chosen].astype(np.float64), face.ravel()[chosen]
        normal = across[face]
        behind = (normal * (camera.eye - point)).sum(axis=1) < 0
        normal = np.where(behind[:, None], -normal, normal)
        points.append(point)
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
        owners.append(mesh.face_object[face])
    return MeshPoints(np.concatenate(points), np.concatenate(normals), np.concatenate(owners))


def _usual_distance(surface: MeshPoints, cameras: Sequence[Camera]) -> float:
    return float(
        np.median([np.median(np.linalg.norm(surface.point - c.eye, axis=1)) for c in cameras])
    )


def _shown(
    surface: MeshPoints, rays: RayScene, cameras: Sequence[Camera], poses: Double,
    pictures: Sequence[Float],
) -> list[LookedUp]:  # fmt: skip
    return [
        look_up(surface, rays, replace(camera, world_from_camera=pose), picture, _patch(picture))
        for camera, pose, picture in zip(cameras, poses, pictures, strict=True)
    ]


def _patch(picture: Float) -> int:
    """Pixels to a side."""
    width: int = picture.shape[1]
    return max(_SMALLEST, width // _PATCHES)


class _Predicted(NamedTuple):
    """Of all frames' samples, one frame after the other: where the frames begin, first (N + 1,);
    what the other frames show of its point (S,); difference from that after the patches' gains
    (S,); weight (S,), 0 where no other frame shows the point; and scatter of each frame (N,)."""

    first: Long
    expected: Double
    off: Double
    weight: Double
    scatter: Double


def _predicted(shown: Sequence[LookedUp], num_points: int, outlying: float) -> _Predicted:
    """A radiance of each point and a gain of each patch, fitted in turn."""
    point = np.concatenate([looked.point for looked in shown])
    value = np.concatenate([looked.value for looked in shown]).astype(np.float64)
    first = np.cumsum([0, *[len(looked.point) for looked in shown]])
    frame = np.repeat(np.arange(len(shown)), np.diff(first))
    patches = np.cumsum([0, *[looked.patch.max(initial=-1) + 1 for looked in shown]])
    patch = np.concatenate([looked.patch for looked in shown]) + patches[frame]
    known = np.bincount(point, minlength=num_points)[point] > 1
    gain, scatter = np.zeros(patches[-1]), np.ones(len(shown))
    weight = known.astype(np.float64)
    for _ in range(_ROUNDS):
        for _ in range(2):
            total = np.maximum(np.bincount(point, weight, num_points), _LEAST)
            radiance = np.bincount(point, weight * (value - gain[patch]), num_points) / total
            off = value - radiance[point]
            steady = np.bincount(patch, weight, len(gain)) + 1 / _GAIN**2
            gain = np.bincount(patch, weight * off, len(gain)) / steady
        off -= gain[patch]
        for i in range(len(shown)):
            own = slice(first[i], first[i + 1])
            some = np.abs(off[own][known[own]])
            scatter[i] = max(1.4826 * float(np.median(some)), _LEAST) if len(some) else 1.0
        weight = known * _robust(off / scatter[frame], outlying) / scatter[frame] ** 2
    total = np.maximum(np.bincount(point, weight, num_points), _LEAST)
    radiance = np.bincount(point, weight * (value - gain[patch]), num_points) / total
    # Without the sample itself.
    alone = total[point] - weight <= 0.01 * total[point]
    level = value - gain[patch]
    others = np.maximum(total[point] - weight, 0.01 * total[point])
    expected = (total[point] * radiance[point] - weight * level) / others
    weight[alone] = 0
    return _Predicted(first, expected, level - expected, weight, scatter)


def _robust(off: Double, outlying: float) -> Double:
    return np.asarray(1 / (1 + (off / outlying) ** 2) ** 2)


def _stepped(
    captured: Double, pose: Double, looked: LookedUp, said: _Predicted, i: int, reach: float
) -> Double:
    """A frame's pose after one step of Gauss and Newton."""
    own = slice(said.first[i], said.first[i + 1])
    weight = _INDEPENDENT * said.weight[own]
    slope = looked.slope.astype(np.float64) * [1, 1, 1, reach, reach, reach]
    # The patches' gains are free.
    columns = np.column_stack([slope, said.off[own]])
    sums = [np.bincount(looked.patch, weight * column) for column in columns.T]
    tie = _INDEPENDENT / _GAIN**2
    means = np.stack(sums, axis=1) / (np.bincount(looked.patch, weight) + tie)[:, None]
    columns -= means[looked.patch]
    slope, off = columns[:, :6], columns[:, 6]
    normal = (slope * weight[:, None]).T @ slope + np.eye(6) / _USUAL**2
    said_by = -slope.T @ (weight * off) - _step_between(captured, pose, reach) / _USUAL**2
    step = np.asarray(np.linalg.solve(normal, said_by), np.float64)
    return _moved(pose, step, reach)


def _moved(pose: Double, step: Double, reach: float) -> Double:
    """A pose turned and moved in the camera's own axes."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    change[:3, 3] = reach * step[3:]
    return np.asarray(pose @ change)


def _step_between(before: Double, after: Double, reach: float) -> Double:
    """(6,) the step from one pose to another, such as ``_moved`` takes it."""
    change = np.linalg.inv(before) @ after
    turned = Rotation.from_matrix(change[:3, :3]).as_rotvec()
    return np.concatenate([turned, change[:3, 3] / reach])


def _where_better(
    surface: MeshPoints, rays: RayScene, cameras: Sequence[Camera], captured: Double,
    refined: Double, pictures: Sequence[Float], reach: float,
) -> PoseSteps:  # fmt: skip
    """The refined poses of the frames that agree clearly better with the others then, and were not
    moved too far."""
    after = _shown(surface, rays, cameras, refined, pictures)
    said = _predicted(after, len(surface.point), _OUTLYING)
    poses, costs = refined.copy(), np.zeros((2, len(cameras)))
    for i, (looked, camera) in enumerate(zip(after, cameras, strict=True)):
        given = replace(camera, world_from_camera=captured[i])
        before = look_up(surface, rays, given, pictures[i], _patch(pictures[i]))
        own = slice(said.first[i], said.first[i + 1])
        _, a, b = np.intersect1d(before.point, looked.point, return_indices=True)
        usable = said.weight[own][b] > 0
        if not usable.any():
            poses[i] = captured[i]
            continue
        a, b = a[usable], b[usable]
        expected = said.expected[own][b]
        for k, (seen, rows) in enumerate(((before, a), (looked, b))):
            off = seen.value[rows] - expected
            count = np.maximum(np.bincount(seen.patch[rows]), 1)
            off = off - (np.bincount(seen.patch[rows], off) / count)[seen.patch[rows]]
            costs[k, i] = np.mean(1 - np.sqrt(_robust(off / said.scatter[i], _OUTLYING)))
        far = np.abs(_step_between(captured[i], refined[i], reach)).max() > _FARTHEST * _USUAL
        if far or not costs[1, i] < _BETTER * costs[0, i]:
            poses[i], costs[1, i] = captured[i], costs[0, i]
    return PoseSteps(poses, *costs)
