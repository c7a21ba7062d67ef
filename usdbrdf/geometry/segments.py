"""Objects of a mesh without labels: the planes that carry or enclose all else, and what hangs
together once these are taken away.

A plane carries or encloses (a floor, a wall, a table under what is shown on it) if the surface that
grows out of it stands before it. The side of a box does not: what grows out of its edges lies
behind. So nothing is assumed about rooms or which way is up, and all lengths are shares of the
mesh's own: of its edges, and of the planes that it has. Where the colours of a plane differ it is
divided again (``geometry.segment_colours``); what stands on a plane stays whole.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from usdbrdf import calibration
from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.mesh import across_triangles, welded_ids

_PLANE_ANGLE = calibration.number("segments.plane_angle")
_PLANE_DEPTH = calibration.number("segments.plane_depth")
_LEAST_PLANE = calibration.number("segments.least_plane")
_BEHIND = calibration.number("segments.behind")
_LEAST_PART = calibration.number("segments.least_part")
# Noise of a scan, and how round its creases are, in its edges.
_EDGES_DEEP = 3.0
# How often a normal becomes the mean of those around it, which its creases keep apart.
_SMOOTHED, _CREASE = 8, np.cos(np.radians(30))
# How far before and behind a plane, and beside it, is looked at, in its size.
_LOOK, _BESIDE = 0.5, 0.05
# Planes that may be tried, the largest first.
_MOST_PLANES = 128


class Segments(NamedTuple):
    """face (F,) int32: which segment each face belongs to; planes and parts: how many of the
    segments are planes (the first ones) and parts that stand before them (the next ones), either
    by falling area; what is left is one segment more, ``rest``, if any."""

    face: Int
    planes: int
    parts: int


class Links(NamedTuple):
    """Pairs of faces that share an edge: one, other (E,); length (E,) of the edge."""

    one: Long
    other: Long
    length: Double


class _Surface(NamedTuple):
    """centre, normal (F, 3), area (F,) of the faces, and their links."""

    centre: Double
    normal: Double
    area: Double
    links: Links


def segments_of_mesh(points: Float, triangles: Int) -> Segments:
    """Planes and parts of a mesh: points (V, 3), in any unit, and triangles (F, 3), wound so that
    what was seen is their front."""
    surface = _surface(points, triangles)
    noise = _noise(surface)
    plane = _regions(surface, noise)
    kept = _carrying(surface, plane, noise)
    face = np.full(len(triangles), -1, np.int64)
    for number, region in enumerate(kept):
        face[plane == region] = number
    return _with_parts(surface, face, len(kept), noise)


def links_of_faces(points: Float, triangles: Int) -> Links:
    """Of faces whose corners lie at the same places, whatever their winding; of more than two at
    one edge, each with the next."""
    corners = welded_ids(points)[triangles].astype(np.int64)
    start, end = corners.reshape(-1), np.roll(corners, -1, axis=1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    here, there = order[:-1][same], order[1:][same]
    corner = points.astype(np.float64)[triangles]
    lengths = np.linalg.norm(np.roll(corner, -1, axis=1) - corner, axis=2).reshape(-1)
    return Links(here // 3, there // 3, lengths[here])


def parts_of(links: Links, among: Bool) -> Long:
    """(F,) a number for what hangs together of the faces ``among`` (F,); -1 for the others."""
    count = len(among)
    both = among[links.one] & among[links.other]
    ends = links.one[both], links.other[both]
    graph = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(count, count))
    part = connected_components(graph, directed=False)[1].astype(np.int64)
    return np.where(among, part, -1)


def _surface(points: Float, triangles: Int) -> _Surface:
    across = across_triangles(points, triangles)
    area = np.linalg.norm(across, axis=1)
    normal = across / np.where(area > 0, area, 1)[:, None]
    centre = points.astype(np.float64)[triangles].mean(axis=1)
    links = links_of_faces(points, triangles)
    one, other, _ = links
    count = len(area)
    for _ in range(_SMOOTHED):
        alike = (normal[one] * normal[other]).sum(axis=1) > _CREASE
        a, b = one[alike], other[alike]
        total = area[:, None] * normal
        for k in range(3):
            total[:, k] += np.bincount(a, area[b] * normal[b, k], minlength=count)
            total[:, k] += np.bincount(b, area[a] * normal[a, k], minlength=count)
        size = np.linalg.norm(total, axis=1)
        normal = total / np.where(size > 0, size, 1)[:, None]
    return _Surface(centre, normal, area / 2, links)


def _noise(surface: _Surface) -> float:
    """How far a scanned surface may lie off what it is a scan of: some edges of the triangles that
    make up most of it; less where these are as large as things are."""
    order = np.argsort(surface.area, kind="stable")
    total = float(surface.area.sum())
    half = int(np.searchsorted(surface.area[order].cumsum(), total / 2))
    edge = float(np.sqrt(surface.area[order[min(half, len(order) - 1)]] * 4 / 3**0.5))
    return min(_EDGES_DEEP * edge, _PLANE_DEPTH * float(np.sqrt(total)))


def _regions(surface: _Surface, noise: float) -> Long:
    """(F,) flat regions, numbered by their first faces; grown from the flattest face onwards."""
    one, other, _ = surface.links
    count = len(surface.area)
    bend = 1 - (surface.normal[one] * surface.normal[other]).sum(axis=1)
    worst = np.zeros(count)
    np.maximum.at(worst, one, bend)
    np.maximum.at(worst, other, bend)
    seeds = np.argsort(np.round(worst, 4), kind="stable")
    first, neighbour = _neighbours(surface.links, count)
    region = np.full(count, -1, np.int64)
    _grow(
        seeds, first, neighbour, surface.centre, surface.normal, surface.area,
        float(np.cos(np.radians(_PLANE_ANGLE))), noise, region,
    )  # fmt: skip
    return region


def _neighbours(links: Links, count: int) -> tuple[Long, Long]:
    """Of face f the linked ones: neighbour[first[f] : first[f + 1]]."""
    source = np.concatenate([links.one, links.other])
    target = np.concatenate([links.other, links.one])
    order = np.lexsort((target, source))
    first = np.searchsorted(source[order], np.arange(count + 1))
    return first.astype(np.int64), target[order]


@kernel
def _grow(
    seeds: Long, first: Long, neighbour: Long, centre: Double, normal: Double, area: Double,
    cosine: float, least_depth: float, region: Long,
) -> None:  # fmt: skip
    queue = np.empty(len(area), np.int64)
    for s in range(len(seeds)):
        seed = seeds[s]
        if region[seed] >= 0 or area[seed] <= 0:
            continue
        region[seed] = seed
        queue[0], head, tail = seed, 0, 1
        total = area[seed]
        n = area[seed] * normal[seed]
        c = area[seed] * centre[seed]
        while head < tail:
            face = queue[head]
            head += 1
            size = np.sqrt((n * n).sum())
            depth = max(least_depth, _PLANE_DEPTH * np.sqrt(total))
            for k in range(first[face], first[face + 1]):
                other = neighbour[k]
                if region[other] >= 0:
                    continue
                along, off = 0.0, 0.0
                for i in range(3):
                    along += n[i] * normal[other, i]
                    off += n[i] * (centre[other, i] - c[i] / total)
                if along > cosine * size and abs(off) < depth * size:
                    region[other] = seed
                    queue[tail] = other
                    tail += 1
                    total += area[other]
                    for i in range(3):
                        n[i] += area[other] * normal[other, i]
                        c[i] += area[other] * centre[other, i]


def _carrying(surface: _Surface, region: Long, noise: float) -> list[int]:
    """The regions before which stands what grows out of them, the largest first."""
    area = np.bincount(region[region >= 0], surface.area[region >= 0], minlength=len(region))
    order = np.argsort(-area, kind="stable")[:_MOST_PLANES]
    large = order[area[order] >= max(_LEAST_PLANE * area[order[0]], np.finfo(np.float64).tiny)]
    return [number for number in large.tolist() if _carries(surface, region == number, noise)]


def _carries(surface: _Surface, own: Bool, noise: float) -> bool:
    """Whether the surface that grows out of a plane, as far as half its size, stands before it."""
    area = surface.area[own]
    size = float(np.sqrt(area.sum()))
    centre = np.average(surface.centre[own], axis=0, weights=area)
    off = surface.centre - centre
    spread = (area[:, None] * off[own]).T @ off[own]
    axes = np.linalg.eigh(spread)[1]
    normal = axes[:, 0]
    if (area[:, None] * surface.normal[own]).sum(axis=0) @ normal < 0:
        normal = -normal
    before = off @ normal
    beside = off @ axes[:, 1:]
    low, high = beside[own].min(axis=0), beside[own].max(axis=0)
    # Of large faces the centres alone say little about where the plane ends.
    margin = _BESIDE * (high - low) + np.sqrt(2 * area.max())
    near = (np.abs(before) < _LOOK * size) & (beside > low - margin).all(axis=1)
    near &= (beside < high + margin).all(axis=1)
    part = parts_of(surface.links, near | own)
    reached = near & ~own & np.isin(part, np.unique(part[own]))
    thick = max(noise, _PLANE_DEPTH * size)
    front = float(surface.area[reached & (before > thick)].sum())
    back = float(surface.area[reached & (before < -thick)].sum())
    return front > 0 and back <= _BEHIND * (front + back)


def _with_parts(surface: _Surface, face: Long, planes: int, noise: float) -> Segments:
    """The planes' numbers in ``face`` (F,), -1 elsewhere, and the parts between them."""
    links, area = surface.links, surface.area
    in_band = _bands(surface, face, planes, noise)
    part = parts_of(links, (face < 0) & (in_band < 0))
    of_part = np.bincount(part[part >= 0], area[part >= 0], minlength=len(area))
    least = _LEAST_PART * float(area.sum())
    order = np.argsort(-of_part, kind="stable")
    large = order[of_part[order] >= max(least, np.finfo(np.float64).tiny)]
    number = np.full(len(area), -1, np.int64)
    number[large] = planes + np.arange(len(large))
    face = np.where(part >= 0, number[part], face)
    # What stands on a plane begins within the depth of the plane's noise; what lies on it does not.
    flat = np.zeros(len(area), np.bool_)
    for plane in range(planes):
        own = (surface.normal * area[:, None])[face == plane].sum(axis=0)
        alike = surface.normal @ (own / np.linalg.norm(own)) > _CREASE
        flat |= alike & (in_band == plane)
    face = np.where(flat & (face < 0), in_band, face)
    face = flooded(links, face, face >= planes)
    face = np.where((face < 0) & (in_band >= 0), in_band, face)
    face = flooded(links, face, face >= 0)
    rest = face < 0
    parts = len(large)
    if rest.any():
        face = np.where(rest, planes + parts, face)
    return Segments(face.astype(np.int32), planes, parts)


