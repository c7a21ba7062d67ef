"""A composed USD file as a renderer sees it: surfaces and lights in metres, cameras as pinholes.

UsdLux: the emission of a light is intensity * 2^exposure * colour (* that of its temperature).
It is the radiance of a light with an area, or, where the light is normalised, that radiance times
the area in the world: of a disc in the sky the area is pi sin^2 of half its angle, so that the
emission of a normalised distant light is the irradiance that it gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Usd, UsdGeom, UsdLux

from usdbrdf.asset.readers.compose import open_stage
from usdbrdf.asset.readers.scene import LENS, asset_file, capture_camera, frames_from_stage
from usdbrdf.asset.readers.surfaces import metres_from_units, read_texture, surfaces_from_stage
from usdbrdf.errors import UsageError
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import DistantLight, Light, ShapeLight, SkyLight
from usdbrdf.model.material import Surface, constant_map, turned_up

_DEFAULT_WIDTH = 1280


@dataclass(frozen=True, kw_only=True)
class RenderScene:
    """Surfaces and lights in metres, in the world of the stage."""

    surfaces: tuple[Surface, ...]
    lights: tuple[Light, ...]
    up_axis: str  # "Y" or "Z"
    metres_per_unit: float  # of the stage, whose units these were


def render_scene_from_stage(
    stage: Usd.Stage, time: Usd.TimeCode, warn: Callable[[str], None]
) -> RenderScene:
    """What is visible in a stage at a time; ``warn`` is told, in sentences, what is left out."""
    return RenderScene(
        surfaces=surfaces_from_stage(stage, time, warn),
        lights=_lights_from_stage(stage, time, warn),
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        metres_per_unit=metres_per_unit(stage),
    )


def metres_per_unit(stage: Usd.Stage) -> float:
    return float(UsdGeom.GetStageMetersPerUnit(stage))


def render_scene_from_file(file: Path, warn: Callable[[str], None]) -> RenderScene:
    """The same of a USD file at its earliest time."""
    return render_scene_from_stage(open_stage(file.absolute()), Usd.TimeCode.EarliestTime(), warn)


def view_from_stage(stage: Usd.Stage, prim_path: str | None, time: Usd.TimeCode) -> Camera:
    """The camera at ``prim_path``, or the capture's where that is None; as many pixels as its
    photographs have, else 1280 across."""
    if prim_path is None:
        prim = capture_camera(stage).GetPrim()
    else:
        prim = stage.GetPrimAtPath(prim_path) if prim_path.startswith("/") else None
        if not prim or not prim.IsA(UsdGeom.Camera):
            known = [str(p.GetPath()) for p in stage.Traverse() if p.IsA(UsdGeom.Camera)]
            raise UsageError(
                f"--camera {prim_path}: the stage has no camera there. It has: "
                f"{', '.join(known) or 'none'}. [relight.camera]"
            )
    camera = UsdGeom.Camera(prim)
    if camera.GetProjectionAttr().Get(time) != UsdGeom.Tokens.perspective:
        raise UsageError(
            f"--camera {prim.GetPath()}: only perspective cameras are rendered. [relight.camera]"
        )
    focal, across, upright, offset_x, offset_y = (
        float(prim.GetAttribute(name).Get(time)) for name in LENS
    )
    resolution = prim.GetAttribute("usdBrdf:capture:resolution")
    if resolution and resolution.HasValue():
        width, height = (int(value) for value in resolution.Get(time))
    else:
        width = _DEFAULT_WIDTH
        height = max(1, round(width * upright / across))
    # Row vectors in USD: transposed they are ours. A camera's scale is no part of its pose.
    pose = np.array(camera.ComputeLocalToWorldTransform(time)).T
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    pose[:3, 3] *= UsdGeom.GetStageMetersPerUnit(prim.GetStage())
    return Camera(
        name=str(prim.GetName()),
        world_from_camera=pose,
        intrinsics=(
            focal * width / across,
            focal * height / upright,
            width / 2 - offset_x * width / across,
            height / 2 + offset_y * height / upright,
        ),
        width=width,
        height=height,
    )


def time_code(stage: Usd.Stage, frame: float | None) -> Usd.TimeCode:
    """The time code of a frame that lies in the stage's range; None is the earliest time."""
    if frame is None:
        return Usd.TimeCode.EarliestTime()
    first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if not first <= frame <= last:
        raise UsageError(
            f"--frame {frame:g}: the stage has the frames {first:g} to {last:g}. [relight.frame]"
        )
    return Usd.TimeCode(frame)


def eye_height(stage: Usd.Stage) -> float:
    """Metres along the up axis of the capture's highest camera: below every ceiling."""
    poses = frames_from_stage(stage).world_from_camera
    return float(poses[:, "XYZ".index(str(UsdGeom.GetStageUpAxis(stage))), 3].max())


