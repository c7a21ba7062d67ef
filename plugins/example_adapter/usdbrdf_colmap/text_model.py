"""COLMAP's text model: cameras.txt and images.txt.

The format is described at https://colmap.github.io/format.html. COLMAP's poses are camera from
world, with a camera whose x points right, y down and z forward; its first pixel's centre is at
(0.5, 0.5), as in usdbrdf.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import InputRefused

# Model -> (focal lengths, distortion coefficients); between them stand cx and cy.
_MODELS = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "FULL_OPENCV": (2, 8),
}


@dataclass(frozen=True, kw_only=True)
class Camera:
    """intrinsics are fx, fy, cx, cy in pixels; resolution is width, height."""

    resolution: tuple[int, int]
    intrinsics: tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Image:
    """world_from_camera is (4, 4), with OpenGL's camera: y up, looking down -z."""

    name: str
    camera_id: int
    world_from_camera: npt.NDArray[np.float64]


def read_cameras(path: Path) -> dict[int, Camera]:
    """CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; refuses lenses that are not pinholes."""
    cameras = {}
    for number, line in _lines(path):
        if not line:
            continue
        try:
            identifier, model, width, height, *rest = line.split()
            parameters = [float(word) for word in rest]
            resolution = (int(width), int(height))
            camera_id = int(identifier)
        except ValueError as error:
            raise _malformed(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from error
        intrinsics = _intrinsics(path, number, model, parameters)
        cameras[camera_id] = Camera(resolution=resolution, intrinsics=intrinsics)
    return cameras


def read_images(path: Path, cameras: dict[int, Camera]) -> list[Image]:
    """IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; every second line lists points, maybe none."""
    images = []
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            _, *pose, camera, name = line.split(maxsplit=9)
            camera_id = int(camera)
            quaternion, translation = np.array(pose[:4], float), np.array(pose[4:], float)
        except ValueError as error:
            raise _malformed(
                path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            ) from error
        if camera_id not in cameras:
            raise InputRefused(
                f"{path}: line {number} names camera {camera_id}, which cameras.txt does not "
                "have. Export both files from one model. [colmap.camera]"
            )
        world_from_camera = _world_from_camera(path, number, quaternion, translation)
        images.append(Image(name=name, camera_id=camera_id, world_from_camera=world_from_camera))
        next(lines, None)
    return images


def _intrinsics(
    path: Path, number: int, model: str, parameters: list[float]
) -> tuple[float, float, float, float]:
    focals, bends = _MODELS.get(model, (0, 0))
    bent = model not in _MODELS or any(parameters[focals + 2 :])
    if bent:
        raise InputRefused(
            f"{path}: line {number} has a lens that bends light ({model}). Undistort the images "
            "with 'colmap image_undistorter', and use the model that it writes. [colmap.camera]"
        )
    if len(parameters) != focals + 2 + bends or not all(map(math.isfinite, parameters)):
        raise _malformed(path, number, f"{focals + 2 + bends} finite parameters for {model}")
    cx, cy = parameters[focals : focals + 2]
    return parameters[0], parameters[focals - 1], cx, cy


def _world_from_camera(
    path: Path,
    number: int,
    quaternion: npt.NDArray[np.float64],
    translation: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Inverse of COLMAP's pose; y and z of the camera turned round."""
    length = float(np.linalg.norm(quaternion))
    if not (math.isfinite(length) and length > 0 and np.isfinite(translation).all()):
        raise _malformed(path, number, "a rotation and a position of finite numbers")
    w, x, y, z = quaternion / length
    camera_from_world = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = camera_from_world.T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -camera_from_world.T @ translation
    return pose


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers from 1, and lines without comments; empty ones count, they are lists."""
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputRefused(
            f"{path}: cannot be read as text ({error}). Export the model again. [colmap.model]"
        ) from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _malformed(path: Path, number: int, wanted: str) -> InputRefused:
    return InputRefused(
        f"{path}: line {number} is not {wanted}. Export the model again. [colmap.model]"
    )
