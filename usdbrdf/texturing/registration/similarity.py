"""Do the poses as a whole fit the mesh, or would they after a similarity?

A mesh of another scale, or one that was moved or turned against the poses, as by an alignment that
was not applied, moves what all frames show of it by the same seven numbers, which what the frames
show of the same points of the mesh tells. Each frame alone would pass for one whose pose is a
little off, by another error than the next one's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf import calibration
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.texturing.registration.joint_change import (
    Found,
    best_change,
    half_diagonal,
    points_seen,
)
from usdbrdf.transport.rays import RayScene

_TOLD = calibration.number("similarity.told")
_SURE = calibration.number("similarity.sure")
_LEFT = calibration.number("similarity.left")

# Student's t with one degree of freedom lies within so many of half the difference of two numbers
# as often as a Gaussian's within one standard deviation.
_OF_TWO = 1.84

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Similarity:
    """Of poses: about their middle, in which cameras stand in the mean, exp(larger) times as far
    from it, turned by a rotation vector (radians), and moved, in units of ``reach``, about how far
    what they show is from them. Axes are the world's."""

    middle: Vector
    reach: float
    larger: float = 0.0
    turn: Vector = (0.0, 0.0, 0.0)
    move: Vector = (0.0, 0.0, 0.0)

    @property
    def numbers(self) -> Double:
        """(7,)"""
        return np.array([self.larger, *self.turn, *self.move])

    def stepped(self, step: Double) -> Similarity:
        """And after it one by numbers (7,), about where the middle is then."""
        turn = Rotation.from_rotvec(step[1:4]) * Rotation.from_rotvec(self.turn)
        x, y, z = turn.as_rotvec().tolist()
        right, up, back = (np.array(self.move) + step[4:]).tolist()
        larger = self.larger + float(step[0])
        return replace(self, larger=larger, turn=(x, y, z), move=(right, up, back))

    def moves_cameras(self) -> bool:
        """Unless it is none."""
        return bool(self.numbers.any())

    def camera(self, camera: Camera) -> Camera:
        """One that stands elsewhere and looks elsewhere."""
        turn = Rotation.from_rotvec(self.turn).as_matrix()
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = turn @ pose[:3, :3]
        arm = math.exp(self.larger) * (turn @ (camera.eye - self.middle))
        pose[:3, 3] = self._middle_then() + arm
        return replace(camera, world_from_camera=pose)

    def _middle_then(self) -> Double:
        return np.array(self.middle) + self.reach * np.array(self.move)

    def places(self, place: Double) -> Double:
        """The same (S, 2): no lens bends."""
        return place

    def picture(self, picture: Float, camera: Camera) -> Float:
        """The same: the camera is another."""
        return picture

    def by_number(self, camera: Camera, points: Double) -> Double:
        """(S, 2, 7) of small similarities."""
        middle = self._middle_then()
        arm = np.broadcast_to(middle - camera.eye, points.shape)
        turned = [np.cross(points - middle, axis) for axis in np.eye(3)]
        moved = [np.broadcast_to(-self.reach * axis, points.shape) for axis in np.eye(3)]
        # How the points move in the camera, which moves the other way.
        axes = camera.world_from_camera[:3, :3]
        by_number = np.stack([arm, *turned, *moved], axis=2)
        x, y, z = np.moveaxis(np.einsum("ij,sik->sjk", axes, by_number), 1, 0)
        at = (points - camera.eye) @ axes
        depth = -at[:, 2:]
        fx, fy = (focal / half_diagonal(camera) for focal in camera.intrinsics[:2])
        right = fx * (x + at[:, :1] / depth * z) / depth
        down = -fy * (y + at[:, 1:2] / depth * z) / depth
        return np.stack([right, down], axis=1)


@dataclass(frozen=True)
class SimilarityCheck:
    """What was found of all frames, and of either half of them alone; None of these where they say
    nothing, or were not asked."""

    found: Found[Similarity]
    halves: tuple[Found[Similarity], Found[Similarity]] | None = None

    @property
    def off(self) -> Double:
        """(7,) by how much the halves' numbers differ from their mean."""
        if self.halves is None:
            return np.full(7, np.inf)
        one, other = self.halves
        return np.asarray(one.change.numbers - other.change.numbers, np.float64) / 2

    @property
    def error(self) -> float:
        """Of how far what frames show is moved, in widths."""
        return math.sqrt(float(self.off @ self.found.form @ self.off)) if self.halves else math.inf

    @property
    def may_be_clear(self) -> bool:
        """Whether it is worth asking the halves."""
        found = self.found
        return found.moved > _TOLD and found.left < _LEFT and found.is_seen_from_places

    @property
    def is_clear(self) -> bool:
        """Whether it is worth telling, and both halves tell it, or nearly all frames do."""
        told = self.found.is_clear or self.found.moved > _SURE * self.error
        return self.halves is not None and self.may_be_clear and told


def similarity_of_frames(
    mesh: ScanMesh, rays: RayScene, cameras: Sequence[Camera], pictures: Sequence[Float]
) -> SimilarityCheck | None:
    """The similarity of all poses under which frames agree best; None where few frames share few
    points.

    pictures  the frames' ``logarithms``, in any size
    """
    if not cameras:
        return None
    eyes = np.array([camera.eye for camera in cameras])
    x, y, z = eyes.mean(axis=0).tolist()
    reach = float(np.median(np.linalg.norm(mesh.points - eyes.mean(axis=0), axis=1)))
    found = _found_by(mesh, rays, cameras, pictures, Similarity((x, y, z), reach))
    if found is None:
        return None
    check = SimilarityCheck(found)
    if not check.may_be_clear:
        return check
    # Frames that are half as many find less from afar.
    one, other = (
        _found_by(mesh, rays, cameras[k::2], pictures[k::2], found.change) for k in (0, 1)
    )
    return replace(check, halves=(one, other)) if one and other else check


def _found_by(
    mesh: ScanMesh,
    rays: RayScene,
    cameras: Sequence[Camera],
    pictures: Sequence[Float],
    start: Similarity,
) -> Found[Similarity] | None:
    return best_change(points_seen(mesh, rays, cameras), rays, cameras, pictures, [start])


def said_of_similarity(check: SimilarityCheck, source: Path, millimetres: float) -> str:
    """A sentence on poses that fit the mesh clearly better after a similarity.

    millimetres  of a unit of the mesh
    """
    found, off = check.found.change, _OF_TWO * check.off
    x, y, z = (millimetres * found.reach * np.array(found.move)).tolist()
    turn = np.degrees(found.turn)
    angle = float(np.linalg.norm(turn))
    off_turn = float(np.degrees(np.linalg.norm(off[1:4])))
    axis = ", ".join(f"{part:+.2f}" for part in turn / max(angle, 1e-9))
    off_move = millimetres * found.reach * float(np.linalg.norm(off[4:]))
    return (
        f"{source.name}: frames show points of the mesh {check.found.moved:.1%} of a picture's "
        f"width (error {_OF_TWO * check.error:.1%}) from where their poses have them; the poses "
        f"fit the mesh better if moved by ({x:+.0f}, {y:+.0f}, {z:+.0f}) mm (error {off_move:.0f})"
        f", turned by {angle:.2f} degrees (error {off_turn:.2f}) about ({axis}) and "
        f"scaled by {math.exp(found.larger):.4f} (error {abs(off[0]):.4f}), about the cameras' "
        "middle. Align poses and mesh anew, or bring both as one program wrote them, in one unit. "
        "[capture.registration]"
    )
