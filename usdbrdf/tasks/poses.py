"""The cameras of a scan take small steps, so that its frames agree better about its mesh."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.files.frames import Read, read_frames
from usdbrdf.job.progress import progress, say
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.texturing.pose_samples import logarithms
from usdbrdf.texturing.pose_steps import refined_poses
from usdbrdf.transport.rays import RayScene

# Pixels of a picture's width, and of all pictures, that poses are refined with, at most.
_MOST_ACROSS, _MOST_PIXELS = 1024, 1 << 27


def with_refined_poses(scan: Scan, read: Read) -> tuple[Scan, list[dict[str, Any]]]:
    """The scan with poses that agree better, and for each frame by how much it was moved (metres)
    and turned (degrees), and how far it differs from what the others show, before and after, from 0
    to 1; of this the user is told. What was refined before stays as it is."""
    frames, mesh = scan.frames, scan.mesh
    if frames.captured_pose is not None:
        say(f"ingest: the poses of {scan.source.name} are refined already; they stay as they are")
        return scan, _steps(scan)
    shrink = _shrink(frames)
    images = read_frames(read, range(len(frames)))
    seen = progress(images, total=len(frames), label="poses: reading", unit="frames")
    pictures: list[Float] = [logarithms(pixels, shrink) for _, pixels in seen]
    rays = RayScene(mesh.points, mesh.triangles)
    cameras = [frames.camera(i) for i in range(len(frames))]
    found = refined_poses(mesh, rays, cameras, pictures)
    captured, refined = frames.world_from_camera, found.world_from_camera
    changed = replace(frames, world_from_camera=refined, captured_pose=captured)
    scan = replace(scan, frames=changed)
    told = _steps(scan)
    for row, before, after in zip(told, found.before, found.after, strict=True):
        row |= {"differed": round(float(before), 4), "differs": round(float(after), 4)}
    say(
        f"ingest: {(found.after < found.before).sum()} of {len(frames)} cameras took a step, at "
        f"most {1000 * max(row['moved_m'] for row in told):.1f} mm and "
        f"{max(row['turned_deg'] for row in told):.2f} degrees"
    )
    return scan, told


def _steps(scan: Scan) -> list[dict[str, Any]]:
    """By how much each frame's pose differs from that captured, in metres and degrees."""
    captured, refined = scan.frames.captured_pose, scan.frames.world_from_camera
    assert captured is not None
    moved = _distances(captured, refined) * scan.meters_per_unit
    turned = _degrees(captured, refined)
    return [
        {
            "frame": path.name,
            "moved_m": round(float(moved[i]), 6),
            "turned_deg": round(float(turned[i]), 5),
        }
        for i, path in enumerate(scan.frames.image_paths)
    ]


def _shrink(frames: Frames) -> int:
    """Pixels along each side that become one."""
    width = int(frames.resolution[:, 0].max())
    pixels = int(frames.resolution.astype(np.int64).prod(axis=1).sum())
    return max(1, -(-width // _MOST_ACROSS), math.ceil(math.sqrt(pixels / _MOST_PIXELS)))


def _distances(before: Double, after: Double) -> Double:
    return np.asarray(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1), np.float64)


def _degrees(before: Double, after: Double) -> Double:
    turn = before[:, :3, :3].transpose(0, 2, 1) @ after[:, :3, :3]
    return np.asarray(np.degrees(Rotation.from_matrix(turn).magnitude()), np.float64)
