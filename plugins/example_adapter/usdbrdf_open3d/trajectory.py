"""Open3D's camera trajectory: a JSON document of extrinsics and intrinsics, one per image.

What ``open3d.io.write_pinhole_camera_trajectory`` writes: matrices are lists in column order,
extrinsics are camera from world, with a camera whose x points right, y down and z forward; the
first pixel's centre is at (0, 0).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import InputRefused


@dataclass(frozen=True, kw_only=True)
class Pose:
    """world_from_camera is (4, 4), with OpenGL's camera: y up, looking down -z; intrinsics are fx,
    fy, cx, cy in pixels, the first pixel's centre at (0.5, 0.5); resolution is width, height."""

    world_from_camera: npt.NDArray[np.float64]
    intrinsics: tuple[float, float, float, float]
    resolution: tuple[int, int]


def read_trajectory(path: Path) -> list[Pose]:
    """The cameras of a document, in its order."""
    try:
        document = json.loads(path.read_text("utf-8"))
        parameters = document["parameters"]
        return [_pose(path, number, camera) for number, camera in enumerate(parameters)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputRefused(
            f"{path}: not a camera trajectory of Open3D ({error!r}). Write it again with "
            "open3d.io.write_pinhole_camera_trajectory. [open3d.trajectory]"
        ) from error


def _pose(path: Path, number: int, camera: dict[str, Any]) -> Pose:
    camera_from_world = np.array(camera["extrinsic"], np.float64).reshape(4, 4).T
    inner = camera["intrinsic"]
    matrix = np.array(inner["intrinsic_matrix"], np.float64).reshape(3, 3).T
    if not np.isfinite(camera_from_world).all() or abs(np.linalg.det(camera_from_world)) < 1e-9:
        raise InputRefused(
            f"{path}: the extrinsic of camera {number} has no inverse. Write the trajectory again. "
            "[open3d.trajectory]"
        )
    return Pose(
        world_from_camera=np.linalg.inv(camera_from_world) @ np.diag([1.0, -1.0, -1.0, 1.0]),
        intrinsics=(matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5),
        resolution=(int(inner["width"]), int(inner["height"])),
    )