def _bands(surface: _Surface, face: Long, planes: int, noise: float) -> Long:
    """(F,) the plane in whose noise a face lies that belongs to none and hangs together with it;
    -1 where it lies in none."""
    band = np.full(len(face), -1, np.int64)
    for plane in range(planes):
        own = face == plane
        area = surface.area[own]
        centre = np.average(surface.centre[own], axis=0, weights=area)
        off = surface.centre - centre
        axes = np.linalg.eigh((area[:, None] * off[own]).T @ off[own])[1]
        depth = max(noise, _PLANE_DEPTH * float(np.sqrt(area.sum())))
        near = own | ((face < 0) & (band < 0) & (np.abs(off @ axes[:, 0]) < depth))
        part = parts_of(surface.links, near)
        band[near & ~own & np.isin(part, np.unique(part[own]))] = plane
    return band


def flooded(links: Links, face: Long, source: Bool) -> Long:
    """Segments grow from the faces ``source`` over those that have none (-1), step by step, along
    the longest edge; of equals the first segment wins."""
    face = face.copy()
    source = source.copy()
    while True:
        one = np.concatenate([links.one, links.other])
        other = np.concatenate([links.other, links.one])
        length = np.concatenate([links.length, links.length])
        open_ = source[one] & (face[other] < 0)
        if not open_.any():
            return face
        a, b, long = one[open_], other[open_], length[open_]
        order = np.lexsort((face[a], -long, b))
        target, at = np.unique(b[order], return_index=True)
        face[target] = face[a[order][at]]
        source[target] = True
