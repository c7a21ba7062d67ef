"""A composed USD file as a renderer sees it: surfaces and lights in metres, cameras as pinholes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from usdbrdf.asset.readers.compose import open_stage
from usdbrdf.asset.readers.frames import capture_camera, frames_from_stage
from usdbrdf.asset.readers.lights import lights_from_stage
from usdbrdf.asset.readers.surfaces import published_surfaces
from usdbrdf.errors import UsageError
from usdbrdf.model.camera import Camera
from usdbrdf.model.light import Light
from usdbrdf.model.material import Surface

_DEFAULT_WIDTH = 1280


def published_camera(stage: Usd.Stage, prim_path: str | None, time: Usd.TimeCode) -> Camera:
    """The camera at ``prim_path``, or the capture's where that is None; as many pixels as its
    photographs have, else 1280 across."""
    if prim_path is None:
        camera = capture_camera(stage)
    else:
        prim = stage.GetPrimAtPath(prim_path) if prim_path.startswith("/") else None
        if not prim or not prim.IsA(UsdGeom.Camera):
            known = [str(p.GetPath()) for p in stage.Traverse() if p.IsA(UsdGeom.Camera)]
            raise UsageError(
                f"--camera {prim_path}: the stage has no camera there. It has: "
                f"{', '.join(known) or 'none'}. [relight.camera]"
            )
        camera = UsdGeom.Camera(prim)
    return _view(camera, time)


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


def _view(camera: UsdGeom.Camera, time: Usd.TimeCode) -> Camera:
    prim = camera.GetPrim()
    if camera.GetProjectionAttr().Get(time) != UsdGeom.Tokens.perspective:
        raise UsageError(
            f"--camera {prim.GetPath()}: only perspective cameras are rendered. [relight.camera]"
        )
    names = ("focalLength", "horizontalAperture", "verticalAperture")
    focal, across, upright = (float(prim.GetAttribute(name).Get(time)) for name in names)
    resolution = prim.GetAttribute("usdBrdf:capture:resolution")
    if resolution and resolution.HasValue():
        width, height = (int(value) for value in resolution.Get(time))
    else:
        width = _DEFAULT_WIDTH
        height = max(1, round(width * upright / across))
    offset_x = float(camera.GetHorizontalApertureOffsetAttr().Get(time))
    offset_y = float(camera.GetVerticalApertureOffsetAttr().Get(time))
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


@dataclass(frozen=True, kw_only=True)
class Published:
    """Surfaces and lights in metres, in the world of the stage.

    up_axis          "Y" or "Z"
    metres_per_unit  of the stage, whose units these were
    """

    surfaces: tuple[Surface, ...]
    lights: tuple[Light, ...]
    up_axis: str
    metres_per_unit: float


def published(stage: Usd.Stage, time: Usd.TimeCode, warn: Callable[[str], None]) -> Published:
    """What is visible in a stage at a time; ``warn`` is told, in sentences, what is left out."""
    return Published(
        surfaces=published_surfaces(stage, time, warn),
        lights=lights_from_stage(stage, time, warn),
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        metres_per_unit=float(UsdGeom.GetStageMetersPerUnit(stage)),
    )


def published_file(file: Path, warn: Callable[[str], None]) -> Published:
    """The same of a USD file at its earliest time."""
    return published(open_stage(file.absolute()), Usd.TimeCode.EarliestTime(), warn)


def eye_height(stage: Usd.Stage) -> float:
    """Metres along the up axis of the capture's highest camera: below every ceiling."""
    poses = frames_from_stage(stage).world_from_camera
    return float(poses[:, "XYZ".index(str(UsdGeom.GetStageUpAxis(stage))), 3].max())
