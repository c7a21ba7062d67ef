"""A composed USD file as a renderer sees it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pxr import Usd, UsdGeom

from usdbrdf.relighting.surfaces import Light, Surface
from usdbrdf.stage.compose import open_stage
from usdbrdf.stage.frames_from_stage import frames_from_stage
from usdbrdf.stage.lights_from_stage import lights_from_stage
from usdbrdf.stage.published_surfaces import published_surfaces


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
