"""What cameras see of points on the surface, as texels are sampled: facing the camera, and all of
the pixels around them on their own object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.samples import MIN_COSINE
from usdbrdf.transport.lit_scene import SurfacePoints, TexturedScene

# Pixels around a point that must show its own object, and that it is away from the picture's rim.
_MARGIN_PX, _RIM_PX = 1.5, 3.0
# How far what a pixel shows may be off the point's tangent plane, in pixels.
_OFF_PLANE_PX = 2.0


@dataclass(frozen=True, kw_only=True)
class Spots:
    """N points of the surface: texel (N,) of each, its object (N,), and what light transport needs
    of it: face (N,), position, shading and geometric normal (N, 3)."""

    texel: Long
    owner: Int
    face: Int
    position: Float
    normal: Float
    geometric_normal: Float

    @classmethod
    def of(cls, texels: Texels, index: Long) -> Spots:
        own = texels.take(index)
        owner = texels.object_index()[index]
        return cls(
            texel=index, owner=owner, face=own.face, position=own.position, normal=own.normal,
            geometric_normal=own.geometric_normal,
        )  # fmt: skip

    def towards(self, which: Long, eyes: Double) -> SurfacePoints:
        """Those of some numbers (R,), as cameras at eyes (R, 3) or (3,) see them."""
        position = self.position[which]
        way = (eyes - position).astype(np.float32)
        way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
        normal = self.normal[which]
        away = np.einsum("rd,rd->r", normal, way) < 0
        normal = np.where(away[:, None], -normal, normal).astype(np.float32)
        none = np.zeros(len(which), np.float32)
        return SurfacePoints(self.face[which], none, none, position, normal, way)


def visible_spots(surface: TexturedScene, spots: Spots, eye: Double, focal: float) -> Long:
    """Numbers of the spots that a camera at ``eye`` (3,) with ``focal`` (pixels) samples, wherever
    it looks."""
    way = spots.position - eye
    distance = np.linalg.norm(way, axis=1)
    way /= np.maximum(distance, 1e-9)[:, None]
    facing = -np.einsum("nd,nd->n", spots.geometric_normal, way)
    index = np.flatnonzero((facing > MIN_COSINE) & (distance > 0))
    ahead, far = way[index], distance[index]
    smallest = np.eye(3)[np.abs(ahead).argmin(axis=1)]
    across = np.cross(smallest, ahead)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upright = np.cross(ahead, across)
    margin = _MARGIN_PX / focal
    offsets = [np.zeros_like(ahead), *(s * margin * a for a in (across, upright) for s in (1, -1))]
    directions = np.concatenate([ahead + offset for offset in offsets]).astype(np.float32)
    origins = np.broadcast_to(eye, directions.shape).astype(np.float32)
    hits = surface.rays.closest(np.ascontiguousarray(origins), directions)
    reached = origins + directions * hits.distance[:, None]
    sides, repeated = len(offsets), np.tile(index, len(offsets))
    off = np.einsum(
        "rd,rd->r", reached - spots.position[repeated], spots.geometric_normal[repeated]
    )
    shown = surface.owner(hits.face) == spots.owner[repeated]
    shown &= np.abs(off) <= _OFF_PLANE_PX / focal * np.tile(far, sides)
    seen: Long = index[shown.reshape(sides, -1).all(axis=0)]
    return seen


def in_pictures(camera: Camera, eye: Double, turns: Double, position: Float) -> Bool:
    """(L, N): whether points (N, 3) lie before the camera and clearly within its picture, were it
    at ``eye`` and turned (L, 3, 3), world from camera."""
    way = (position - eye).astype(np.float32)
    x, y, z = (way @ axis.T.astype(np.float32) for axis in np.moveaxis(turns, 2, 0))
    fx, fy, cx, cy = camera.intrinsics
    depth = np.maximum(-z, np.float32(1e-9))
    u, v = cx + fx * x / depth, cy - fy * y / depth
    inside = (z < 0) & (u > _RIM_PX) & (u < camera.width - _RIM_PX)
    return np.asarray((inside & (v > _RIM_PX) & (v < camera.height - _RIM_PX)).T, np.bool_)
