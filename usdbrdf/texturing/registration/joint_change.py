"""The change of all frames alike under which they agree best about the same points of a mesh.

A few numbers that hold for all frames, as those of a lens, or of a similarity of all poses: by
steps of Gauss and Newton from small pictures to larger ones, with Huber's weights. The radiances of
the points and a gain of each patch of a frame are free, and taken off values and slopes alike
(Frisch and Waugh, "Partial Time Regressions", 1933).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Generic, Protocol, TypeVar

import numpy as np

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh, across_triangles
from usdbrdf.texturing.agreement import MeshPoints
from usdbrdf.texturing.pose_samples import halved, look_up
from usdbrdf.transport.rays import RayScene

_TOLD = calibration.number("joint_change.told")
_SURE = calibration.number("joint_change.sure")
_SIGNS = calibration.number("joint_change.signs")
_LEFT = calibration.number("joint_change.left")
_APART = calibration.number("joint_change.apart")
_OUTLYING = calibration.number("joint_change.outlying")
# Pixels of a picture's width: of the smallest, in which is started, and of the largest.
_COARSEST, FINEST = 64, 256
# And rows and columns that one has at least.
_LEAST_SIDE = 8
# Points of the mesh; patches across a picture; samples and frames without which nothing is said.
_POINTS, _ACROSS, _FEWEST, _MIN_FRAMES = 1 << 13, 8, 500, 6
_ROUNDS, _TURNS, _SEED = 3, 4, 0
# Steps in pictures of one size, at most, of which the last is so small; noise in the slopes makes
# each too short, by about this factor.
_STEPS, _ENOUGH, _LONGER = 8, 5e-4, 1.6


C = TypeVar("C", bound="Change")


class Change(Protocol):
    """Of all frames alike, by K numbers, each of which moves what they show by half a diagonal of
    a picture or so where it is 1. Places are in half diagonals from the principal point, to the
    right and down, (S, 2)."""

    @property
    def numbers(self) -> Double:
        """(K,)"""
        ...

    def stepped(self: C, step: Double) -> C:
        """This, and after it a small change by numbers (K,)."""
        ...

    def moves_cameras(self) -> bool:
        """Whether other parts of the mesh may be seen then."""
        ...

    def camera(self, camera: Camera) -> Camera:
        """What a frame's camera is then, if nothing else is."""
        ...

    def picture(self, picture: Float, camera: Camera) -> Float:
        """What that camera, of the picture's size, would have shown instead of the picture."""
        ...

    def places(self, place: Double) -> Double:
        """Where what that camera has at a place is in the frame's picture."""
        ...

    def by_number(self, camera: Camera, points: Double) -> Double:
        """(S, 2, K) how places of points (S, 3) in what that camera, already changed, shows move
        with the numbers of a small step."""
        ...


@dataclass(frozen=True)
class Found(Generic[C]):
    """The change under which N frames agree best; how far it moves what they show, as the root of
    the mean square, and that number's standard error, in pictures' widths; how many frames agree
    better with the others then; the share that is left of what they differ by, beside what samples
    of a patch do; apart, how differently frames move on the surface what they show of one point,
    beside how far they do, as roots of mean squares: next to nothing for frames from one place,
    which would agree under any lens; and the form (K, K) by which numbers of a step from there give
    the mean square of how far it moves what frames show, in widths."""

    change: C
    moved: float
    error: float
    better: int
    frames: int
    left: float
    apart: float
    form: Double

    @property
    def is_clear(self) -> bool:
        """Whether it is worth telling, and nothing that chance does."""
        signs = 2 * self.better - self.frames
        far = self.moved > max(_TOLD, _SURE * self.error)
        agree = signs > _SIGNS * math.sqrt(self.frames) and self.left < _LEFT
        return far and agree and self.is_seen_from_places

    @property
    def is_seen_from_places(self) -> bool:
        """Whether the frames are from places that differ by enough to tell."""
        return self.apart > _APART


