"""Poses as a capture states them, made exactly rigid, and lenses that make sense; what is a
convention of the whole capture is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.lens_views import views_of, why_no_lens
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import MAX_SIDE
from usdbrdf.model.arrays import Double

# Of R^T R from the identity: what is refused, and what float32 and printed digits explain.
_MAX_DEVIATION, _ROUNDING = 1e-3, 1e-5
# What is so near stays as it is, and so do poses that were made rigid before.
_EXACT = 1e-14
# Beyond this no number of a camera matrix makes sense; focal lengths and principal points, in sizes
# of the image.
LARGEST_OF_POSE = 1e9
_FOCAL_LENGTHS, _FARTHEST_CENTRE = (0.01, 1000.0), 10.0
# Of a picture's sides, by which principal points are off its middle, at most.
_AT_CORNER = 0.1
# The shortest focal length of a pinhole, in the same: 157 degrees, wider than lenses draw straight.
_SHORTEST_PINHOLE = 0.1


def rigid_pose(rotation: Double, centre: Double) -> Double:
    """(4, 4) of a 3 x 3 rotation and a point."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre
    return pose


def rigid_records(
    records: Sequence[FrameRecord], findings: Findings, source: Path, *, pose_scale: float | None
) -> list[FrameRecord]:
    """Records with poses made exactly rigid; frames without a sensible camera are dropped.

    Almost rigid ones are snapped; scaled, sheared and mirrored ones are refused, because each of
    them is a convention that holds for the whole capture.
    """
    kept: list[FrameRecord] = []
    worst = 0.0
    # One of four tiles of a picture has its axis there too, the others have not.
    offsets = all(map(_is_at_corner, records))
    for record in records:
        pose = record.world_from_camera
        if not is_camera_matrix(pose):
            why = "not a finite 4 x 4 camera matrix"
            if is_camera_matrix(pose.T):
                why = "transposed, as programs write it that have columns first: its last column"
                why += " is 0 0 0 1, which is the last row's"
            findings.drop(record.name, f"its pose is {why}", "capture.pose")
        elif said := _why_no_camera(record, offsets):
            findings.drop(record.name, said, "capture.camera")
        else:
            rigid, off = _made_rigid(pose, record.name, source, pose_scale)
            worst = max(worst, off)
            captured = record.captured_pose
            if captured is not None:
                captured = _made_rigid(captured, record.name, source, pose_scale)[0]
            kept.append(replace(record, world_from_camera=rigid, captured_pose=captured))
    if worst > _ROUNDING:
        findings.warn(
            f"{source.name}: camera matrices were up to {worst:.2g} off a rotation and have been "
            "made rigid. [capture.pose]"
        )
    return kept


def _made_rigid(
    pose: Double, name: str, source: Path, pose_scale: float | None
) -> tuple[Double, float]:
    """An almost rigid pose made exactly so, and how far its axes were off; InputRefused for
    others."""
    axes = pose[:3, :3] / (pose_scale or 1.0)
    off = _refuse_not_rigid(axes, name, source, pose_scale)
    if np.abs(axes.T @ axes - np.eye(3)).max() > _EXACT:
        left, _, right = np.linalg.svd(axes)
        axes = left @ right
    rigid = pose.copy()
    rigid[:3, :3], rigid[3] = axes, (0, 0, 0, 1)
    return rigid, off


def is_camera_matrix(pose: Double) -> bool:
    """Whether a 4 x 4 matrix is finite, of sensible numbers, and has the last row 0 0 0 1."""
    return bool(
        (np.abs(pose) <= LARGEST_OF_POSE).all()
        and np.abs(pose[3] - [0, 0, 0, 1]).max() <= _MAX_DEVIATION
    )


def _is_at_corner(record: FrameRecord) -> bool:
    """Whether the axis of a camera lies about where the first pixel does: that is an offset from
    the picture's middle."""
    place = np.divide(record.intrinsics[2:], np.maximum(record.resolution, 1))
    return record.lens.curve != "equirectangular" and bool(np.abs(place).max() <= _AT_CORNER)


def _why_no_camera(record: FrameRecord, offsets: bool) -> str:
    """Why its numbers are not those of a camera of its size, a clause; "" where they may be.

    offsets  whether the principal points of all cameras lie where the first pixel does
    """
    lens = ", ".join(f"{number:g}" for number in record.intrinsics)
    size = " x ".join(map(str, record.resolution))
    bends = f" with {record.lens.curve} distortion" if record.lens.bends else ""
    said = f"fx, fy, cx, cy = {lens}{bends} make no lens for {size} pixels"
    if min(record.resolution) < 1 or max(record.resolution) > MAX_SIDE:
        return said
    focal, centre = np.reshape(record.intrinsics, (2, 2)) / record.resolution
    low, high = _FOCAL_LENGTHS
    near = np.abs(centre) <= _FARTHEST_CENTRE
    if not ((focal >= low) & (focal <= high) & near).all():
        return said
    if not record.lens.bends and focal.min() < _SHORTEST_PINHOLE:
        angle = 2 * math.degrees(math.atan(0.5 / focal.min()))
        return (
            f"{said}: it would be {angle:.0f} degrees wide; all are in pixels, not in mm or sizes"
        )
    # That of a picture whose corner is its first pixel is an offset from its middle, or no pixels.
    if offsets or (max(map(abs, record.intrinsics[2:])) <= 1 and 4 * np.abs(centre).max() < 1):
        return f"{said}: cx and cy are pixels from its corner, not from its middle, nor sizes"
    camera = (record.lens, record.intrinsics, record.resolution)
    return why_no_lens(*camera) if views_of(*camera) else said


def _refuse_not_rigid(axes: Double, name: str, source: Path, pose_scale: float | None) -> float:
    """How far the 3 x 3 axes are from a rotation; InputRefused beyond the limit."""
    gram = axes.T @ axes
    deviation = float(np.abs(gram - np.eye(3)).max())
    scale = float(np.sqrt(np.trace(gram) / 3))
    if scale == 0 or np.abs(gram / scale**2 - np.eye(3)).max() > _MAX_DEVIATION:
        raise InputRefused(
            f"{source}: the pose of {name!r} is sheared or scaled unevenly (axes of length "
            f"{', '.join(f'{length:.4g}' for length in np.sqrt(np.diag(gram)))}). Export "
            "camera-to-world matrices that are rotation and translation. [capture.pose]"
        )
    if np.linalg.det(axes) < 0:
        raise InputRefused(
            f"{source}: the pose of {name!r} is mirrored (determinant -1): OpenCV and OpenGL axes "
            "mixed? Turn y and z over together, never one axis alone. [capture.pose]"
        )
    if deviation > _MAX_DEVIATION:
        measured = scale * (pose_scale or 1.0)
        raise InputRefused(
            f"{source}: the axes of the pose of {name!r} are scaled by {measured:.6g} (limit "
            f"{_MAX_DEVIATION:g} from 1). Export rigid matrices, or, if the positions are in the "
            f"unit of the mesh, pass --pose-scale {measured:.6g}. [capture.pose]"
        )
    return deviation
