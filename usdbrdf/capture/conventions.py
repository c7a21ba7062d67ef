"""Readings of camera poses that are mixed up with ours: OpenGL axes, world from camera; and what
documents say of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.checks import Findings
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Double
from usdbrdf.model.camera import Camera

# OpenCV's camera (y down, looking down +z) has OpenGL's second and third axis reversed.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
# What nerfstudio's documents of 2022 had done to the world without saying so.
OLD_NERFSTUDIO = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
# Keys under which documents state the axes of cameras, and what they say. Those of distortion,
# pixels, depths or worlds say nothing of them, whatever word they have.
_CONVENTIONS = frozenset((
    "camera_convention", "convention", "coordinate_convention", "pose_convention",
    "camera_coordinate_system", "camera_coordinate_frame", "camera_axes",
))  # fmt: skip
_AXES = dict.fromkeys(("opencv", "opencvc2w", "colmap", "rdf"), "OpenCV") | dict.fromkeys(
    ("opengl", "openglc2w", "blender", "nerf", "nerfstudio", "instantngp", "rub"), "OpenGL"
)


def opengl_from_opencv(world_from_camera: Double) -> Double:
    """(..., 4, 4) poses of cameras that look down +z with y down, as our cameras stand."""
    # Not a product of matrices: of an infinite number that would make others NaN, with a warning.
    return np.asarray(world_from_camera * np.diag(_FLIP), np.float64)


def _transposed(pose: Double) -> Double:
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3].T
    return turned


def _turned(axis: int, quarters: int) -> Callable[[Double], Double]:
    """Poses turned about y (1) or z (2) by quarters, with the mesh that somebody has turned so."""
    first, second = (2, 0) if axis == 1 else (0, 1)
    quarter = np.eye(4)
    quarter[[first, second], [first, second]] = 0
    quarter[first, second], quarter[second, first] = -1, 1
    turn = np.linalg.matrix_power(quarter, quarters)
    return lambda pose: np.asarray(turn @ pose, np.float64)


def _beside_turned_meshes() -> dict[str, Callable[[Double], Double]]:
    return {
        f"beside a mesh turned by {90 * quarters} degrees about {'xyz'[axis]} (turn it back)": (
            _turned(axis, quarters)
        )
        for axis in (2, 1)
        for quarters in (1, 2, 3)
    }


def _mirrored(axis: int) -> Callable[[Double], Double]:
    """What the cameras of a mirrored scene would see: no pose, but as good as one to look along."""
    mirror = np.eye(4)
    mirror[axis, axis] = -1
    return lambda pose: np.asarray(mirror @ pose, np.float64)


def _beside_mirrored_meshes() -> dict[str, Callable[[Double], Double]]:
    return {
        f"beside a mesh mirrored in {name}, as by an exporter for left-handed axes (negate its "
        f"{name})": _mirrored(axis)
        for axis, name in enumerate("xyz")
    }


def _farther(factor: float) -> Callable[[Double], Double]:
    """Poses in a unit so many times smaller."""
    scale = np.array([[1, 1, 1, factor]] * 3 + [[1.0] * 4])
    return lambda pose: np.asarray(pose * scale, np.float64)


# Mix-ups of conventions that are tried where the poses do not fit the mesh.
CONVENTIONS: dict[str, Callable[[Double], Double]] = {
    "OpenCV axes (negate columns 2 and 3)": opengl_from_opencv,
    "camera-from-world matrices (invert them)": lambda m: np.asarray(np.linalg.inv(m)),
    "camera-from-world with OpenCV axes (invert, then negate columns 2 and 3)": (
        lambda m: opengl_from_opencv(np.asarray(np.linalg.inv(m)))
    ),
    "rotations transposed (transpose them, keep the positions)": _transposed,
    "y-up poses beside a z-up mesh": lambda m: _Z_UP_FROM_Y_UP @ m,
    "z-up poses beside a y-up mesh": lambda m: _Z_UP_FROM_Y_UP.T @ m,
    "upside down beside the mesh, as Meshroom's are (negate its y and z)": lambda m: _FLIP @ m,
    "nerfstudio's axes of 2022 (state applied_transform)": lambda m: OLD_NERFSTUDIO @ m,
    **_beside_turned_meshes(),
    **_beside_mirrored_meshes(),
}


def _of_units() -> dict[str, Callable[[Double], Double]]:
    farther = {
        "centimetres and a mesh in millimetres": 10.0,
        "metres and a mesh in centimetres": 100.0,
        "metres and a mesh in millimetres": 1000.0,
        "metres and a mesh in inches": 1 / 0.0254,
        "metres and a mesh in feet": 1 / 0.3048,
        "millimetres and a mesh in centimetres": 0.1,
        "centimetres and a mesh in metres": 0.01,
        "millimetres and a mesh in metres": 0.001,
        "inches and a mesh in metres": 0.0254,
        "feet and a mesh in metres": 0.3048,
    }
    return {
        f"positions in {units} (scale the mesh by {1 / factor:.6g})": _farther(factor)
        for units, factor in farther.items()
    }


# And of units, of which hits alone do not tell: from one point in a room everything is hit, and
# cameras around a thing hit it more the nearer they are.
UNITS = _of_units()
# And of pixels whose rows or columns run the other way than the cameras saw them: 1, or -1 of what
# is reversed, x and y. No pose undoes the first two.
FLIPS = {
    "upside down, as written from the last row to the first (reverse their rows)": (1, -1),
    "mirrored from left to right (reverse their columns)": (-1, 1),
    "turned by 180 degrees (turn them back)": (-1, -1),
}


def with_reversed_pixels(camera: Camera, name: str) -> Camera:
    """What projects to the pixels of its picture if they are one of ``FLIPS``; of any other name
    the camera itself. A mirrored one is no camera that can be, but as good to look points up by."""
    if name not in FLIPS:
        return camera
    x, y = FLIPS[name]
    fx, fy, cx, cy = camera.intrinsics
    return replace(
        camera,
        world_from_camera=camera.world_from_camera @ np.diag([x, y, 1.0, 1.0]),
        intrinsics=(
            fx,
            fy,
            cx if x > 0 else camera.width - cx,
            cy if y > 0 else camera.height - cy,
        ),
    )


def _stated(holder: Mapping[str, Any]) -> dict[str, str]:
    """What a document or a frame says of its cameras' axes, by the keys under which it does:
    camera_convention is MapAnything's (WAI), and always "opencv"; the others people make up."""
    words = ((key, value) for key, value in holder.items() if key.lower() in _CONVENTIONS)
    return {key: value for key, value in words if isinstance(value, str)}


