"""The bright part of the surface as triangles that rays can be sent to on purpose, and which of
them matter to a tile of texels: groups of bright triangles, weighed tile by tile.

Picking lights by their power alone sends most rays to lamps that are far off or turn their back. A
group's importance to a point is a bound on what it could bring there, were nothing in between:

    power * (n . d + r) * (-m . d + r + c + s |d|) / (|d|^2 + r^2 + c^2)^2

(d from the point to the group's centre, n, m the normals, r the group's radius, s how much its
normals differ; factors below 0 are 0; c how far the point speaks for its neighbours). A tile's
probabilities are the mean of those that suit some of its texels and, for a share of picks, follow
power alone: no light is left out. After P. Shirley et al., "Monte Carlo Techniques for Direct
Lighting Calculations", 1996, and A. Conty Estevez and C. Kulla, "Importance Sampling of Many Lights
with Adaptive Tree Splitting", 2018.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Byte, Double, Float, Int, Long, Short
from usdbrdf.model.mesh import doubled_areas
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.openings import NO_OPENINGS, openings_of
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import unsigned

# Surface brighter than this many times the scene's area-mean radiance is worth its own rays; the
# cosine-distributed ones find everything dimmer well enough.
BRIGHTER_THAN = 3.0
# Groups at most; steps of a tile's guide per group: picking then seldom has to look further; share
# of the picks that follow power alone; and texels of a tile that its groups are weighed at.
_GROUPS, _STEPS, _BY_POWER, _WEIGHED_AT = 512, 4, 0.1, 8
# Columns of ``LightGroups.triangles``.
_CORNER, _EDGE_U, _EDGE_V, _NORMAL, DENSITY, GROUP = 0, 3, 6, 9, 12, 13


class LightGroups(NamedTuple):
    """Bright triangles in G groups of neighbours that face alike.

    face        (K,) int32, the lights' triangles in the order of their groups, near ones near
    cumulative  (K,) float64, probability of picking one of the first k, by power
    guide       (8 K,) int32, ``cumulative`` at even steps, so that picking is a look-up
    start       (G + 1,) float64, ``cumulative`` where each group starts and the last ends
    of_face     (F,) int32, each triangle's place among the lights, -1 where it is none
    bounds      (8, G) float32: centre, mean normal, radius, spread of the normals
    triangles   (K, 16) float32: first corner, edges to the others, normal, density per m^2 when
                picked by power, group; what is read together lies together
    is_light    (ceil(F / 8),) uint8, a bit for each triangle of the scene, the lowest first: few
                enough to stay in the cache
    box         (3, 3) float64, of ``openings``, whose triangles are numbered from ``first_opening``
                on, after the scene's
    """

    face: Int
    cumulative: Double
    guide: Int
    start: Double
    of_face: Int
    bounds: Float
    triangles: Float
    is_light: Byte
    box: Double
    first_opening: int


class TilePicks(NamedTuple):
    """How Q tiles pick groups of lights: cumulative probabilities (Q, G), guides to these as
    ``LightGroups.guide`` is one, and how much more likely than by power they are, (Q, G); Q = 0
    where there are no lights."""

    cumulative: Double
    guide: Short
    ratio: Float


@dataclass(frozen=True, kw_only=True)
class Lights:
    """K triangles and a density over their surface.

    face         (K,) int32, indices into the scene's triangles, and those of ``openings`` after
                 them
    cumulative   (K,) float64, ascending to 1: probability of picking one of the first k
    density      (F,) float32, probability per m^2 of a point on any triangle (0 on those that are
                 no light)
    corners      (K, 3, 3) float32, metres, and normals (K, 3) float32, unit, of the lights
    box          (3, 3) float64, of the openings, and the number of the first of them
    """

    face: Int
    cumulative: Double
    density: Float
    corners: Float
    normals: Float
    box: Double
    first_opening: int

    @cached_property
    def groups(self) -> LightGroups:
        """Split where power times extent is largest."""
        power = np.diff(self.cumulative, prepend=0)
        corners, normals = self.corners.astype(np.float64), self.normals.astype(np.float64)
        centres = corners.mean(axis=1)
        # Lights that face apart are as good as far apart.
        size = np.linalg.norm(np.ptp(centres, axis=0)) if len(centres) else 0.0
        features = np.concatenate([centres, normals * size / 4], axis=1)
        parts = _split(features, power)
        order = np.concatenate(parts) if parts else np.zeros(0, np.int64)
        cumulative = np.cumsum(power[order])
        ends = np.cumsum([0, *[len(part) for part in parts]])
        of_face = np.full(len(self.density), -1, np.int32)
        of_face[self.face[order]] = np.arange(len(order))
        # Several steps per light: picking then seldom has to look further.
        steps = np.linspace(0, 1, 8 * len(order), endpoint=False)
        triangles = np.zeros((len(order), 16), np.float32)
        triangles[:, _CORNER:_EDGE_U] = corners[order, 0]
        triangles[:, _EDGE_U:_EDGE_V] = corners[order, 1] - corners[order, 0]
        triangles[:, _EDGE_V:_NORMAL] = corners[order, 2] - corners[order, 0]
        triangles[:, _NORMAL:DENSITY] = normals[order]
        triangles[:, DENSITY] = self.density[self.face[order]]
        triangles[:, GROUP] = np.repeat(np.arange(len(parts)), np.diff(ends))
        return LightGroups(
            face=self.face[order],
            cumulative=cumulative,
            guide=np.searchsorted(cumulative, steps, side="right").astype(np.int32),
            start=np.concatenate([[0.0], cumulative])[ends],
            of_face=of_face,
            bounds=_bounds(parts, power, corners, normals),
            triangles=triangles,
            is_light=np.packbits(self.density > 0, bitorder="little"),
            box=self.box,
            first_opening=self.first_opening,
        )


def lights_from_radiance(
    scene: Scene,
    texels: Texels,
    radiance: Float,
    brighter_than: float = BRIGHTER_THAN,
    outside: tuple[RayScene, Environment] | None = None,
) -> Lights:
    """Triangles whose mean L_d is ``brighter_than`` so many times the scene's area mean, picked in
    proportion to area times radiance; and openings so much brighter than what arrives inside.

    radiance (T, 3): L_d per texel. Triangles smaller than a texel take the texel under their
    centre through their neighbours' mean, so that no lit triangle is left out.
    """
    mean = _brightness_of_faces(scene, texels, radiance)
    area = doubled_areas(scene.points, scene.triangles) / 2
    openings = openings_of(scene, texels, outside[0], mean, outside[1]) if outside else NO_OPENINGS
    scene_mean = float((mean * area).sum() / max(area.sum(), 1e-30))
    bright = np.flatnonzero((mean > brighter_than * scene_mean) & (area > 0))
    opened = np.flatnonzero(openings.weight > brighter_than * openings.arriving * openings.area)
    share = np.concatenate([mean[bright] * area[bright], openings.weight[opened]])
    total = share.sum()
    areas = np.concatenate([area[bright], openings.area[opened]])
    corners = np.concatenate([scene.points[scene.triangles[bright]], openings.corners[opened]])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face = np.concatenate([bright, len(mean) + opened]).astype(np.int32)
    density = np.zeros(len(mean) + len(openings.weight), np.float32)
    density[face] = share / total / areas
    return Lights(
        face=face,
        cumulative=np.cumsum(share) / total if len(face) else np.zeros(0),
        density=density,
        corners=corners.astype(np.float32),
        normals=(normals / (2 * areas[:, None])).astype(np.float32),
        box=openings.box,
        first_opening=len(mean),
    )


def _brightness_of_faces(scene: Scene, texels: Texels, radiance: Float) -> Double:
    """(F,) mean of the largest channel of L_d, (T, 3)."""
    brightness = radiance.max(axis=1)
    weight = np.where(texels.interior, texels.area, 0)
    num_faces = len(scene.triangles)
    power = np.bincount(texels.face, brightness * weight, num_faces).astype(np.float64)
    covered = np.bincount(texels.face, weight, num_faces).astype(np.float64)
    mean = power / np.maximum(covered, 1e-30)
    bare = np.flatnonzero(covered <= 0)
    if len(bare):
        owner = scene.face_object[bare]
        size = texels.resolution[owner]
        centre = np.floor(texels.corner_pixel[bare].mean(axis=1)).astype(np.int64)
        x, y = np.clip(centre, 0, size - 1).T
        mean[bare] = brightness[
            texels.nearest_texel[texels.first_pixel[owner] + y * size[:, 0] + x]
        ]
    return mean


def _split(features: Double, power: Double) -> list[Long]:
    """Indices of each group, groups and what is in them in the order of their features."""
    if not len(features):
        return []

    def entry(place: tuple[int, ...], part: Long) -> tuple[float, tuple[int, ...], Long]:
        return -power[part].sum() * float(np.ptp(features[part], axis=0).max()), place, part

    heap = [entry((), np.arange(len(features)))]
    while heap[0][0] < 0 and len(heap) < _GROUPS:
        _, place, part = heapq.heappop(heap)
        axis = np.ptp(features[part], axis=0).argmax()
        part = part[np.argsort(features[part, axis], kind="stable")]
        share = np.cumsum(power[part])
        middle = int(np.searchsorted(share, share[-1] / 2))
        middle = min(max(middle, 1), len(part) - 1)
        heapq.heappush(heap, entry((*place, 0), part[:middle]))
        heapq.heappush(heap, entry((*place, 1), part[middle:]))
    return [part for _, _, part in sorted(heap, key=lambda one: one[1])]


def _bounds(parts: list[Long], power: Double, corners: Double, normals: Double) -> Float:
    bounds = np.zeros((8, len(parts)), np.float32)
    for g, part in enumerate(parts):
        weight = np.maximum(power[part], 1e-30) / np.maximum(power[part], 1e-30).sum()
        centre = weight @ corners[part].mean(axis=1)
        normal = weight @ normals[part]
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        bounds[:3, g], bounds[3:6, g] = centre, normal
        bounds[6, g] = np.linalg.norm(corners[part] - centre, axis=-1).max()
        bounds[7, g] = np.linalg.norm(normals[part] - normal, axis=-1).max()
    return bounds


@loop
def weighed_groups(
    groups: LightGroups, origin: Float, normal: Float, first_point: Long
) -> TilePicks:
    """How Q tiles pick, whose points (origin, normal (P, 3)) start at ``first_point`` (Q + 1,)."""
    start, bounds = groups.start, groups.bounds
    count, tiles = bounds.shape[1], len(first_point) - 1
    cumulative = np.empty((tiles, count))
    guide = np.empty((tiles, _STEPS * count), np.int16)
    ratio = np.empty((tiles, count), np.float32)
    own, weight = np.empty(count, np.float32), np.empty(count, np.float32)
    power = (start[1:] - start[:-1]).astype(np.float32)
    for q in range(tiles):
        weight[:] = 0
        first, points = first_point[q], first_point[q + 1] - first_point[q]
        reach = _reach(origin[first : first + points])
        for i in range(_WEIGHED_AT):
            # Of whole tiles one in each row and each column.
            k = first + ((i * _WEIGHED_AT + i * 5 % _WEIGHED_AT) * points) // _WEIGHED_AT**2
            _add_importance(bounds, power, (origin[k], normal[k], reach), own, weight)
        total = _dot(weight, power)
        scale = np.float32((1 - _BY_POWER) / total if total > 0 else 0)
        least = np.float32(_BY_POWER if total > 0 else 1)
        for g in range(count):
            ratio[q, g] = least + scale * weight[g]
        reached = 0.0
        for g in range(count):
            reached += float(ratio[q, g]) * (start[g + 1] - start[g])
            cumulative[q, g] = reached
        _fill_guide(cumulative[q], guide[q])
    return TilePicks(cumulative, guide, ratio)


@loop
def _fill_guide(cumulative: Double, guide: Short) -> None:
    """guide[i] = the first of which the cumulative probability exceeds i / len(guide)."""
    steps = len(guide)
    guide[:] = 0
    for g in range(len(cumulative) - 1):
        after = math.ceil(cumulative[g] * steps)
        if after < steps:
            guide[after] = g + 1
    largest = guide[0]
    for i in range(steps):
        largest = max(largest, guide[i])
        guide[i] = largest


@loop
def picked(cumulative: Double, guide: Int | Short, pick: float) -> int:
    """The first of which the cumulative probability exceeds ``pick``."""
    last = len(cumulative) - 1
    which = unsigned(guide[unsigned(min(int(pick * len(guide)), len(guide) - 1))])
    while which > 0 and cumulative[unsigned(which - 1)] > pick:
        which = unsigned(which - 1)
    while which < last and cumulative[which] <= pick:
        which = unsigned(which + 1)
    return which


@loop
def way_to(
    triangle: Float, u: float, v: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """From (x, y, z) to barycentric (u, v) of a row of ``LightGroups.triangles``."""
    t = triangle
    return (
        t[_CORNER] + u * t[_EDGE_U] + v * t[_EDGE_V] - x,
        t[_CORNER + 1] + u * t[_EDGE_U + 1] + v * t[_EDGE_V + 1] - y,
        t[_CORNER + 2] + u * t[_EDGE_U + 2] + v * t[_EDGE_V + 2] - z,
    )


@loop
def facing(triangle: Float, x: float, y: float, z: float) -> float:
    """Cosine, times the length of (x, y, z), at which that arrives at a light's triangle."""
    t = triangle
    cosine: float = -(x * t[_NORMAL] + y * t[_NORMAL + 1] + z * t[_NORMAL + 2])
    return cosine


