"""Which lamps are rectangles, discs or balls, so that lights of that shape can stand for them."""

from __future__ import annotations

import math

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.light import LampShape
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels

# A lamp is replaced by at most so many flat lights (a box has six sides), which together must
# carry this share of its power.
_MAX_PARTS = 6
_COVERED = calibration.number("lamp_shapes.covered")
_SAME_DIRECTION = math.cos(math.radians(calibration.number("lamp_shapes.same_direction")))
_FLAT = calibration.number("lamp_shapes.flat")
_RECTANGLE_FILL = calibration.number("lamp_shapes.rectangle_fill")
_DISK_FILL = calibration.number("lamp_shapes.disk_fill")
_ROUND = calibration.number("lamp_shapes.round")
_SPHERE_FILL = calibration.number("lamp_shapes.sphere_fill")
# Lights lie this share of their size off the lamp's surface, which would shade them otherwise.
_GAP = 1e-3


def lamp_shapes(points: Float, triangles: Int, radiance: Float) -> tuple[LampShape, ...]:
    """Lights in place of a lamp's surface; none where it is neither flat in parts nor round.

    points (V, 3) metres; triangles (F, 3) counter-clockwise seen from outside; radiance (F, 3) mean
    of each. A light's radiance is the area-weighted mean of its part, and its area that of the part
    to within _GAP: what does not fill a rectangle makes it smaller.
    """
    corners = np.asarray(points, np.float64)[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    kept = area > 0
    corners, area, cross = corners[kept], area[kept], cross[kept]
    light = np.asarray(radiance, np.float64)[kept]
    if not len(area) or not light.any():
        return ()
    normals = cross / (2 * area[:, None])
    if sphere := _sphere(corners, normals, area, light):
        return (sphere,)
    # Flat parts, largest first; nothing unless all that matters is a rectangle or a disc.
    power = area * light.sum(axis=1)
    left = np.ones(len(area), np.bool_)
    parts: list[LampShape] = []
    while power[left].sum() > (1 - _COVERED) * power.sum():
        own = _flat_part(corners, normals, power * left)
        part = _flat_shape(corners[own], normals[own], area[own], light[own]) if own.any() else None
        if part is None or len(parts) == _MAX_PARTS:
            return ()
        parts.append(part)
        left &= ~own
    return tuple(parts)


def shapes_of_object(
    scene: Scene, texels: Texels, shines: Float, index: int
) -> tuple[LampShape, ...]:
    """Lights in place of one object, if it has a shape for that; shines (T, 3): emitted radiance,
    W/(m^2 sr)."""
    own, faces = texels.of_object(index), scene.objects[index].faces
    area, face = texels.area[own], texels.face[own] - faces.start
    triangles = scene.triangles[faces]
    weight = np.bincount(face, area, len(triangles))
    power = np.stack([np.bincount(face, area * c, len(triangles)) for c in shines[own].T], axis=1)
    # Faces smaller than a texel may have none: they shine as the lamp does on the whole.
    mean = power.sum(axis=0) / max(weight.sum(), 1e-12)
    radiance = np.where(weight[:, None] > 0, power / np.maximum(weight, 1e-12)[:, None], mean)
    return lamp_shapes(scene.points, triangles, radiance.astype(np.float32))


def _sphere(corners: Double, normals: Double, area: Double, light: Double) -> LampShape | None:
    """Least squares: |p|^2 = 2 p.c + (r^2 - |c|^2) is linear in the centre c."""
    p = corners.reshape(-1, 3)
    origin = p.mean(axis=0)
    q = p - origin
    system = np.column_stack([2 * q, np.ones(len(q))])
    found, _, rank, _ = np.linalg.lstsq(system, (q**2).sum(axis=1), rcond=None)
    squared = found[3] + (found[:3] ** 2).sum()
    if rank < 4 or not squared > 0:
        return None
    radius = math.sqrt(squared)
    distance = np.linalg.norm(q - found[:3], axis=1)
    outward = ((corners.mean(axis=1) - origin - found[:3]) * normals).sum(axis=1) > 0
    if np.abs(distance / radius - 1).max() > _ROUND or not outward.all():
        return None
    if area.sum() < _SPHERE_FILL * 4 * math.pi * radius**2:
        return None
    around = float(distance.max()) * (1 + _GAP)
    # The sphere encloses the lamp: the same power leaves a slightly larger surface.
    mean = (light * area[:, None]).sum(axis=0) / (4 * math.pi * around**2)
    pose = np.eye(4)
    pose[:3, 3] = origin + found[:3]
    return _shape("sphere", np.full(2, 2 * around), pose, mean)


def _flat_part(corners: Double, normals: Double, power: Double) -> Bool:
    """The faces, among those with power, about the direction into which most of it goes."""
    # The axes, then points of a Fibonacci lattice on the sphere, some 8 degrees apart.
    count = 800
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, math.pi * (1 + math.sqrt(5)) * i
    ring = np.sqrt(1 - z**2)
    lattice = np.column_stack([ring * np.cos(turn), ring * np.sin(turn), z])
    directions = np.concatenate([np.eye(3), -np.eye(3), lattice])
    towards = (normals @ directions.T > _SAME_DIRECTION).astype(np.float64)
    normal = directions[np.argmax(power @ towards)]
    own: Bool = (normals @ normal > _SAME_DIRECTION) & (power > 0)
    if not own.any():
        return own
    normal = power[own] @ normals[own]
    normal /= np.linalg.norm(normal)
    own = (normals @ normal > _SAME_DIRECTION) & (power > 0)
    height = corners.mean(axis=1) @ normal
    order = np.flatnonzero(own)[np.argsort(height[own], kind="stable")]
    middle = order[np.searchsorted(np.cumsum(power[order]), power[own].sum() / 2)]
    spread = corners[own].reshape(-1, 3)
    diagonal = float(np.linalg.norm(np.ptp(spread, axis=0)))
    flat: Bool = own & (np.abs(height - height[middle]) <= _FLAT * diagonal)
    return flat


def _flat_shape(corners: Double, normals: Double, area: Double, light: Double) -> LampShape | None:
    """The rectangle or disc that these faces fill, or None."""
    normal = (normals * area[:, None]).sum(axis=0)
    normal /= np.linalg.norm(normal)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(normal, across), normal])  # rows: plane's x and y, normal
    p = corners.reshape(-1, 3) @ frame.T
    mean = (light * area[:, None]).sum(axis=0) / area.sum()
    diagonal = float(np.linalg.norm(np.ptp(p[:, :2], axis=0)))
    if np.ptp(p[:, 2]) > 2 * _FLAT * diagonal:
        return None
    height = float(p[:, 2].max()) + _GAP * diagonal
    from trimesh.bounds import oriented_bounds_2D  # takes a tenth of a second to load

    to_box, extents = oriented_bounds_2D(p[:, :2])
    fill = float(area.sum() / np.prod(extents))
    if fill >= _RECTANGLE_FILL:
        kind, size = "rectangle", extents * math.sqrt(min(fill, 1.0))
        box = np.linalg.inv(to_box)
        centre, along = box[:2, 2], box[:2, 0]
    else:
        kind, size = "disk", np.full(2, 2 * math.sqrt(float(area.sum()) / math.pi))
        weighted = (corners.mean(axis=1) @ frame.T)[:, :2] * area[:, None]
        centre, along = weighted.sum(axis=0) / area.sum(), np.array([1.0, 0])
        farthest = float(np.linalg.norm(p[:, :2] - centre, axis=1).max())
        if area.sum() < _DISK_FILL * math.pi * farthest**2:
            return None
    # The width lies along the part's, the back towards the lamp.
    x, z = along @ frame[:2], -frame[2]
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = np.array([*centre, height]) @ frame
    return _shape(kind, size, pose, mean)


def _shape(kind: str, size: Double, pose: Double, radiance: Double) -> LampShape:
    # Digits beyond these depend on how many threads the linear algebra had.
    r, g, b = (float(f"{value:.6g}") for value in radiance)
    width, length = (round(float(value), 6) for value in size)
    return LampShape(
        kind=kind, size=(width, length), world_from_light=pose.round(6) + 0.0, radiance=(r, g, b)
    )
