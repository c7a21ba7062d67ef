"""The captured surface as light transport meets it: triangles, texels on them, rays to them; with
its light, a frame of it, and the surface points under its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.transport.brdf import BECKMANN, CONDUCTOR, DIELECTRIC, PAPER
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lights import BRIGHTER_THAN, Lights, lights_from_radiance
from usdbrdf.transport.rays import Hits, RayScene, lift_from_surface
from usdbrdf.transport.surface_texture import SurfaceTexture, surface_texture


@dataclass(frozen=True)
class TexturedScene:
    """A scene, its texels, and Embree's tree of its triangles: what cameras see; panes, the
    numbers of the objects that light passes through."""

    scene: Scene
    texels: Texels
    rays: RayScene
    panes: tuple[int, ...] = ()

    @property
    def light_rays(self) -> RayScene:
        """What light meets: all but the panes, triangles with the same numbers."""
        if not self.panes:
            return self.rays
        return self.rays.without(self.panes, self.scene.face_object)

    def of_panes(self) -> Bool:
        """(T,): the texel is a pane's."""
        return np.asarray(np.isin(self.texels.object_index(), self.panes), np.bool_)

    def lights_of(
        self, light: Float, outside: Environment | None = None, brighter_than: float = BRIGHTER_THAN
    ) -> Lights:
        """What rays are sent to where surfaces send ``light`` (T, 3), W/(m^2 sr), and panes none:
        rays pass them, and would bring both it and what is behind them."""
        sent = np.where(self.of_panes()[:, None], np.float32(0), light)
        openings = (self.light_rays, outside) if outside else None
        return lights_from_radiance(self.scene, self.texels, sent, brighter_than, openings)

    @cached_property
    def diagonal_m(self) -> float:
        """Of the scene's bounding box, metres."""
        return float(np.linalg.norm(np.ptp(self.scene.points, axis=0)))

    def texture(self, values: Float) -> SurfaceTexture:
        """Per-texel values (T, 3) as a texture that rays can look up."""
        return surface_texture(self.texels, self.scene.face_object, values)

    def owner(self, face: Int) -> Int:
        """The object of each face (R,), -1 where the face is -1."""
        return np.where(face >= 0, self.scene.face_object[face], -1).astype(np.int32)


# Lobes pick among all lights alike, by power: each of the few rays is to meet one that shows.
_BRIGHTER_THAN = 6.0
# So many walls of an object are passed on the way: both of each of a few panes.
_MOST_LAYERS = 8


class SurfacePoints(NamedTuple):
    """What R rays meet: face (R,) int32 (-1: nothing), position, shading normal turned to where the
    ray came from (a camera), and direction there, each (R, 3) float32, the latter two unit."""

    face: Int
    u: Float
    v: Float
    position: Float
    normal: Float
    to_camera: Float

    def take(self, index: npt.NDArray[np.int64]) -> SurfacePoints:
        return SurfacePoints._make(values[index] for values in self)

    @staticmethod
    def joined(parts: Sequence[SurfacePoints]) -> SurfacePoints:
        return SurfacePoints._make(map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True, kw_only=True)
class LitScene(TexturedScene):
    """With its light: L_d as texture and as lights, the emission mask, and the surroundings; and
    the kind of lobe (``brdf``) that its surfaces have, where it is DIELECTRIC but for the objects
    that are ``beckmann`` (num_objects,)."""

    radiance: SurfaceTexture
    lights: Lights
    emission: SurfaceTexture
    environment: Environment
    lobe: int = PAPER
    beckmann: Bool | None = None

    def kinds_of_lobe(self, face: Int, metal: Bool) -> Int:
        """(R,): of the surfaces of triangles (R,), some of them ``metal`` (R,)."""
        kinds = np.full(len(face), self.lobe, np.int32)
        if self.lobe == DIELECTRIC:
            if self.beckmann is not None:
                kinds[self.beckmann[self.scene.face_object[face]]] = BECKMANN
            kinds[metal] = CONDUCTOR
        return kinds

    def emits(self, place: SurfacePoints | Hits) -> Bool:
        """(R,): is there an emitter?"""
        return np.asarray(self.emission.at(place.face, place.u, place.v)[:, 0] > 0.5, np.bool_)


def visible_points(lit: LitScene, camera: Camera, pixels: Double) -> SurfacePoints:
    """The surface under pixel coordinates (R, 2)."""
    return points_of_rays(lit, *camera.rays(pixels))


