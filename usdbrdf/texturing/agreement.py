"""Do poses, mesh and frames agree? The same points of the surface, looked up in many frames.

Cheap beside texturing: some thousand points, no atlas. What the frames show at one point differs by
noise and highlights where all is well, and as much as any two pixels do where poses are wrong. It
tells the frames' gains too, before hours are spent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.files.frames import FramePixels
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh, across_triangles
from usdbrdf.texturing.exposures import gains_of_frames
from usdbrdf.texturing.samples import Projection
from usdbrdf.transport.rays import RayScene

MIN_COSINE = calibration.number("agreement.min_cosine")
_AGREES = calibration.number("agreement.agrees")
_BETTER = calibration.number("agreement.better")
_PLAIN = calibration.number("agreement.plain")
_POINTS, _SEED = 4096, 0
# Samples of points that several frames see, without which nothing is said.
_FEWEST = 500
# Standard errors by which another reading must be better than the one that is given.
_SURE = 4.0
# How much nearer than a point another surface may lie that does not hide it, of its distance.
_SLACK = 5e-3


class MeshPoints(NamedTuple):
    """P points of a mesh: point, normal (P, 3) float64, in the capture's unit; owner (P,) int32,
    the object that a point is of."""

    point: Double
    normal: Double
    owner: Int

    def every(self, step: int) -> MeshPoints:
        """One of so many."""
        return MeshPoints(self.point[::step], self.normal[::step], self.owner[::step])


def points_of_surface(mesh: ScanMesh, count: int = _POINTS) -> MeshPoints:
    """``count`` points, even by area, the same for equal meshes."""
    rng = np.random.default_rng(_SEED)
    across = across_triangles(mesh.points, mesh.triangles)
    area = np.linalg.norm(across, axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (mesh.points[mesh.triangles[face, k]].astype(np.float64) for k in range(3))
    point, normal = a + u * (b - a) + v * (c - a), across[face] / area[face, None]
    return MeshPoints(point, normal, mesh.face_object[face])


def surface_and_rays(mesh: ScanMesh) -> tuple[MeshPoints, RayScene]:
    """The points of a mesh that are looked up, and the rays that tell which frames see them."""
    return points_of_surface(mesh), RayScene(mesh.points, mesh.triangles)


def logarithms_in_frame(
    surface: MeshPoints, rays: RayScene, camera: Camera, pixels: FramePixels
) -> Float:
    """(P,) float32 logarithm of what a frame shows at each point, the mean of R, G and B over 3 x 3
    pixels; NaN where it shows nothing valid."""
    found = np.full(len(surface.point), np.nan, np.float32)
    seen, column, row = seen_points(surface, rays, camera)
    level = np.empty(len(column), np.float32)
    _levels(pixels.radiance, pixels.valid, column, row, level)
    found[seen] = np.log(level)
    return found


@loop
def _levels(radiance: Float, valid: Bool, column: Long, row: Long, level: Float) -> None:
    """Means of R, G and B over 3 x 3 pixels about some alone: photographs have millions; NaN where
    one of them is not valid."""
    for k in range(len(level)):
        total = np.float32(0)
        for j in range(row[k] - 1, row[k] + 2):
            for i in range(column[k] - 1, column[k] + 2):
                mean = (radiance[j, i, 0] + radiance[j, i, 1] + radiance[j, i, 2]) / np.float32(3)
                total += mean if valid[j, i] and mean > 0 else np.float32(np.nan)
        level[k] = total / np.float32(9)


def seen_points(surface: MeshPoints, rays: RayScene, camera: Camera) -> tuple[Bool, Long, Long]:
    """Which points (P,) a camera sees, from in front, and of these column and row."""
    count, size = len(surface.point), (camera.width, camera.height)
    cell, direction = np.full((count, 2), -1, np.int64), np.empty((count, 3), np.float32)
    distance = np.empty(count)
    _in_front(surface.point, surface.normal, Projection.of(camera), size, cell, direction, distance)
    seen = cell[:, 0] >= 0
    if seen.any():
        hits = rays.closest(camera.eye[None].astype(np.float32), direction[seen])
        free = (hits.face < 0) | (hits.distance >= (1 - _SLACK) * distance[seen])
        seen[np.flatnonzero(seen)[~free]] = False
    column, row = cell[seen].T
    return seen, column, row


@loop
def _in_front(
    point: Double, normal: Double, camera: Projection, size: tuple[int, int], cell: Long,
    direction: Float, distance: Double,
) -> None:  # fmt: skip
    """Column and row, unit direction and distance of what faces the camera in its picture, but for
    its outermost pixels."""
    m, (fx, fy, cx, cy) = camera.camera_from_world, camera.intrinsics
    for k in range(len(point)):
        p, n = point[k], normal[k]
        wx, wy, wz = p[0] - camera.eye[0], p[1] - camera.eye[1], p[2] - camera.eye[2]
        far = np.sqrt(wx * wx + wy * wy + wz * wz)
        depth = -(m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3])
        towards = n[0] * wx + n[1] * wy + n[2] * wz
        if not (depth > 1e-6 * far and towards < -MIN_COSINE * far):
            continue
        x = m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3]
        y = m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3]
        column, row = np.floor(cx + fx * x / depth), np.floor(cy - fy * y / depth)
        if 1 <= column <= size[0] - 2 and 1 <= row <= size[1] - 2:
            cell[k, 0], cell[k, 1] = int(column), int(row)
            direction[k, 0], direction[k, 1], direction[k, 2] = wx / far, wy / far, wz / far
            distance[k] = far


class Agreement(NamedTuple):
    """How far frames agree about the same points.

    scatter  mean difference of what one frame shows of a point and what the others do, as a natural
             logarithm
    ratio    as a share of how much all samples differ: about 0 where all is well, about 1 where the
             poses tell nothing
    samples  how many were compared
    error    standard error of the ratio, by which points were asked
    variety  how much samples of one frame differ, as a natural logarithm
    """

    scatter: float
    ratio: float
    samples: int
    error: float
    variety: float

    @property
    def inside(self) -> float:
        """The scatter as a share of the variety: about 1 too where frames see a spot each."""
        return self.scatter / max(self.variety, 1e-6)


def agreement(logarithm: Float, judged: Bool | None = None) -> Agreement | None:
    """Of logarithms (P, N); None where too few points are seen by several frames.

    judged  (N,) bool: how far these frames agree with all; None: each of them
    """
    known = np.isfinite(logarithm)
    known &= (known.sum(axis=1) > 1)[:, None]
    compared = known if judged is None else known & judged
    samples = int(compared.sum())
    if samples < _FEWEST:
        return None
    rows = known.any(axis=1)
    value = np.where(known, logarithm, np.nan)[rows].astype(np.float64)
    off = value - np.nanmedian(value, axis=1, keepdims=True)
    # A median of few is near each of them by itself: of n samples, by about (n - 1) / n.
    number = known[rows].sum(axis=1, keepdims=True)
    off *= np.sqrt(number / (number - 1))
    # Means, for where most of a scene is one colour the median pixel fits any pose.
    far = np.where(compared[rows], np.abs(off), 0)
    scatter = float(far.sum() / samples)
    by_point = far.sum(axis=1) - scatter * compared[rows].sum(axis=1)
    error = float(np.sqrt((by_point**2).sum()) / samples)
    level = value[known[rows]]
    spread = max(float(np.abs(level - np.median(level)).mean()), 1e-6)
    return Agreement(scatter, scatter / spread, samples, error / spread, spread_in_frames(value))


def spread_in_frames(value: Float | Double) -> float:
    """Mean difference of logarithms (P, N) from the median of their frame."""
    frames = [column[np.isfinite(column)] for column in value.T]
    off = [np.abs(shown - np.median(shown)) for shown in frames if len(shown)]
    return float(np.concatenate(off).mean())


def other_convention(given: Agreement | None, others: Mapping[str, Agreement | None]) -> str:
    """The one of ``others``, readings of the poses by name, under which frames clearly agree while
    they hardly do as the poses are ``given``; "" where there is none."""
    given = given or Agreement(1.0, 1.0, _FEWEST, 0.0, 0.0)
    if given.ratio < _PLAIN:
        return ""

    def clearly_better(other: Agreement) -> bool:
        return (
            # A reading under which few points are seen at all is no better one,
            2 * other.samples >= given.samples
            and other.ratio < min(_BETTER * given.ratio, _AGREES)
            # nor one from so far that each frame sees a spot, as of either side of a book;
            and other.inside < min(_BETTER * given.inside, _AGREES)
            and 2 * other.variety >= given.variety
            # and those beside which a mesh looks as it did, as a cube turned, differ by chance.
            and given.ratio - other.ratio > _SURE * math.hypot(given.error, other.error)
        )

    sound = {n: a.ratio for n, a in others.items() if a and clearly_better(a)}
    return min(sound, key=lambda name: sound[name], default="")


def is_doubtful(given: Agreement | None) -> bool:
    """Whether other readings of the poses are worth trying."""
    return given is None or given.ratio > _AGREES


def doubts_about_agreement(found: Agreement | None, shown: Float, source: Path) -> Iterator[str]:
    """A sentence where the frames hardly agree, under whatever reading of the poses, and whatever
    each is brighter or darker by, which is told as that.

    shown  (P, N) logarithms, of which ``found`` was made
    """
    if found is None or not is_doubtful(found):
        return
    alike = agreement(shown - gains_of_frames(shown).logarithm.astype(np.float32))
    # Gains take some of what wrong poses do, but never most of it.
    if alike is None or 2 * alike.ratio > found.ratio:
        yield (
            f"{source.name}: frames that show the same points of the mesh differ by "
            f"{found.ratio:.0%} of what any two pixels do, under every usual reading of the poses. "
            "Check that poses, mesh and images belong together. [capture.agreement]"
        )