@dataclass(frozen=True)
class _Samples:
    """S samples of all frames, in turn: point, frame and patch (each (S,), patches numbered
    through), value (S,), slopes (S, K) by the numbers of a step, places (S, 2), how they move with
    these numbers (S, 2, K), and what half a diagonal to the right and down is at the point,
    (S, 2, 3)."""

    point: Long
    frame: Long
    patch: Long
    value: Double
    slope: Double
    place: Double
    by_number: Double
    sides: Double


class _Frames:
    """Cameras and pictures, from the smallest size to the largest, and what they show of points."""

    def __init__(
        self,
        rays: RayScene,
        cameras: Sequence[Camera],
        pictures: Sequence[Float],
        surface: MeshPoints,
    ) -> None:
        self.surface = surface
        self.cameras = cameras
        self.sizes = [[_no_wider(picture, FINEST) for picture in pictures]]
        while _may_be_halved(self.sizes[0], 2 * _COARSEST):
            self.sizes.insert(0, [halved(picture) for picture in self.sizes[0]])

        def seen(camera: Camera, picture: Float) -> tuple[Int, Float]:
            return visible_faces(rays, camera.at_size(picture.shape[1], picture.shape[0]))

        @cache
        def as_told(size: int) -> list[tuple[Int, Float]]:
            return [seen(*one) for one in zip(cameras, self.sizes[size], strict=True)]

        self._seen, self._seen_as_told = seen, as_told

    def shown(self, size: int, change: Change) -> _Samples:
        """What the frames show of the points, if they are changed so."""
        cameras = [change.camera(camera) for camera in self.cameras]
        pictures = self.sizes[size]
        if change.moves_cameras():
            visible = [self._seen(*one) for one in zip(cameras, pictures, strict=True)]
        else:
            visible = self._seen_as_told(size)
        return _shown(self.surface, cameras, pictures, visible, change)

    def moved(self, told: _Samples, change: Change) -> Double:
        """(S, 2) by how much the change moves the places of what the frames show as told."""
        found = np.empty_like(told.place)
        for i, camera in enumerate(self.cameras):
            own = told.frame == i
            points = self.surface.point[told.point[own]]
            found[own] = change.places(places_of(change.camera(camera), points)) - told.place[own]
        return found


def best_change(
    surface: MeshPoints,
    rays: RayScene,
    cameras: Sequence[Camera],
    pictures: Sequence[Float],
    starts: Sequence[C],
) -> Found[C] | None:
    """None where few frames share few points, or what is sought runs away.

    surface   the points that are asked, which ``rays`` are of
    pictures  the frames' ``logarithms``, in any size
    starts    the first of them no change, or what all is held against, to be begun from that under
              which frames agree best
    """
    narrowest = min((min(picture.shape) for picture in pictures), default=0)
    if len(cameras) < _MIN_FRAMES or narrowest < _LEAST_SIDE:
        return None
    frames = _Frames(rays, cameras, pictures, surface)
    shown = {start: frames.shown(0, start) for start in starts}
    most = max(len(samples.point) for samples in shown.values())
    # One under which few points are seen at all is no better one.
    sound = [start for start in starts if 2 * len(shown[start].point) >= most]
    found = min(sound, key=lambda one: _disagreement(shown[one]))
    for size in range(len(frames.sizes)):
        if size:
            shown = {one: frames.shown(size, one) for one in {starts[0], found}}
        # What was found in smaller pictures may be what these alone do not tell apart.
        found = min(starts[0], found, key=lambda one: _disagreement(shown[one]))
        for _ in range(_STEPS):
            samples = shown.get(found) or frames.shown(size, found)
            if len(samples.point) < _FEWEST:
                return None
            step, covariance = _step(samples)
            found = found.stepped(_LONGER * step)
            if not np.abs(found.numbers).max() < 1:
                return None
            if np.abs(step).max() < _ENOUGH:
                break
    told, best = shown[starts[0]], frames.shown(len(frames.sizes) - 1, found)
    if min(len(told.point), len(best.point)) < _FEWEST:
        return None
    better, compared = _better(told, best, len(cameras))
    shift = frames.moved(told, found)
    # Half a diagonal, in widths.
    half = math.hypot(1, pictures[0].shape[0] / pictures[0].shape[1]) / 2
    form = half**2 * np.einsum("sik,sil->kl", best.by_number, best.by_number) / len(best.point)
    return Found(
        found,
        moved=half * math.sqrt(float((shift**2).sum()) / len(shift)),
        error=math.sqrt(max(float(np.trace(form @ covariance)), 0.0)),
        better=better,
        frames=compared,
        # Under a change that magnifies frames have less noise and less detail: they agree better
        # by that.
        left=_disagreement(best) / max(_disagreement(told), 1e-9),
        apart=_apart(told, shift),
        form=np.asarray(form, np.float64),
    )


