"""Where a camera can stand: free space that can be reached from where cameras stood, with some
clearance; in a room at a person's height, around an object as far away as the cameras were."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from usdbrdf.errors import UsageError
from usdbrdf.model.arrays import Bool, Double, Float, Long
from usdbrdf.transport.rays import RayScene

# Nodes of the grid where clearances allow it, and at all; around a scan that is larger only what
# lies near its cameras is used.
_NODES, _MOST_NODES = 150_000, 4_000_000
_AROUND_M = 6.0
# Triangles with longer edges are divided before it is asked which parts lie near.
_LONGEST_M = 4.0
# Cameras stand in a room where at least so many directions from them meet a surface.
_ENCLOSED = 2 / 3
_DIRECTIONS, _EYES = 64, 32
# How far beside the floor that a person stands on a camera can be held.
_REACH_M = 0.75
# Nobody stands on what is higher than a step above the floor around it: a bed, a large table.
_STEP_M, _FURNITURE_M = 0.4, 2.5
# Around an object: shares of the least and largest distance of the cameras to it.
_NEARER, _FARTHER = 0.8, 1.2


class Places(NamedTuple):
    """M places (M, 3), metres, world; how high each lies above the ground, (M,), NaN where nothing
    is below; and whether they are those of a room."""

    eye: Double
    height: Double
    in_room: bool


def free_places(
    rays: RayScene,
    eyes: Double,
    up: int,
    *,
    heights: tuple[float, float],
    clearance: float,
    count: int,
) -> Places:
    """At most ``count`` places, spread evenly over all where a camera can stand.

    eyes       (N, 3) of the cameras so far, metres, world
    up         axis that points up
    heights    above the ground, metres; of a room
    clearance  to any surface, metres

    Raises UsageError for a clearance so small that too many places would have to be looked at.
    """
    in_room = is_enclosed(rays, eyes)
    low, high = rays.points.min(axis=0).astype(np.float64), rays.points.max(axis=0)
    if not in_room:
        low, high = np.minimum(low, eyes.min(axis=0)), np.maximum(high, eyes.max(axis=0))
    low = np.maximum(low, eyes.min(axis=0) - _AROUND_M)
    high = np.minimum(high, eyes.max(axis=0) + _AROUND_M)
    # Neighbours are nearer to each other than to any surface: nothing stands between them.
    volume = float(np.prod(np.maximum(high - low, clearance)))
    step = float(np.clip(np.cbrt(volume / _NODES), 0.8 * clearance, 1.9 * clearance))
    # A cube root's cube is the number itself only to rounding.
    if volume / step**3 > _MOST_NODES * (1 + 1e-9):
        least = _rounded_up(float(np.cbrt(volume / _MOST_NODES)) / 1.9)
        raise UsageError(
            f"--clearance {clearance:g}: too many places lie so close to each other in "
            f"{volume:,.0f} m^3. Take {least:g} or more. [usage.option]"
        )
    corners = corners_near(
        rays.points[rays.triangles].astype(np.float64), low - 2 * clearance, high + 2 * clearance
    )
    if not len(corners):
        return Places(np.zeros((0, 3)), np.zeros(0), in_room)
    surface = cKDTree(surface_samples(corners, clearance / 3))
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    if not all(shape):
        return Places(np.zeros((0, 3)), np.zeros(0), in_room)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = surface.query(nodes)[0]
    # The samples lie that far apart.
    free = distance >= clearance * (1 + 1 / 6)
    usable = _reached(rays, nodes, free.reshape(shape), eyes, 2 * clearance + 2 * step)
    ground = _ground(rays, nodes, usable, up)
    if in_room:
        lowest = _lowest_around(ground, shape, up, _FURNITURE_M / step)
        ground[ground > lowest + _STEP_M] = np.inf
    height = nodes[:, up] - _lowest_around(ground, shape, up, _REACH_M / step)
    if in_room:
        usable &= (height >= heights[0]) & (height <= heights[1])
    else:
        away = surface.query(eyes)[0]
        usable &= (distance >= _NEARER * away.min()) & (distance <= _FARTHER * away.max())
        usable &= (nodes[:, up] >= eyes[:, up].min()) & (nodes[:, up] <= eyes[:, up].max())
    index = np.flatnonzero(usable)
    index = index[spread(nodes[index], count)]
    return Places(nodes[index], np.where(np.isfinite(height), height, np.nan)[index], in_room)


def corners_near(corners: Double, low: Double, high: Double) -> Double:
    """(F', 3, 3): of triangles (F, 3, 3) what lies in the box from ``low`` to ``high``, or a little
    more: long ones are halved until what lies outside can be left away."""
    near = []
    while len(corners):
        inside = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
        corners = corners[inside.all(axis=1)]
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
        short = edges.max(axis=1, initial=0) <= _LONGEST_M
        near.append(corners[short])
        # Turned so that the longest edge leads from the first corner to the second.
        turn = (edges[~short].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[~short], turn[..., None], axis=1), 1, 0)
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate(halves)
    return np.concatenate([np.zeros((0, 3, 3)), *near])


def surface_samples(corners: Double, spacing: float) -> Double:
    """(S, 3): points on triangles (F, 3, 3), of which one lies within ``spacing`` of every place on
    them."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    parts = np.maximum(np.ceil(edges / spacing).astype(np.int64), 1)
    found = []
    for number in np.unique(parts):
        a, b = np.meshgrid(np.arange(number + 1), np.arange(number + 1))
        inside = a + b <= number
        weights = np.stack([a, b, number - a - b], axis=-1)[inside] / number
        found.append((weights @ corners[parts == number]).reshape(-1, 3))
    every = np.concatenate(found)
    # Neighbouring triangles have corners in common, and small ones lie closer than is needed.
    cell = np.floor(every / (spacing / 4)).astype(np.int64)
    kept: Double = every[np.unique(cell, axis=0, return_index=True)[1]]
    return kept


def _rounded_up(number: float) -> float:
    """To two digits: what is told to be enough is."""
    unit = 10.0 ** (math.floor(math.log10(number)) - 1)
    return math.ceil(number / unit) * unit


def is_enclosed(rays: RayScene, eyes: Double) -> bool:
    """Whether most of what the cameras have around them is surface: they stand in a room."""
    chosen = eyes[np.linspace(0, len(eyes) - 1, min(len(eyes), _EYES)).round().astype(int)]
    around = all_round(_DIRECTIONS)
    origins = np.repeat(chosen, len(around), axis=0).astype(np.float32)
    hits = rays.closest(origins, np.tile(around, (len(chosen), 1)))
    return bool((hits.face >= 0).mean() >= _ENCLOSED)


def all_round(count: int) -> Float:
    """(count, 3) unit directions, evenly over the sphere: Fibonacci's lattice."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1).astype(np.float32)


def spread(points: Double, count: int) -> Long:
    """Numbers of at most ``count`` of points (P, 3), each the farthest from those before; first
    the one nearest to their middle."""
    if len(points) <= count:
        return np.arange(len(points))
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    away = np.full(len(points), np.inf)
    while len(chosen) < count:
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(away.argmax()))
    return np.sort(np.array(chosen))


def _reached(rays: RayScene, nodes: Double, free: Bool, eyes: Double, farthest: float) -> Bool:
    """(nodes,): free, and connected to a free node that a camera sees close by."""
    parts, _ = ndimage.label(free)
    flat = parts.ravel()
    index = np.flatnonzero(flat)
    if not len(index):
        return np.zeros(len(nodes), np.bool_)
    near, which = cKDTree(nodes[index]).query(eyes)
    node = nodes[index[which]]
    way = node - eyes
    hits = rays.closest(eyes.astype(np.float32), way.astype(np.float32))
    clear = (near <= farthest) & ((hits.face < 0) | (hits.distance > 1))
    known = np.unique(flat[index[which[clear]]])
    return np.asarray(np.isin(flat, known[known > 0]), np.bool_)


def _lowest_around(ground: Double, shape: tuple[int, ...], up: int, steps: float) -> Double:
    """(nodes,): the least of ``ground`` (nodes,) up to so many steps of the grid beside each."""
    size = [1 + 2 * round(steps)] * 3
    size[up] = 1
    lowest = ndimage.minimum_filter(ground.reshape(shape), size=size, mode="constant", cval=np.inf)
    return np.asarray(lowest.ravel(), np.float64)


def _ground(rays: RayScene, nodes: Double, usable: Bool, up: int) -> Double:
    """(nodes,): height of the first surface below usable nodes; infinity where there is none."""
    ground = np.full(len(nodes), np.inf)
    index = np.flatnonzero(usable)
    down = np.zeros((len(index), 3), np.float32)
    down[:, up] = -1
    hits = rays.closest(nodes[index].astype(np.float32), down)
    found = nodes[index, up] - hits.distance
    ground[index] = np.where(hits.face >= 0, found, np.inf)
    return ground
