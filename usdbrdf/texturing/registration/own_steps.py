"""Would the frames agree better if each camera stood a little elsewhere, by a step of its own?

Poses that are off by another error each, as those of a tracker that trembles or of a solve from few
matches, leave no pattern that all frames share: base colours are blurred, and no lens and no
similarity explains it. Small steps of the cameras do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.texturing.pose_steps import refined_poses
from usdbrdf.transport.rays import RayScene

_TOLD = calibration.number("own_steps.told")
_LEFT = calibration.number("own_steps.left")
# Frames without which nothing is said; pixels of a picture's width at which moves are looked up.
_MIN_FRAMES, _ACROSS = 6, 64


@dataclass(frozen=True)
class OwnSteps:
    """Of N frames: by how much the step of its camera moves what each shows, in the middle, in
    widths of a picture (N,), 0 where it would agree no better; and the share that is left then of
    what they differ by."""

    moved: Double
    left: float

    @property
    def usual(self) -> float:
        """In widths, of the frame in the middle."""
        return float(np.median(self.moved))

    @property
    def is_clear(self) -> bool:
        """Whether it is worth telling, and more than what steps fit of noise and gloss."""
        return self.usual > _TOLD and self.left < _LEFT


def own_steps_of_frames(
    mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera], pictures: Sequence[Float]
) -> OwnSteps | None:
    """The steps under which frames agree better; None where few frames are asked.

    pictures  the frames' ``logarithms``, in any size
    """
    if len(cameras) < _MIN_FRAMES:
        return None
    found = refined_poses(mesh, rays, cameras, pictures)
    moved = [
        _moved(rays, camera, replace(camera, world_from_camera=pose))
        for camera, pose in zip(cameras, found.world_from_camera, strict=True)
    ]
    left = float(found.after.mean()) / max(float(found.before.mean()), 1e-9)
    return OwnSteps(np.array(moved), left)


def _moved(rays: RayScene, before: Camera, after: Camera) -> float:
    """How far apart two cameras have what one of them sees, in the middle, in widths."""
    face, point = visible_faces(rays, before.at_width(min(before.width, _ACROSS)))
    points = point[face >= 0].astype(np.float64)
    points = points[(points - after.eye) @ after.world_from_camera[:3, 2] < 0]
    if not len(points):
        return 0.0
    apart = after.project(points) - before.project(points)
    return float(np.median(np.linalg.norm(apart, axis=1))) / before.width


def said_of_own_steps(found: OwnSteps, source: Path, width: int | None) -> str:
    """A sentence on poses each of which is off by itself.

    width  of the frames, in pixels; None where they differ
    """
    pixels = f" ({found.usual * width:.1f} pixels)" if width else ""
    stepped = int((found.moved > 0).sum())
    return (
        f"{source.name}: {stepped} of {len(found.moved)} frames that were compared would agree "
        f"better with the others if each camera stood elsewhere, which moves what they show by "
        f"{found.usual:.1%} of a picture's width{pixels} in the middle: "
        "their poses are off by as much at least, each by itself. --refine-poses lets each camera "
        "take such a step; beyond some pixels, align the photographs anew. [capture.steps]"
    )