def _lights_from_stage(
    stage: Usd.Stage, time: Usd.TimeCode, warn: Callable[[str], None]
) -> tuple[Light, ...]:
    """All active, visible lights that emit."""
    lights: list[Light] = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        kind = str(prim.GetTypeName())
        # A light's own geometry (MeshLightAPI) glows by its material and is a surface.
        if not prim.HasAPI(UsdLux.LightAPI) or prim.IsA(UsdGeom.Mesh):
            continue
        if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        if kind not in _READERS:
            warn(f"<{prim.GetPath()}>: a {kind} is not rendered.")
            continue
        if prim.HasAPI(UsdLux.ShapingAPI):
            warn(f"<{prim.GetPath()}>: the shaping of the light is not rendered.")
        light = UsdLux.LightAPI(prim)
        colour = np.array(light.GetColorAttr().Get(time) or (1, 1, 1), np.float32)
        if light.GetEnableColorTemperatureAttr().Get(time):
            kelvin = light.GetColorTemperatureAttr().Get(time)
            colour = colour * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin), np.float32)
        scale = light.GetIntensityAttr().Get(time) * 2.0 ** light.GetExposureAttr().Get(time)
        emission = np.asarray(np.maximum(colour * scale, 0), np.float32)
        if emission.any():
            world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time)
            lights.append(_READERS[kind](_Source(prim, time, emission, np.array(world).T)))
    return tuple(lights)


def sky_of_picture(picture: Float, up_axis: str) -> SkyLight:
    """A latitude-longitude picture (H, W, 3) about the stage's up axis, as ``shade --environment``
    has it: in a world with z up it is the y-up one turned by 90 degrees about x. What is not
    finite or negative is black."""
    image = np.maximum(np.nan_to_num(picture, nan=0.0, posinf=0.0, neginf=0.0), 0)
    return SkyLight(image=image, world_from_here=turned_up("Y", up_axis)[:3, :3])


class _Source(NamedTuple):
    """A light of the stage: emission (3,), world_from_light (4, 4) of column vectors."""

    prim: Usd.Prim
    time: Usd.TimeCode
    emission: Float
    world_from_light: Double

    def value(self, name: str) -> Any:
        return self.prim.GetAttribute(f"inputs:{name}").Get(self.time)

    def picture(self) -> Float:
        """(H, W, 3) radiance: the texture times the emission, or the emission alone."""
        file = asset_file(self.prim.GetAttribute("inputs:texture:file"), self.time)
        if file is None:
            return constant_map(*self.emission)
        return np.asarray(read_texture(file, "auto") * self.emission, np.float32)


def _shape(source: _Source) -> ShapeLight:
    kind, emission = _SHAPES[str(source.prim.GetTypeName())], source.emission
    if kind == "rectangle":
        size = (source.value("width") / 2, source.value("height") / 2, 1.0)
    else:
        size = (source.value("radius"),) * 3
    world_from_shape = source.world_from_light @ np.diag([*size, 1.0])
    if source.value("normalize"):
        # By the area in square units of the stage, as UsdLux divides.
        x, y, z = (np.linalg.norm(column) for column in world_from_shape[:3, :3].T)
        ball = 4 * math.pi * (x * y * z) ** (2 / 3)
        area = {"rectangle": 4 * x * y, "disk": math.pi * x * y, "sphere": ball}[kind]
        emission = emission / np.float32(area)
    # UsdLux emits towards -z; turned about y, so that a rectangle keeps its up direction.
    world_from_shape = world_from_shape @ np.diag([-1.0, 1, -1, 1])
    lit = source._replace(emission=emission)
    image = lit.picture() if kind == "rectangle" else constant_map(*emission)
    metres = metres_from_units(source.prim.GetStage())
    return ShapeLight(kind=kind, world_from_here=metres @ world_from_shape, emission=image)


def _distant(source: _Source) -> DistantLight:
    half_angle, emission = math.radians(source.value("angle")) / 2, source.emission
    size = math.pi * math.sin(half_angle) ** 2
    if size > 0 and not source.value("normalize"):
        emission = emission * np.float32(size)
    towards = source.world_from_light[:3, :3] @ np.array([0.0, 0, -1])
    return DistantLight(
        towards=towards / np.linalg.norm(towards), irradiance=emission, half_angle=half_angle
    )


def _dome(source: _Source) -> SkyLight:
    rotation = source.world_from_light[:3, :3]
    rotation = rotation / np.linalg.norm(rotation, axis=0)
    pole = source.prim.GetAttribute("poleAxis")
    up = UsdGeom.GetStageUpAxis(source.prim.GetStage())
    if pole and (up if pole.Get() == "scene" else pole.Get()) == UsdGeom.Tokens.z:
        rotation = rotation @ turned_up("Y", "Z")[:3, :3]
    return SkyLight(image=np.maximum(source.picture(), 0), world_from_here=rotation)


_SHAPES = {"RectLight": "rectangle", "DiskLight": "disk", "SphereLight": "sphere"}
_READERS: dict[str, Callable[[_Source], Light]] = {
    **dict.fromkeys(_SHAPES, _shape),
    **dict.fromkeys(("DomeLight", "DomeLight_1"), _dome),
    "DistantLight": _distant,
}
