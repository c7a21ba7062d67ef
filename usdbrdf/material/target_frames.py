"""The one frame per object that its material is read from (paper, section 3.4.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from usdbrdf.model.arrays import Bool, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.scene import Scene
from usdbrdf.transport.lit_scene import SurfacePoints, visible_points
from usdbrdf.transport.rays import RayScene, lift_from_surface
from usdbrdf.transport.surface_texture import SurfaceTexture


@dataclass(frozen=True, kw_only=True)
class FrameCounts:
    """Per object: pixels whose mirror ray hits an emitter and that are valid (A1 and A2), and valid
    pixels (A2); (num_objects,) int64 each."""

    mirrored: npt.NDArray[np.int64]
    valid: npt.NDArray[np.int64]


def mirror_hits_emitter(
    rays: RayScene, points: SurfacePoints, emission: SurfaceTexture, diagonal_m: float
) -> Bool:
    """A1 (R,): would a perfect mirror at the point show an emitter to the camera?

    emission: a mask in [0, 1] on the surface.
    """
    along = np.einsum("rd,rd->r", points.normal, points.to_camera)[:, None]
    reflected = np.ascontiguousarray(2 * along * points.normal - points.to_camera, np.float32)
    origin = lift_from_surface(points.position, points.normal, diagonal_m)
    hits = rays.closest(origin, reflected)
    shines = emission.at(hits.face, hits.u, hits.v)[:, 0] > 0.5
    return np.asarray(shines & (hits.face >= 0) & (points.face >= 0), np.bool_)


def count_frame(
    rays: RayScene,
    scene: Scene,
    emission: SurfaceTexture,
    valid: Bool,
    camera: Camera,
    diagonal_m: float,
    stride: int,
) -> FrameCounts:
    """A1 and A2 counted per object over every ``stride``-th pixel of a frame, valid (H, W)."""
    points = visible_points(rays, scene, camera, camera.pixels(stride))
    owner = np.where(points.face >= 0, scene.face_object[points.face], -1)
    good = valid[::stride, ::stride].ravel() & (owner >= 0)
    mirrored = good & mirror_hits_emitter(rays, points, emission, diagonal_m)
    number = len(scene.objects)
    return FrameCounts(
        mirrored=np.bincount(owner[mirrored], minlength=number),
        valid=np.bincount(owner[good], minlength=number),
    )


def choose_target_frames(counts: Iterable[FrameCounts]) -> tuple[Int, Int]:
    """Per object: the frame with most pixels in A1 and A2, and how many those are.

    An object that mirrors an emitter in no frame takes the frame with most valid pixels (count 0);
    an object without any valid pixel gets frame -1.
    """
    frames = list(counts)
    mirrored = np.stack([frame.mirrored for frame in frames])
    valid = np.stack([frame.valid for frame in frames])
    target = np.where(mirrored.max(axis=0) > 0, mirrored.argmax(axis=0), valid.argmax(axis=0))
    target = np.where(valid.max(axis=0) > 0, target, -1)
    return target.astype(np.int32), mirrored.max(axis=0).astype(np.int32)


def object_pixels(
    owner: Int,
    valid: Bool,
    highlight: Bool,
    index: int,
    limit: int,
    pick: Callable[[int], npt.NDArray[np.int64]],
) -> tuple[npt.NDArray[np.int64], Float]:
    """Flat indices of the pixels of object ``index`` to fit, at most ``limit``, and how many pixels
    each stands for, (P,) float32.

    owner (H, W): object per pixel; valid (H, W); highlight (H, W): A1. Pixels next to another
    object are left out (they mix both). Where there are more than ``limit``, ``pick(n)`` orders
    them at random and half of them are taken within 30 pixels of a mirrored emitter, where the
    lobe shows.
    """
    own = owner == index
    inner = ndimage.binary_erosion(own, np.ones((3, 3)))
    candidates = np.flatnonzero(inner & valid)
    if len(candidates) <= limit:
        return candidates, np.ones(len(candidates), np.float32)
    candidates = candidates[pick(len(candidates))]
    near = np.zeros(len(candidates), np.bool_)
    if (highlight & own).any():
        near = ndimage.distance_transform_edt(~(highlight & own)).ravel()[candidates] <= 30
    close, far = candidates[near], candidates[~near]
    take = min(len(close), max(limit // 2, limit - len(far)))
    parts = (close[:take], close), (far[: limit - take], far)
    chosen = np.concatenate([taken for taken, _ in parts])
    stands_for = np.concatenate([np.full(len(t), len(of) / max(len(t), 1)) for t, of in parts])
    order = np.argsort(chosen)
    return chosen[order], stands_for[order].astype(np.float32)
