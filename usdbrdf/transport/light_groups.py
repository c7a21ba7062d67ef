"""Which lights matter to a patch of texels: groups of bright triangles, weighed patch by patch.

Picking lights by their power alone sends most rays to lamps that are far off or turn their back. A
group's importance to a point is a bound on what it could bring there, were nothing in between:

    power * (n . d + r) * (-m . d + r + c + s |d|) / (|d|^2 + r^2 + c^2)^2

(d from the point to the group's centre, n, m the normals, r the group's radius, s how much its
normals differ; factors below 0 are 0; c how far the point speaks for its neighbours). A patch's
probabilities are the mean of those that some of its texels want and, for a share of picks, follow
power alone: no light is left out. After P. Shirley et al., "Monte Carlo Techniques for Direct
Lighting Calculations", 1996, and A. Conty Estevez and C. Kulla, "Importance Sampling of Many Lights
with Adaptive Tree Splitting", 2018.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Double, Float, Int, Long, Short
from usdbrdf.transport.surface_texture import unsigned

Bytes = npt.NDArray[np.uint8]

_GROUPS = 512

# Steps of a patch's guide per group: picking then seldom has to look further.
_STEPS = 4

# Share of the picks that follow power alone.
_BY_POWER = 0.1

# Texels of a patch that its groups are weighed at.
_WEIGHED_AT = 8

# What the kernels take of LightGroups, in this order: face, cumulative, guide, start, of_face,
# triangles, is_light.
GroupArrays: TypeAlias = tuple[Int, Double, Int, Double, Int, Float, Bytes]


@dataclass(frozen=True, kw_only=True)
class LightGroups:
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
    """

    face: Int
    cumulative: Double
    guide: Int
    start: Double
    of_face: Int
    bounds: Float
    triangles: Float
    is_light: Bytes

    @property
    def arrays(self) -> GroupArrays:
        return (
            self.face, self.cumulative, self.guide, self.start, self.of_face, self.triangles,
            self.is_light,
        )  # fmt: skip


def light_groups(
    face: Int, cumulative: Double, density: Float, of_corners: Float, of_normals: Float
) -> LightGroups:
    """Groups of ``Lights``, split where power times extent is largest."""
    power = np.diff(cumulative, prepend=0)
    corners, normals = of_corners.astype(np.float64), of_normals.astype(np.float64)
    centres = corners.mean(axis=1)
    # Lights that face apart are as good as far apart.
    size = np.linalg.norm(np.ptp(centres, axis=0)) if len(centres) else 0.0
    features = np.concatenate([centres, normals * size / 4], axis=1)
    parts = _split(features, power)
    order = np.concatenate(parts) if parts else np.zeros(0, np.int64)
    cumulative = np.cumsum(power[order])
    ends = np.cumsum([0, *[len(part) for part in parts]])
    of_face = np.full(len(density), -1, np.int32)
    of_face[face[order]] = np.arange(len(order))
    # Several steps per light: picking then seldom has to look further.
    steps = np.linspace(0, 1, 8 * len(order), endpoint=False)
    triangles = np.zeros((len(order), 16), np.float32)
    triangles[:, 0:3] = corners[order, 0]
    triangles[:, 3:6] = corners[order, 1] - corners[order, 0]
    triangles[:, 6:9] = corners[order, 2] - corners[order, 0]
    triangles[:, 9:12] = normals[order]
    triangles[:, 12] = density[face[order]]
    triangles[:, 13] = np.repeat(np.arange(len(parts)), np.diff(ends))
    return LightGroups(
        face=face[order],
        cumulative=cumulative,
        guide=np.searchsorted(cumulative, steps, side="right").astype(np.int32),
        start=np.concatenate([[0.0], cumulative])[ends],
        of_face=of_face,
        bounds=_bounds(parts, power, corners, normals),
        triangles=triangles,
        is_light=np.packbits(density > 0, bitorder="little"),
    )


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
    start: Double, bounds: Float, origin: Float, normal: Float, first_point: Long
) -> tuple[Double, Short, Float]:
    """For Q patches, whose points start at ``first_point`` (Q + 1,): the groups' cumulative
    probabilities (Q, G), guides to these as ``LightGroups.guide`` is one, and how much more likely
    than by power they are, (Q, G)."""
    count, patches = bounds.shape[1], len(first_point) - 1
    cumulative = np.empty((patches, count))
    guide = np.empty((patches, _STEPS * count), np.int16)
    ratio = np.empty((patches, count), np.float32)
    own, weight = np.empty(count, np.float32), np.empty(count, np.float32)
    power = np.diff(start).astype(np.float32)
    for q in range(patches):
        weight[:] = 0
        first, points = first_point[q], first_point[q + 1] - first_point[q]
        reach = _reach(origin[first : first + points])
        for i in range(_WEIGHED_AT):
            # Of whole patches one in each row and each column.
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
    return cumulative, guide, ratio


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