def _axes(word: str) -> str | None:
    return _AXES.get(re.sub(r"[\W_]", "", word.lower()))


def are_said_to_be_opencvs(document: Mapping[str, Any]) -> bool:
    """Whether a document says that its cameras look down +z with y down."""
    return "OpenCV" in map(_axes, _stated(document).values())


def warn_of_conventions(
    document: Mapping[str, Any],
    frames: Iterable[Mapping[str, Any]],
    source: Path,
    findings: Findings,
) -> None:
    """One sentence on axes that a document states, if they are not OpenGL's; InputRefused where it
    states two, or a frame others than it does."""
    stated = _stated(document)
    known = {key: axes for key, word in stated.items() if (axes := _axes(word))}
    if len(set(known.values())) > 1:
        said = ", ".join(f"{key} {stated[key][:40]!r}" for key in known)
        raise InputRefused(
            f"{source}: states two conventions of its cameras, {said}. Keep the one that its poses "
            "have. [capture.convention]"
        )
    taken = next(iter(known.values()), "OpenGL")
    for i, frame in enumerate(frames):
        other = next((item for item in _stated(frame).items() if _axes(item[1]) != taken), None)
        if other is not None and other[1] not in stated.values():
            raise InputRefused(
                f"{source}: frames[{i}] states {other[0]} {other[1][:40]!r}, but the document "
                f"{'states another' if known else 'none'}, and is read as {taken}'s. State "
                "camera_convention once, opencv or opengl, beside the list of frames, all of whose "
                "poses are to have it. [capture.convention]"
            )
    for key, word in stated.items():
        if known.get(key) == "OpenCV":
            findings.warn(
                f"{source.name}: {key} is {word!r}, so its cameras are read as such that look down "
                "+z with y down. [capture.convention]"
            )
        elif key not in known:
            findings.warn(
                f"{source.name}: {key} is {word[:40]!r}, which is not known here; its cameras are "
                "read as OpenGL's, from camera to world. If they are not, convert them, or state "
                "camera_convention opencv. [capture.convention]"
            )
