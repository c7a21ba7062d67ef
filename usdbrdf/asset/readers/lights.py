"""The UsdLux lights of a stage, as radiance and irradiance in metres.

UsdLux: the emission of a light is intensity * 2^exposure * colour (* that of its temperature).
It is the radiance of a light with an area, or, where the light is normalised, that radiance times
the area in the world: of a disc in the sky the area is pi sin^2 of half its angle, so that the
emission of a normalised distant light is the irradiance that it gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from pxr import Usd, UsdGeom, UsdLux

from usdbrdf.asset.readers.frames import asset_file
from usdbrdf.asset.readers.materials import read_texture
from usdbrdf.asset.readers.surfaces import metres_from_units
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.light import DistantLight, Light, ShapeLight, SkyLight
from usdbrdf.model.material import constant_map

_SHAPES = ("RectLight", "DiskLight", "SphereLight")

_DOMES = ("DomeLight", "DomeLight_1")


def lights_from_stage(
    stage: Usd.Stage, time: Usd.TimeCode, warn: Callable[[str], None]
) -> tuple[Light, ...]:
    """All active, visible lights that emit.

    warn  is told, in sentences, what was left out
    """
    lights: list[Light] = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        kind = str(prim.GetTypeName())
        # A light's own geometry (MeshLightAPI) glows by its material and is a surface.
        if not prim.HasAPI(UsdLux.LightAPI) or prim.IsA(UsdGeom.Mesh):
            continue
        if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        if kind not in (*_SHAPES, *_DOMES, "DistantLight"):
            warn(f"<{prim.GetPath()}>: a {kind} is not rendered.")
            continue
        if prim.HasAPI(UsdLux.ShapingAPI):
            warn(f"<{prim.GetPath()}>: the shaping of the light is not rendered.")
        emission = _emission(prim, time)
        if not emission.any():
            continue
        world_from_light = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time)).T
        if kind == "DistantLight":
            lights.append(_distant(prim, emission, world_from_light, time))
        elif kind in _DOMES:
            lights.append(_dome(prim, emission, world_from_light, time))
        else:
            lights.append(_shape(prim, kind, emission, world_from_light, time))
    return tuple(lights)


def sky_of_picture(picture: Float, up_axis: str) -> SkyLight:
    """A latitude-longitude picture (H, W, 3) about the stage's up axis, as ``shade --environment``
    has it: in a world with z up it is the y-up one turned by 90 degrees about x. What is not
    finite or negative is black."""
    turned = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    image = np.maximum(np.nan_to_num(picture, nan=0.0, posinf=0.0, neginf=0.0), 0)
    return SkyLight(image=image, world_from_here=turned if up_axis == "Z" else np.eye(3))


def up_axis(stage: Usd.Stage) -> str:
    """ "Y" or "Z"."""
    return str(UsdGeom.GetStageUpAxis(stage))


def _emission(prim: Usd.Prim, time: Usd.TimeCode) -> Float:
    """(3,) colour * intensity * 2^exposure, with the colour temperature."""
    light = UsdLux.LightAPI(prim)
    colour = np.array(light.GetColorAttr().Get(time) or (1, 1, 1), np.float32)
    if light.GetEnableColorTemperatureAttr().Get(time):
        kelvin = light.GetColorTemperatureAttr().Get(time)
        colour = colour * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin), np.float32)
    scale = light.GetIntensityAttr().Get(time) * 2.0 ** light.GetExposureAttr().Get(time)
    return np.asarray(np.maximum(colour * scale, 0), np.float32)


def _normalised(prim: Usd.Prim, time: Usd.TimeCode) -> bool:
    return bool(UsdLux.LightAPI(prim).GetNormalizeAttr().Get(time))


def _shape(
    prim: Usd.Prim, kind: str, emission: Float, world_from_light: Double, time: Usd.TimeCode
) -> ShapeLight:
    if kind == "RectLight":
        width, height = (prim.GetAttribute(f"inputs:{n}").Get(time) for n in ("width", "height"))
        name, size = "rectangle", (width / 2, height / 2, 1.0)
    else:
        radius = prim.GetAttribute("inputs:radius").Get(time)
        name, size = ("sphere" if kind == "SphereLight" else "disk"), (radius,) * 3
    world_from_shape = world_from_light @ np.diag([*size, 1.0])
    if _normalised(prim, time):
        emission = emission / np.float32(_area(name, world_from_shape))
    # UsdLux emits towards -z; turned about y, so that a rectangle keeps its up direction.
    world_from_shape = world_from_shape @ np.diag([-1.0, 1, -1, 1])
    image = constant_map(*emission)
    texture = (
        asset_file(prim.GetAttribute("inputs:texture:file"), time) if name == "rectangle" else None
    )
    if texture is not None:
        image = np.asarray(read_texture(texture, "auto") * emission, np.float32)
    metres = metres_from_units(prim.GetStage())
    return ShapeLight(kind=name, world_from_here=metres @ world_from_shape, emission=image)


def _area(kind: str, world_from_shape: Double) -> float:
    """Area in square units of the stage, as UsdLux divides by."""
    x, y, z = (np.linalg.norm(column) for column in world_from_shape[:3, :3].T)
    if kind == "rectangle":
        return float(4 * x * y)
    return float(math.pi * x * y if kind == "disk" else 4 * math.pi * (x * y * z) ** (2 / 3))


def _distant(
    prim: Usd.Prim, emission: Float, world_from_light: Double, time: Usd.TimeCode
) -> DistantLight:
    half_angle = math.radians(UsdLux.DistantLight(prim).GetAngleAttr().Get(time)) / 2
    size = math.pi * math.sin(half_angle) ** 2
    if size > 0 and not _normalised(prim, time):
        emission = emission * np.float32(size)
    towards = world_from_light[:3, :3] @ np.array([0.0, 0, -1])
    return DistantLight(
        towards=towards / np.linalg.norm(towards), irradiance=emission, half_angle=half_angle
    )


def _dome(
    prim: Usd.Prim, emission: Float, world_from_light: Double, time: Usd.TimeCode
) -> SkyLight:
    rotation = world_from_light[:3, :3] / np.linalg.norm(world_from_light[:3, :3], axis=0)
    pole = prim.GetAttribute("poleAxis")
    if pole and (pole.Get() == "Z" or (pole.Get() == "scene" and up_axis(prim.GetStage()) == "Z")):
        rotation = rotation @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    image = constant_map(*emission)
    texture = asset_file(prim.GetAttribute("inputs:texture:file"), time)
    if texture is not None:
        image = np.asarray(np.maximum(read_texture(texture, "auto"), 0) * emission, np.float32)
    return SkyLight(image=image, world_from_here=rotation)