def points_of_rays(lit: TexturedScene, origins: Float, directions: Float) -> SurfacePoints:
    """The surface that rays (R, 3) meet first, seen from where they come."""
    hits = lit.rays.closest(origins, directions)
    face = np.maximum(hits.face, 0)
    weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=-1)
    normal = np.einsum("rc,rcd->rd", weights, lit.scene.corner_normals[face])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    towards = np.einsum("rd,rd->r", normal, directions) > 0
    position = origins + directions * np.where(hits.face >= 0, hits.distance, 0)[:, None]
    normal = np.where(towards[:, None], -normal, normal).astype(np.float32)
    position = position.astype(np.float32)
    return SurfacePoints(hits.face, hits.u, hits.v, position, normal, -directions)


def past_panes(
    lit: TexturedScene, points: SurfacePoints, shown: Sequence[int] = ()
) -> SurfacePoints:
    """What rays meet that pass panes, with the other points (R,) as they are; ``shown``: numbers of
    panes that count as surfaces where they are met first."""
    passes = (points.face >= 0) & np.isin(lit.owner(points.face), np.setdiff1d(lit.panes, shown))
    if not passes.any():
        return points
    towards = -points.to_camera[passes]
    without = replace(lit, rays=lit.light_rays, panes=())
    behind = points_of_rays(without, points.position[passes], towards)
    found = SurfacePoints._make(values.copy() for values in points)
    for values, some in zip(found, behind, strict=True):
        values[passes] = some
    return found


def hits_behind(surface: TexturedScene, points: SurfacePoints, owner: Int) -> tuple[Bool, Hits]:
    """Which rays (R,) of the points go on past all walls of their objects, ``owner`` (R,), and what
    they meet of others past panes; face -1 where nothing."""
    count = len(points.face)
    direction = np.ascontiguousarray(-points.to_camera, np.float32)
    origin = lift_from_surface(points.position, direction, surface.diagonal_m)
    left, beyond = np.arange(count), np.zeros(count, np.bool_)
    none = np.zeros(count, np.float32)
    found = Hits(np.full(count, -1, np.int32), none, none.copy(), none.copy())
    for _ in range(_MOST_LAYERS):
        if not len(left):
            break
        hits = surface.light_rays.closest(origin, direction[left])
        own = surface.owner(hits.face) == owner[left]
        beyond[left[~own]] = True
        for values, some in zip(found, hits, strict=True):
            values[left[~own]] = some[~own]
        reached = origin[own] + direction[left[own]] * hits.distance[own, None]
        left = left[own]
        origin = lift_from_surface(reached, direction[left], surface.diagonal_m)
    return beyond, found


def hits_in_mirror(surface: TexturedScene, points: SurfacePoints) -> Hits:
    """What a perfect mirror at each of the points (R,) would show to the camera, past panes."""
    along = np.einsum("rd,rd->r", points.normal, points.to_camera)[:, None]
    reflected = np.ascontiguousarray(2 * along * points.normal - points.to_camera, np.float32)
    origin = lift_from_surface(points.position, points.normal, surface.diagonal_m)
    return surface.light_rays.closest(origin, reflected)


def points_of_texels(texels: Texels, index: Long, eye: Double) -> SurfacePoints:
    """Those of texels ``index`` (N,) as seen from ``eye``, (3,) or (N, 3)."""
    position, (_, u, v) = texels.position[index], texels.barycentric[index].T
    to_camera = (eye - position).astype(np.float32)
    to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-12)
    return SurfacePoints(texels.face[index], u, v, position, texels.normal[index], to_camera)


def lit_scene(
    surface: TexturedScene, light: Float, emissive: Bool, environment: Environment
) -> LitScene:
    """The scene with its light (T, 3), W/(m^2 sr): L_d, and where texels are ``emissive`` (T,) the
    radiance with which they shine."""
    radiance = surface.texture(light)
    shines = np.repeat(emissive[:, None].astype(np.float32), 3, axis=1)
    return LitScene(
        scene=surface.scene,
        texels=surface.texels,
        rays=surface.rays,
        panes=surface.panes,
        radiance=radiance,
        lights=surface.lights_of(light, environment, _BRIGHTER_THAN),
        emission=radiance.showing(surface.texels, shines),
        environment=environment,
    )


@dataclass(frozen=True, kw_only=True)
class View:
    """One frame as the fit sees it: radiance (H, W, 3), valid (H, W), and its camera."""

    radiance: Float
    valid: Bool
    camera: Camera


def sub_pixel_points(
    lit: LitScene, camera: Camera, pixels: Double, index: int, offsets: Double
) -> tuple[Bool, SurfacePoints]:
    """Surface points at ``offsets`` (K, 2) in pixels from each of the pixel coordinates (P, 2).

    Returns which pixels have all K on object ``index``, (P,) bool, and their points in order.
    """
    inside = (pixels[:, None] + offsets).reshape(-1, 2)
    points = visible_points(lit, camera, inside)
    whole = (lit.owner(points.face) == index).reshape(-1, len(offsets)).all(axis=1)
    return whole, points.take(np.flatnonzero(np.repeat(whole, len(offsets))))
