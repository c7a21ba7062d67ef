"""Lights, and a scene with surfaces and lights, in metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.material import Surface


@dataclass(frozen=True, kw_only=True)
class LampShape:
    """A light of constant radiance.

    kind              "rectangle" or "disk", which shine along their -z, or "sphere"
    size              width along x and height along y; of the others the diameter, twice
    world_from_light  (4, 4) of column vectors, a rigid motion, metres
    radiance          (3,) linear Rec.709, W/(m^2 sr)
    """

    kind: str
    size: tuple[float, float]
    world_from_light: Double
    radiance: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ShapeLight:
    """A rectangle, disc or sphere that emits the same radiance everywhere.

    kind             "rectangle" ([-1, 1]^2 in x, y), "disk" (unit radius), both with the front
                     towards +z, or "sphere" (unit radius)
    world_from_here  (4, 4) column vectors, metres
    emission         (H, W, 3) radiance; a map lies on a rectangle as on its uv
    """

    kind: str
    world_from_here: Double
    emission: Float

    def moved(self, world_from_here: Double) -> ShapeLight:
        return replace(self, world_from_here=world_from_here @ self.world_from_here)


@dataclass(frozen=True, kw_only=True)
class DistantLight:
    """Parallel light, or that of a disc in the sky.

    towards      (3,) unit vector along which the light travels
    irradiance   (3,) float32 on a surface that faces it
    half_angle   radians, of the disc; 0 is parallel light
    """

    towards: Double
    irradiance: Float
    half_angle: float

    def moved(self, world_from_here: Double) -> DistantLight:
        return replace(self, towards=world_from_here[:3, :3] @ self.towards)


@dataclass(frozen=True, kw_only=True)
class SkyLight:
    """Radiance from infinitely far.

    image            (H, W, 3) latitude-longitude: the top row is +y, the middle column +z
    world_from_here  (3, 3) rotation
    """

    image: Float
    world_from_here: Double

    def moved(self, world_from_here: Double) -> SkyLight:
        return replace(self, world_from_here=world_from_here[:3, :3] @ self.world_from_here)


Light = ShapeLight | DistantLight | SkyLight


@dataclass(frozen=True, kw_only=True)
class RelitScene:
    surfaces: tuple[Surface, ...]
    lights: tuple[Light, ...]