def points_seen(mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera]) -> MeshPoints:
    """Of some places in all pictures: the middles of pixels alone would be sharper than others."""
    rng = np.random.default_rng(_SEED)
    across = across_triangles(mesh.points, mesh.triangles)
    points, faces, normals = [], [], []
    for camera in cameras:
        pixels = rng.random((-(-_POINTS // len(cameras)), 2)) * [camera.width, camera.height]
        origins, directions = camera.rays(pixels)
        hits = rays.closest(origins, directions)
        hit = hits.face >= 0
        face, towards = hits.face[hit], directions[hit].astype(np.float64)
        points.append(origins[hit] + towards * hits.distance[hit, None])
        behind = (across[face] * towards).sum(axis=1, keepdims=True) > 0
        normal = np.where(behind, -across[face], across[face])
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
        faces.append(face)
    owner = mesh.face_object[np.concatenate(faces)]
    return MeshPoints(np.concatenate(points), np.concatenate(normals), owner)


def _apart(samples: _Samples, shift: Double) -> float:
    """As of ``Found``."""
    moved = np.einsum("sk,ski->is", shift, samples.sides)
    point, count = samples.point, np.bincount(samples.point)
    means = [(np.bincount(point, one) / np.maximum(count, 1))[point] for one in moved]
    return math.sqrt(float(((moved - means) ** 2).sum()) / max(float((moved**2).sum()), 1e-30))


def _no_wider(picture: Float, width: int) -> Float:
    while _may_be_halved([picture], 2 * width):
        picture = halved(picture)
    return picture


def _may_be_halved(pictures: Sequence[Float], width: int) -> bool:
    """Whether all are so wide at least, and high enough."""
    return all(p.shape[1] >= width and p.shape[0] >= 2 * _LEAST_SIDE for p in pictures)


def half_diagonal(camera: Camera) -> float:
    """Of its picture, in pixels."""
    return math.hypot(camera.width, camera.height) / 2


def places_of(camera: Camera, points: Double) -> Double:
    """(S, 2) where points (S, 3) are in a camera's picture, in half diagonals from the principal
    point."""
    return (camera.project(points) - camera.intrinsics[2:]) / half_diagonal(camera)


def _shown(
    surface: MeshPoints, cameras: Sequence[Camera], pictures: Sequence[Float],
    visible: Sequence[tuple[Int, Float]], change: Change,
) -> _Samples:  # fmt: skip
    """What the frames show of the points; cameras and what is ``visible`` are changed already."""
    columns, patches = [], 0
    for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        height, width = picture.shape
        camera = camera.at_size(width, height)
        changed = change.picture(picture, camera)
        seen = look_up(surface, visible[i], camera, changed, max(1, width // _ACROSS))
        points = surface.point[seen.point]
        m = np.linalg.inv(camera.world_from_camera)
        z = points @ m[2, :3] + m[2, 3]
        # A camera that moves moves what it shows of a point by its depth.
        half = half_diagonal(camera)
        by_move = np.array([half / camera.intrinsics[0], -half / camera.intrinsics[1]])
        by_place = seen.slope[:, 3:5].astype(np.float64) * z[:, None] * by_move
        by_number = change.by_number(camera, points)
        slope = np.einsum("si,sik->sk", by_place, by_number)
        frame = np.full(len(points), i)
        place = places_of(camera, points)
        sides = -z[:, None, None] * (camera.world_from_camera[:3, :2] * by_move).T
        own = seen.point, frame, seen.patch + patches, seen.value, slope, place, by_number, sides
        columns.append(own)
        patches += int(seen.patch.max(initial=-1)) + 1
    point, frame, patch, value, *rest = (np.concatenate(c) for c in zip(*columns, strict=True))
    known = np.bincount(point, minlength=len(surface.point))[point] > 1
    of_all = point, frame, patch, value.astype(np.float64), *rest
    return _Samples(*(column[known] for column in of_all))


def _without_means(samples: _Samples, columns: Double, weight: Double) -> Double:
    """(S, C) less what the samples of a point, and of a patch, have in common."""
    left = columns.copy()
    kinds = (samples.patch, samples.point)
    weights = [np.maximum(np.bincount(own, weight), 1e-9) for own in kinds]
    for _ in range(_TURNS):
        for own, of_all in zip(kinds, weights, strict=True):
            _take_means(own, weight, of_all, left)
    return left


@loop
def _take_means(own: Long, weight: Double, of_all: Double, left: Double) -> None:
    """Off each column what the samples of each number ``own`` have in common."""
    means = np.zeros((len(of_all), left.shape[1]))
    for s in range(len(left)):
        for c in range(left.shape[1]):
            means[own[s], c] += weight[s] * left[s, c]
    for i in range(len(of_all)):
        for c in range(left.shape[1]):
            means[i, c] /= of_all[i]
    for s in range(len(left)):
        for c in range(left.shape[1]):
            left[s, c] -= means[own[s], c]


def _off(samples: _Samples) -> Double:
    """(S,) what each sample differs from the others of its point by."""
    left = _without_means(samples, samples.value[:, None], np.ones(len(samples.value)))[:, 0]
    number = np.bincount(samples.point)[samples.point]
    return left * np.sqrt(number / (number - 1))


def _disagreement(samples: _Samples) -> float:
    """How much samples of a point differ, beside those of a patch: frames that see a spot each
    would agree whatever they are. Infinitely where there are few."""
    if len(samples.point) < _FEWEST:
        return math.inf
    patch = samples.patch
    count = np.bincount(patch)
    inside = samples.value - (np.bincount(patch, samples.value) / np.maximum(count, 1))[patch]
    return float(np.abs(_off(samples)).mean()) / max(float(np.abs(inside).mean()), 1e-9)


def _step(samples: _Samples) -> tuple[Double, Double]:
    """The numbers (K,) of a step after which the samples agree better, and their covariance (K, K),
    from how far the frames agree on it."""
    weight: Double = np.ones(len(samples.value))
    tie = 1e-9 * np.eye(samples.slope.shape[1])
    columns = np.column_stack([samples.value, samples.slope])
    for _ in range(_ROUNDS):
        known = _without_means(samples, columns, weight)
        off, basis = known[:, 0], np.ascontiguousarray(known[:, 1:])
        normal = (basis * weight[:, None]).T @ basis + tie
        step = -np.linalg.solve(normal, basis.T @ (weight * off))
        left = off + basis @ step
        scatter = max(1.4826 * float(np.median(np.abs(left))), 1e-4)
        weight = np.minimum(1, _OUTLYING * scatter / np.maximum(np.abs(left), 1e-9))
    inverse = np.linalg.inv(normal)
    said = [np.bincount(samples.frame, weight * left * column) for column in basis.T]
    covariance = inverse @ np.array(said) @ np.array(said).T @ inverse
    return np.asarray(step, np.float64), np.asarray(covariance, np.float64)


def _better(told: _Samples, best: _Samples, frames: int) -> tuple[int, int]:
    """How many frames agree better with the others under another change, at the points that they
    show under both; and how many were compared."""
    sides = []
    for samples in (told, best):
        off: Double = np.full((int(samples.point.max()) + 1, frames), np.nan)
        off[samples.point, samples.frame] = np.abs(_off(samples))
        sides.append(off)
    rows = min(len(side) for side in sides)
    change = sides[1][:rows] - sides[0][:rows]
    compared = np.asarray(np.isfinite(change).any(axis=0), np.bool_)
    means = np.nansum(change, axis=0)[compared]
    return int((means < 0).sum()), int(compared.sum())
