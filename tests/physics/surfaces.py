"""Scenes of parallelograms with hand-made atlases, for which light transport has exact answers.

Every quad is an object with an atlas of its own, covered completely: no gutters, no charts, so
that nothing but the physics can go wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.model.texels import Texels
from usdbrdf.options import Sampling
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.irradiance import Irradiance, irradiance_at
from usdbrdf.transport.lights import Lights, lights_from_radiance
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import SurfaceTexture, surface_texture
from usdbrdf.transport.tile_draws import independent_tiles

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Vector = Sequence[float]


@dataclass(frozen=True, kw_only=True)
class Part:
    """One object: points (V, 3), triangles (F, 3), corner uv (F, 3, 2), corner normals (F, 3, 3),
    atlas size."""

    points: Double
    triangles: npt.NDArray[np.int32]
    uv: Double
    normals: Double
    size: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class World:
    scene: Scene
    texels: Texels

    @cached_property
    def rays(self) -> RayScene:
        return RayScene(self.scene.points, self.scene.triangles)

    @cached_property
    def size(self) -> float:
        return float(np.linalg.norm(np.ptp(self.scene.points, axis=0)))

    def per_object(self, radiance: Sequence[Vector]) -> Float:
        """(T, 3): one constant radiance per object."""
        return np.asarray(radiance, np.float32)[self.texels.object_index()]

    def texture(self, values: Float) -> SurfaceTexture:
        return surface_texture(self.texels, self.scene.face_object, values)

    def lit(
        self,
        radiance: Float,
        *,
        bright: Float | None = None,
        emission: Float | None = None,
        environment: Environment | None = None,
    ) -> LitScene:
        """With L_d (T, 3); ``bright`` (T, 3) is what lights are picked by, else L_d."""
        return LitScene(
            scene=self.scene,
            texels=self.texels,
            rays=self.rays,
            radiance=self.texture(radiance),
            lights=self.lights(radiance if bright is None else bright),
            emission=self.texture(0 * radiance if emission is None else emission),
            environment=environment or black_environment(),
        )

    def lights(self, radiance: Float) -> Lights:
        return lights_from_radiance(self.scene, self.texels, radiance)


def world_of(parts: Sequence[Part]) -> World:
    first_point = np.cumsum([0, *[len(p.points) for p in parts]])
    first_face = np.cumsum([0, *[len(p.triangles) for p in parts]])
    objects = tuple(
        SceneObject(
            prim_path=f"/x/geo/part_{i}",
            identifier=f"part_{i}",
            label=f"part_{i}",
            class_name="",
            first_face=int(first_face[i]),
            num_faces=len(part.triangles),
        )
        for i, part in enumerate(parts)
    )
    scene = Scene(
        objects=objects,
        points=np.concatenate([p.points for p in parts]).astype(np.float32),
        triangles=np.concatenate(
            [p.triangles + first_point[i] for i, p in enumerate(parts)]
        ).astype(np.int32),
        corner_normals=np.concatenate([p.normals for p in parts]).astype(np.float32),
        face_object=np.repeat(
            np.arange(len(parts), dtype=np.int32), [len(p.triangles) for p in parts]
        ),
        corner_uv=np.concatenate([p.uv for p in parts]).astype(np.float32),
    )
    resolution = np.array([p.size for p in parts], np.int32)
    return World(scene=scene, texels=texels_from_atlas(scene, resolution))


def quad(origin: Vector, u: Vector, v: Vector, size: tuple[int, int] = (8, 8)) -> Part:
    """The parallelogram origin + [0, 1] u + [0, 1] v, seen from the side of u x v; the texture's
    columns run along u, its rows against v."""
    o, a, b = (np.asarray(x, np.float64) for x in (origin, u, v))
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    return Part(
        points=np.array([o, o + a, o + a + b, o + b]),
        triangles=triangles,
        uv=uv[triangles],
        normals=np.broadcast_to(normal, (2, 3, 3)),
        size=size,
    )


def room(low: Vector, high: Vector, size: tuple[int, int] = (8, 8)) -> list[Part]:
    """Six quads that look inward: floor, ceiling, and the walls at y low, y high, x low, x high."""
    (x, y, z), (a, b, c) = low, np.subtract(high, low)
    return [
        quad((x, y, z), (a, 0, 0), (0, b, 0), size),
        quad((x, y, z + c), (0, b, 0), (a, 0, 0), size),
        quad((x, y, z), (0, 0, c), (a, 0, 0), size),
        quad((x, y + b, z), (a, 0, 0), (0, 0, c), size),
        quad((x, y, z), (0, b, 0), (0, 0, c), size),
        quad((x + a, y, z), (0, 0, c), (0, b, 0), size),
    ]


def box(low: Vector, high: Vector, size: tuple[int, int] = (4, 4)) -> list[Part]:
    """The same six quads seen from outside."""
    return [
        quad(part.points[0], part.points[3] - part.points[0], part.points[1] - part.points[0], size)
        for part in room(low, high)
    ]


def disc(centre: Vector, radius: float, normal_z: int, segments: int = 512) -> Part:
    """A horizontal regular polygon of the same area as the disc, looking up (+1) or down (-1)."""
    # area of the polygon with circumradius r: segments / 2 sin(2 pi / segments) r^2
    step = 2 * np.pi / segments
    rim = radius * np.sqrt(step / np.sin(step))
    angle = np.arange(segments) * step
    ring = np.stack([np.cos(angle), np.sin(angle) * normal_z, 0 * angle], axis=-1)
    points = np.asarray(centre) + rim * np.concatenate([[[0, 0, 0]], ring])
    k = np.arange(segments)
    triangles = np.stack([0 * k, k + 1, (k + 1) % segments + 1], axis=-1).astype(np.int32)
    uv = 0.5 + 0.5 * np.concatenate([[[0, 0]], ring[:, :2]])
    normals = np.broadcast_to([0.0, 0.0, float(normal_z)], (segments, 3, 3))
    return Part(
        points=points, triangles=triangles, uv=uv[triangles], normals=normals, size=(64, 64)
    )


def sphere(centre: Vector, radius: float, rows: int, columns: int, size: tuple[int, int]) -> Part:
    """A latitude-longitude sphere with the exact normals at its vertices."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, azimuth = np.pi * (1 - v.ravel()), 2 * np.pi * u.ravel()
    radial = np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )
    i, j = (a.ravel() for a in np.mgrid[0:rows, 0:columns])
    a = i * (columns + 1) + j
    b = a + columns + 1
    # At the poles one of the two triangles has no area.
    triangles = np.concatenate(
        [
            np.stack([a, a + 1, b + 1], axis=-1)[i > 0],
            np.stack([a, b + 1, b], axis=-1)[i < rows - 1],
        ]
    ).astype(np.int32)
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    return Part(
        points=np.asarray(centre) + radius * radial,
        triangles=triangles,
        uv=uv[triangles],
        normals=radial[triangles],
        size=size,
    )


def estimates(
    world: World,
    lit: Float,
    lights: Lights,
    points: Double,
    normals: Double,
    *,
    estimator: str,
    rays: int,
    repeat: int,
    seed: int = 0,
    environment: Environment | None = None,
) -> tuple[Double, Irradiance]:
    """S at points (N, 3), each ``repeat`` times with random numbers of its own: (repeat, N, 3).

    Every repetition is a tile of its own, and independent of the others.
    """
    count = len(points)
    found = irradiance_at(
        world.rays,
        world.texture(lit),
        lights,
        environment or black_environment(),
        np.tile(np.asarray(points, np.float32), (repeat, 1)),
        np.tile(np.asarray(normals, np.float32), (repeat, 1)),
        independent_tiles(count * repeat),
        Sampling(estimator=estimator, standard_error=0.0, max_rays=rays, seed=seed),  # type: ignore[arg-type]
        world.size,
    )
    return found.mean.reshape(repeat, count, 3).astype(np.float64), found
