"""Checks of poses, alone and against the mesh, before hours are spent on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import InputRefused
from usdbrdf.geometry.cameras import camera_rays
from usdbrdf.geometry.rays import RayScene
from usdbrdf.scan.findings import Findings
from usdbrdf.scan.frame_record import FrameRecord
from usdbrdf.scan.scan import Frames, ScanMesh

Double = npt.NDArray[np.float64]

_MAX_DEVIATION = 1e-3  # of R^T R from the identity
_ROUNDING = 1e-5  # what float32 and printed digits explain
_MIN_BASELINE = 1e-3  # of the scene's diagonal
_MIN_HIT_SHARE = 0.2
_PROBED_FRAMES = 64
_PROBED_SIDE = 8  # rays per side of a probed frame

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_OLD_NERFSTUDIO = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def _inverse(pose: Double) -> Double:
    return np.asarray(np.linalg.inv(pose), np.float64)


_CONVENTIONS: dict[str, Callable[[Double], Double]] = {
    "OpenCV axes (negate columns 2 and 3)": lambda m: m @ _FLIP,
    "camera-from-world matrices (invert them)": _inverse,
    "camera-from-world with OpenCV axes (invert, then negate columns 2 and 3)": (
        lambda m: _inverse(m) @ _FLIP
    ),
    "y-up poses beside a z-up mesh": lambda m: _Z_UP_FROM_Y_UP @ m,
    "z-up poses beside a y-up mesh": lambda m: _Z_UP_FROM_Y_UP.T @ m,
    "nerfstudio's axes of 2022 (state applied_transform)": lambda m: _OLD_NERFSTUDIO @ m,
}


def rigid_records(
    records: Sequence[FrameRecord],
    findings: Findings,
    source: Path,
    *,
    pose_scale: float | None,
) -> list[FrameRecord]:
    """Records with poses made exactly rigid; frames without a finite pose are dropped.

    Almost rigid ones are snapped; scaled, sheared and mirrored ones are refused, because each of
    them is a convention that holds for the whole capture.
    """
    kept: list[FrameRecord] = []
    worst = 0.0
    for record in records:
        pose = record.world_from_camera
        if not np.isfinite(pose).all() or np.abs(pose[3] - [0, 0, 0, 1]).max() > _MAX_DEVIATION:
            findings.drop(
                record.name, "its pose is not a finite 4 x 4 camera matrix", "capture.pose"
            )
            continue
        axes = pose[:3, :3] / (pose_scale or 1.0)
        deviation = _refuse_not_rigid(axes, record.name, source, pose_scale)
        worst = max(worst, deviation)
        rigid = np.eye(4)
        left, _, right = np.linalg.svd(axes)
        rigid[:3, :3] = left @ right
        rigid[:3, 3] = pose[:3, 3]
        kept.append(replace(record, world_from_camera=rigid))
    if worst > _ROUNDING:
        findings.warn(
            f"{source.name}: camera matrices were up to {worst:.2g} off a rotation and have been "
            "made rigid. [capture.pose]"
        )
    return kept


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


def refuse_without_parallax(frames: Frames, mesh: ScanMesh, source: Path) -> None:
    """InputRefused where all cameras stand at one point: nothing but a panorama."""
    centres = frames.world_from_camera[:, :3, 3]
    spread = float(np.linalg.norm(np.ptp(centres, axis=0)))
    diagonal = float(np.linalg.norm(np.ptp(mesh.points.astype(np.float64), axis=0)))
    if spread < _MIN_BASELINE * diagonal:
        raise InputRefused(
            f"{source}: all {len(frames)} cameras stand within {spread:.3g} of one point in a "
            f"scene {diagonal:.3g} across, there is no parallax. Capture from several places, or "
            "check the translations of the poses. [capture.parallax]"
        )


def refuse_rays_that_miss(frames: Frames, mesh: ScanMesh, source: Path) -> float:
    """Share of camera rays that hit the mesh; InputRefused below 20 %.

    The usual mix-ups of conventions are then tried, and those that would hit are named.
    """
    scene = RayScene(mesh.points, mesh.triangles)
    share = _hit_share(scene, frames, lambda pose: pose)
    if share >= _MIN_HIT_SHARE:
        return share
    tried = {name: _hit_share(scene, frames, read) for name, read in _CONVENTIONS.items()}
    better = [f"{name}: {hit:.0%}" for name, hit in tried.items() if hit >= _MIN_HIT_SHARE]
    if better:
        cure = f"Other readings of the poses would hit: {'; '.join(better)}. Convert the poses"
    else:
        cure = (
            f"No usual convention does better (best {max(tried.values()):.0%}; tried: "
            f"{'; '.join(tried)}). Check that mesh and poses share frame and unit"
        )
    raise InputRefused(
        f"{source}: only {share:.0%} of the camera rays hit the mesh (limit "
        f"{_MIN_HIT_SHARE:.0%}). {cure}. [capture.convention]"
    )


def _hit_share(scene: RayScene, frames: Frames, read: Callable[[Double], Double]) -> float:
    count = min(len(frames), _PROBED_FRAMES)
    hits = rays = 0
    for i in np.linspace(0, len(frames) - 1, count).round().astype(int):
        steps = (np.arange(_PROBED_SIDE) + 0.5) / _PROBED_SIDE
        x, y = np.meshgrid(steps * frames.resolution[i, 0], steps * frames.resolution[i, 1])
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
        pose = read(frames.world_from_camera[i])
        origins, directions = camera_rays(pose, frames.intrinsics[i], pixels)
        hits += int((scene.closest(origins, directions).face >= 0).sum())
        rays += len(pixels)
    return hits / rays