@loop
def _reach(points: Float) -> float:
    """How far each of the weighed points (P, 3) speaks for others: half the diagonal of its share
    of a square with the same mean square distance from the middle."""
    square = 0.0
    for c in range(3):
        values = points[:, c].astype(np.float64)
        square += ((values - values.mean()) ** 2).mean()
    return math.sqrt(square * 6 / (2 * _WEIGHED_AT))


@loop
def _add_importance(
    bounds: Float, power: Float, at: tuple[Float, Float, float], own: Float, weight: Float
) -> None:
    """weight (G,) += importance per power of each group to the point and normal ``at``, scaled so
    that every point weighs as much as the next; ``own`` (G,) is overwritten."""
    x, n, c = at[0], at[1], np.float32(at[2])
    x0, x1, x2, n0, n1, n2 = x[0], x[1], x[2], n[0], n[1], n[2]
    zero = np.float32(0)
    for g in range(len(weight)):
        dx, dy, dz = bounds[0, g] - x0, bounds[1, g] - x1, bounds[2, g] - x2
        r = bounds[6, g]
        square = dx * dx + dy * dy + dz * dz
        received = dx * n0 + dy * n1 + dz * n2 + r
        facing = bounds[7, g] * np.float32(math.sqrt(square)) + r + c
        facing -= dx * bounds[3, g] + dy * bounds[4, g] + dz * bounds[5, g]
        square += r * r + c * c
        own[g] = max(received, zero) * max(facing, zero) / (square * square)
    total = _dot(own, power)
    if total > 0:
        scale = np.float32(1 / total)
        for g in range(len(weight)):
            weight[g] += own[g] * scale


@loop
def _dot(a: Float, b: Float) -> float:
    """Their scalar product, by eight sums side by side: one alone would wait for itself."""
    sums = np.zeros(8, np.float32)
    whole = len(a) - len(a) % 8
    for first in range(0, whole, 8):
        for i in range(8):
            sums[i] += a[first + i] * b[first + i]
    total = 0.0
    for i in range(8):
        total += sums[i]
    for i in range(whole, len(a)):
        total += a[i] * b[i]
    return total
