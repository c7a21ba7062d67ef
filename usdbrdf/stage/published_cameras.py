"""Cameras of a stage as pinholes in metres."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from usdbrdf.errors import UsageError
from usdbrdf.relighting.views import View
from usdbrdf.stage.frames_from_stage import capture_camera

_DEFAULT_WIDTH = 1280


def published_camera(stage: Usd.Stage, prim_path: str | None, time: Usd.TimeCode) -> View:
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


def _view(camera: UsdGeom.Camera, time: Usd.TimeCode) -> View:
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
    return View(
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
