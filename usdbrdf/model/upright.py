"""Captures whose up axis no USD stage can state, which knows Y and Z alone: they are turned, once,
so that one of these is up, and so is what is given in their coordinates later.

A turn only exchanges axes and their signs: no coordinate is rounded, and back it is to the bit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from usdbrdf.model.arrays import Array, Double
from usdbrdf.model.capture import Scan

# Of such an axis: the one that it becomes, and the rotation (3, 3), half a turn about x or a
# quarter of one about y.
_TURNS: dict[str, tuple[str, Double]] = {
    "-Y": ("Y", np.diag([1.0, -1.0, -1.0])),
    "-Z": ("Z", np.diag([1.0, -1.0, -1.0])),
    "X": ("Z", np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])),
    "-X": ("Z", np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])),
}


def is_turned(up: str | None) -> bool:
    """Whether a capture with this axis up, a key of ``--up-axis``, has to be turned."""
    return up in _TURNS


def usd_up(up: str) -> tuple[str, Double]:
    """The axis, "Y" or "Z", that one of ``options.UpAxis`` becomes, and the rotation (3, 3) that
    brings it there."""
    return _TURNS.get(up, (up, np.eye(3)))


def upright(scan: Scan) -> Scan:
    """A scan whose ``up_axis`` is that of its capture, turned where USD cannot state it:
    ``capture_up`` then tells which it was. Referenced USD geometry stays as it is, so that of a
    scan that is turned is not referred to."""
    if not is_turned(scan.up_axis):
        return scan
    axis, turn = _TURNS[scan.up_axis]
    own = replace(scan, usd_geometry=None, object_prims=())
    return _turned(own, turn, up_axis=axis, capture_up=scan.up_axis)


def as_captured(scan: Scan) -> Scan:
    """A scan in the coordinates of its capture again, to the bit."""
    if not scan.capture_up:
        return scan
    turn = _TURNS[scan.capture_up][1].T
    return _turned(scan, turn, up_axis=scan.capture_up, capture_up="")


def upright_points(points: Array, capture_up: str) -> Array:
    """Points or directions (..., 3) in the coordinates of a capture, in those of its asset."""
    return _along(points, _TURNS[capture_up][1]) if capture_up else points


def upright_pose(world_from_camera: Double, capture_up: str) -> Double:
    """A pose (4, 4), or several, in the coordinates of a capture, in those of its asset."""
    return _posed(world_from_camera, _TURNS[capture_up][1]) if capture_up else world_from_camera


def _turned(scan: Scan, turn: Double, *, up_axis: str, capture_up: str) -> Scan:
    mesh, frames = scan.mesh, scan.frames
    captured = frames.captured_pose
    return replace(
        scan,
        mesh=replace(
            mesh, points=_along(mesh.points, turn), corner_normals=_along(mesh.corner_normals, turn)
        ),
        frames=replace(
            frames,
            world_from_camera=_posed(frames.world_from_camera, turn),
            captured_pose=None if captured is None else _posed(captured, turn),
        ),
        up_axis=up_axis,
        capture_up=capture_up,
    )


def _along(vectors: Array, turn: Double) -> Array:
    """Vectors (..., 3), of whatever kind of number they are, turned without any arithmetic but a
    change of sign."""
    axes = np.abs(turn).argmax(axis=1)
    signs = turn[np.arange(3), axes].astype(vectors.dtype)
    return np.ascontiguousarray(vectors[..., axes] * signs)


def _posed(poses: Double, turn: Double) -> Double:
    """Poses (..., 4, 4), world from camera, in a world that is turned."""
    turned = poses.copy()
    columns = _along(np.swapaxes(poses[..., :3, :], -1, -2), turn)
    turned[..., :3, :] = np.swapaxes(columns, -1, -2)
    return turned
