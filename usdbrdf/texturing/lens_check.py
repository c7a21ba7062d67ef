"""Do the frames show the surface where their lens, as it is told, would have it?

A focal length that is not that of the pictures, a principal point from other pictures and
distortion that was never told move all frames' content by one pattern, which what the frames show
of the same points of the mesh tells: the pattern's four numbers under which they agree best, by
steps of Gauss and Newton from small pictures to larger ones, with Huber's weights. The radiances of
the points and a gain of each patch of a frame are free, and taken off values and slopes alike
(Frisch and Waugh, "Partial Time Regressions", 1933).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.texturing.agreement import MeshPoints, points_of_surface
from usdbrdf.texturing.pose_samples import halved, look_up
from usdbrdf.transport.rays import RayScene

_TOLD = calibration.number("lens_check.told")
_SURE = calibration.number("lens_check.sure")
_SIGNS = calibration.number("lens_check.signs")
_LEFT = calibration.number("lens_check.left")
_APART = calibration.number("lens_check.apart")
_OUTLYING = calibration.number("lens_check.outlying")
# Focal lengths from which is started, as told being 1.
_STARTS = (1.0, 0.62, 0.71, 0.8, 0.89, 1.12, 1.25, 1.4, 1.6)
# Pixels of a picture's width: of the smallest, in which is started, and of the largest.
_COARSEST, FINEST = 64, 256
# And rows and columns that one has at least.
_LEAST_SIDE = 8
# Points of the mesh; patches across a picture; samples and frames without which nothing is said.
_POINTS, _ACROSS, _FEWEST, _MIN_FRAMES = 1 << 14, 8, 500, 6
_ROUNDS, _TURNS = 3, 4
# Steps in pictures of one size, at most, of which the last is so small: slopes that are blurred by
# the pictures' own pixels make each too short.
_STEPS, _ENOUGH = 10, 5e-4


@dataclass(frozen=True)
class Pattern:
    """Where frames show what they should show at a place in the picture, in half diagonals from
    the principal point, rho away from it: exp(zoom) (1 + bend rho^2) times as far, and moved."""

    zoom: float = 0.0
    bend: float = 0.0
    right: float = 0.0
    down: float = 0.0

    def place(self, x: Double, y: Double) -> tuple[Double, Double]:
        """Of places x, y in half diagonals."""
        factor = math.exp(self.zoom) * (1 + self.bend * (x**2 + y**2))
        return factor * x + self.right, factor * y + self.down

    @property
    def numbers(self) -> Double:
        return np.array([self.zoom, self.bend, self.right, self.down])

    def stepped(self, step: Double) -> Pattern:
        return Pattern(*(self.numbers + step).tolist())


@dataclass(frozen=True)
class LensCheck:
    """The pattern under which N frames agree best; how far it moves the content of a picture, as
    the root of the mean square over it, and that number's standard error, in pictures' widths; how
    many frames agree better with the others then; the share that is left of what they differ by,
    beside what samples of a patch do; and apart, how differently frames move on the surface what
    they show of one point, beside how far they do, as roots of mean squares: next to nothing for
    frames from one place, which would agree under any lens."""

    pattern: Pattern
    moved: float
    error: float
    better: int
    frames: int
    left: float
    apart: float

    @property
    def is_clear(self) -> bool:
        """Whether it is worth telling, and nothing that chance does."""
        signs = 2 * self.better - self.frames
        far = self.moved > max(_TOLD, _SURE * self.error)
        agree = signs > _SIGNS * math.sqrt(self.frames) and self.left < _LEFT
        return far and agree and self.apart > _APART


@dataclass(frozen=True)
class _Samples:
    """S samples of all frames, in turn: point, frame and patch (each (S,), patches numbered
    through), value (S,), slopes (S, 4) by the numbers of a pattern, place (S, 2) in the picture, in
    half diagonals from the principal point, and what half a diagonal to the right and down is at
    the point, (S, 2, 3)."""

    point: Long
    frame: Long
    patch: Long
    value: Double
    slope: Double
    place: Double
    sides: Double


def lens_of_frames(
    mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera], pictures: Sequence[Float]
) -> LensCheck | None:
    """None where few frames share few points.

    pictures  the frames' ``logarithms``, in any size
    """
    if len(cameras) < _MIN_FRAMES:
        return None
    surface = points_of_surface(mesh, _POINTS)
    if min(min(picture.shape) for picture in pictures) < _LEAST_SIDE:
        return None
    sizes = [[_no_wider(picture, FINEST) for picture in pictures]]
    while _may_be_halved(sizes[0], 2 * _COARSEST):
        sizes.insert(0, [halved(picture) for picture in sizes[0]])

    @cache
    def visible(level: int) -> list[tuple[Int, Float]]:
        return [
            visible_faces(rays, camera.at_size(picture.shape[1], picture.shape[0]))
            for camera, picture in zip(cameras, sizes[level], strict=True)
        ]

    def shown(level: int, pattern: Pattern) -> _Samples:
        return _shown(surface, cameras, sizes[level], visible(level), pattern)

    begun = {zoom: shown(0, Pattern(math.log(zoom))) for zoom in _STARTS}
    most = max(len(samples.point) for samples in begun.values())
    # A lens under which few points are seen at all is no better one.
    begun = {zoom: s for zoom, s in begun.items() if len(s.point) >= max(_FEWEST, most / 2)}
    if not begun:
        return None
    found = Pattern(math.log(min(begun, key=lambda zoom: _disagreement(begun[zoom]))))
    for level in range(len(sizes)):
        for _ in range(_STEPS):
            samples = shown(level, found)
            if len(samples.point) < _FEWEST:
                return None
            step, covariance = _step(samples)
            found = found.stepped(step)
            if not np.abs(found.numbers).max() < 1:
                return None
            if np.abs(step).max() < _ENOUGH:
                break
    told, best = (shown(len(sizes) - 1, pattern) for pattern in (Pattern(), found))
    if min(len(told.point), len(best.point)) < _FEWEST:
        return None
    better, compared = _better(told, best, len(cameras))
    # Under a lens that magnifies frames have less noise and less detail: they agree better by that.
    left = _disagreement(best) / max(_disagreement(told), 1e-9)
    form = _form(pictures[0].shape[1] / pictures[0].shape[0])
    numbers = np.array([math.expm1(found.zoom), found.bend, found.right, found.down])
    moved = math.sqrt(float(numbers @ form @ numbers))
    error = math.sqrt(float(np.trace(form @ covariance)))
    return LensCheck(found, moved, error, better, compared, left, _apart(told, found))


def _apart(samples: _Samples, pattern: Pattern) -> float:
    """As of ``LensCheck``."""
    shift = np.stack(pattern.place(*samples.place.T), axis=1) - samples.place
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


def _form(aspect: float) -> Double:
    """(4, 4) by which a pattern's numbers give the mean square of how far it moves a picture's
    content, in widths; of small numbers."""
    steps = (np.arange(32) + 0.5) / 16 - 1
    half = 1 / math.hypot(1, 1 / aspect)
    x, y = (part.ravel() for part in np.meshgrid(steps * half, steps * half / aspect))
    rho2, one, none = x**2 + y**2, np.ones_like(x), np.zeros_like(x)
    by_number = np.stack([[x, y], [x * rho2, y * rho2], [one, none], [none, one]])
    # Half a diagonal, in widths.
    return np.asarray(np.einsum("ikp,jkp->ij", by_number, by_number) / len(x) / (2 * half) ** 2)


def _shown(
    surface: MeshPoints, cameras: Sequence[Camera], pictures: Sequence[Float],
    visible: Sequence[tuple[Int, Float]], pattern: Pattern,
) -> _Samples:  # fmt: skip
    """What the frames show of the points, if ``pattern`` is so, where faces are ``visible``."""
    columns, patches = [], 0
    for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        height, width = picture.shape
        camera = camera.at_size(width, height)
        half = math.hypot(width, height) / 2
        patch = max(1, width // _ACROSS)
        moved = _moved(picture, camera, pattern, half)
        seen = look_up(surface, visible[i], camera, moved, patch)
        m = np.linalg.inv(camera.world_from_camera)
        z = surface.point[seen.point] @ m[2, :3] + m[2, 3]
        x, y = ((camera.project(surface.point[seen.point]) - camera.intrinsics[2:]) / half).T
        fx, fy = camera.intrinsics[:2]
        # A camera that moves moves what it shows of a point as its lens does, by the depth.
        right, down, zoom = (
            seen.slope[:, k].astype(np.float64) * z * by
            for k, by in ((3, half / fx), (4, -half / fy), (5, 1))
        )
        slope = np.stack([zoom, zoom * (x**2 + y**2), right, down], axis=1)
        frame = np.full(len(seen.point), i)
        place = np.stack([x, y], axis=1)
        across = camera.world_from_camera[:3, :2].T * [[half / fx], [-half / fy]]
        sides = -z[:, None, None] * across
        columns.append((seen.point, frame, seen.patch + patches, seen.value, slope, place, sides))
        patches += int(seen.patch.max(initial=-1)) + 1
    point, frame, patch, value, *rest = (np.concatenate(c) for c in zip(*columns, strict=True))
    known = np.bincount(point, minlength=len(surface.point))[point] > 1
    of_all = point, frame, patch, value.astype(np.float64), *rest
    return _Samples(*(column[known] for column in of_all))


def _moved(picture: Float, camera: Camera, pattern: Pattern, half: float) -> Float:
    """The picture as it would be without the pattern."""
    if pattern == Pattern():
        return picture
    _, _, cx, cy = camera.intrinsics
    row, column = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    x, y = pattern.place((column - cx) / half, (row - cy) / half)
    at = [y * half + cy - 0.5, x * half + cx - 0.5]
    return np.asarray(map_coordinates(picture, at, order=1, cval=np.nan), np.float32)


def _without_means(samples: _Samples, column: Double, weight: Double) -> Double:
    """(S,) less what the samples of a point, and of a patch, have in common."""
    left = column
    kinds = (samples.patch, samples.point)
    weights = [np.maximum(np.bincount(own, weight), 1e-9) for own in kinds]
    for _ in range(_TURNS):
        for own, of_all in zip(kinds, weights, strict=True):
            left = left - (np.bincount(own, weight * left) / of_all)[own]
    return left


def _off(samples: _Samples) -> Double:
    """(S,) what each sample differs from the others of its point by."""
    left = _without_means(samples, samples.value, np.ones(len(samples.value)))
    number = np.bincount(samples.point)[samples.point]
    return left * np.sqrt(number / (number - 1))


def _disagreement(samples: _Samples) -> float:
    """How much samples of a point differ, beside those of a patch: frames that see a spot each
    would agree whatever they are."""
    patch = samples.patch
    count = np.bincount(patch)
    inside = samples.value - (np.bincount(patch, samples.value) / np.maximum(count, 1))[patch]
    return float(np.abs(_off(samples)).mean()) / max(float(np.abs(inside).mean()), 1e-9)


def _step(samples: _Samples) -> tuple[Double, Double]:
    """The step of a pattern's numbers (4,) after which the samples agree better, and the covariance
    (4, 4) of these, from how far the frames agree on it."""
    weight: Double = np.ones(len(samples.value))
    for _ in range(_ROUNDS):
        off = _without_means(samples, samples.value, weight)
        basis = np.stack([_without_means(samples, c, weight) for c in samples.slope.T], axis=1)
        normal = (basis * weight[:, None]).T @ basis + 1e-9 * np.eye(4)
        step = -np.linalg.solve(normal, basis.T @ (weight * off))
        left = off + basis @ step
        scatter = max(1.4826 * float(np.median(np.abs(left))), 1e-4)
        weight = np.minimum(1, _OUTLYING * scatter / np.maximum(np.abs(left), 1e-9))
    inverse = np.linalg.inv(normal)
    said = [np.bincount(samples.frame, weight * left * column) for column in basis.T]
    covariance = inverse @ np.array(said) @ np.array(said).T @ inverse
    return np.asarray(step, np.float64), np.asarray(covariance, np.float64)


def _better(told: _Samples, best: _Samples, frames: int) -> tuple[int, int]:
    """How many frames agree better with the others under another pattern, at the points that they
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


def doubts_about_lens(found: LensCheck | None, source: Path) -> Iterator[str]:
    """A sentence where the frames would agree clearly better with another lens."""
    if found is None or not found.is_clear:
        return
    pattern = found.pattern
    yield (
        f"{source.name}: frames show points of the mesh {found.moved:.1%} of a picture's width "
        f"(error {found.error:.1%}) from where their lens has them; {found.better} of "
        f"{found.frames} would agree better with a focal length {math.exp(pattern.zoom):.3f} times "
        f"as long, distortion of {pattern.bend:+.1%} in the corners and a principal point moved by "
        f"({pattern.right / 2:+.1%}, {pattern.down / 2:+.1%}) of the diagonal. Check that the "
        "intrinsics are those of these pictures, at their size, that distortion is stated or "
        "undone, and that mesh and poses have one scale. [capture.lens]"
    )
