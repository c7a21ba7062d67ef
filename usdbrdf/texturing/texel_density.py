"""The texel size that suits a capture: what the frames' pixels cover of the surface, and less where
a pattern is to be told from pixels that overlap.

Many pixels that cover a pattern differently tell it finer than any of them (see ``patterns``), as
many texels as there are pixels. Where there is no pattern, finer texels tell nothing. What a pixel
shows beside its neighbours is a pattern so far as other frames show the same at the same place:
with x_i the second differences of N frames at a point, noise and highlights leave nothing of

    sum over i != j of x_i x_j / (N (N - 1)) = ((sum x_i)^2 - sum x_i^2) / (N (N - 1)).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import FramePixels
from usdbrdf.geometry.unwrap import TexelSizes
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import doubled_areas, face_normals_and_angles
from usdbrdf.model.scene import Scene
from usdbrdf.texturing.agreement import MeshPoints, seen_points
from usdbrdf.texturing.samples import MIN_COSINE
from usdbrdf.transport.rays import RayScene

_PACKING = calibration.number("texel_size.packing")
_UNSEEN = calibration.number("texel_size.unseen")
_PATTERNED = calibration.number("texel_size.patterned")
_FINEST = calibration.number("texel_size.finest")
_PIXELS = calibration.number("texel_size.pixels_of_texel")
# Pixels of a frame's width that are looked at.
_MOST_ACROSS = 1024
# Frames in which patterns are looked for, even among all, and points on the surface, drawn evenly
# from the pixels of these; a second difference counts as no more than this, and an object's
# patterns are told by so many points, in so many frames each: of fewer a median is noise.
_FRAMES, _POINTS, _SEED, _LARGEST, _FEWEST, _FEWEST_FRAMES = 96, 16384, 0, 0.3, 128, 3


def texel_sizes_from_frames(scene: Scene, rays: RayScene, frames: Frames) -> TexelSizes:
    """What the frames show of each triangle: the mean side, by logarithms, of what their pixels
    cover of it (sqrt of the area). What no frame shows gets coarse texels.

    Raises InputRefused if no camera ray meets the mesh.
    """
    count = len(scene.triangles)
    normals = face_normals_and_angles(scene.points, scene.triangles)[0]
    logarithm, pixels = np.zeros(count), np.zeros(count)
    numbers = progress(range(len(frames)), total=len(frames), label="texel sizes", unit="frames")
    for camera in map(frames.camera, numbers):
        small = camera.at_width(min(camera.width, _MOST_ACROSS))
        face, point = visible_faces(rays, small)
        point, face = point[face >= 0], face[face >= 0]
        size = _sides_of_pixels(point, normals[face], small)
        logarithm += np.bincount(face, np.log(size), count)
        pixels += np.bincount(face, minlength=count)
    if not pixels.any():
        raise InputRefused(
            "no camera ray meets the mesh, so no texel size can be chosen. Check that poses and "
            "mesh share one frame of reference and unit. [texturing.texel-size]"
        )
    of_object = [
        np.bincount(scene.face_object, values, len(scene.objects)) for values in (logarithm, pixels)
    ]
    anywhere = logarithm.sum() / pixels.sum()
    own = np.where(of_object[1] > 0, of_object[0] / np.maximum(of_object[1], 1), anywhere)
    coarse = own[scene.face_object] + math.log(_UNSEEN)
    side = np.exp(np.where(pixels > 0, logarithm / np.maximum(pixels, 1), coarse))
    return TexelSizes(side.astype(np.float32), pixels.astype(np.float32))


def _sides_of_pixels(point: Double | Float, normal: Double | Float, camera: Camera) -> Double:
    """Square roots (M,) of the areas that pixels of the camera cover at points of the surface."""
    way = point - camera.eye
    distance = np.linalg.norm(way, axis=1)
    cosine = np.abs((way * normal).sum(axis=1)) / distance
    size = distance / math.sqrt(camera.intrinsics[0] * camera.intrinsics[1])
    return np.asarray(size / np.sqrt(np.maximum(cosine, MIN_COSINE)), np.float64)


def at_most(sizes: TexelSizes, scene: Scene, max_texels: int) -> TexelSizes:
    """All larger where the surface would need more than ``max_texels`` otherwise."""
    area = doubled_areas(scene.points, scene.triangles) / 2
    needed = float((area / sizes.side.astype(np.float64) ** 2).sum())
    larger = math.sqrt(max(1.0, needed / (_PACKING * max_texels)))
    return sizes._replace(side=(sizes.side * larger).astype(np.float32))


class PointsOfPatterns(NamedTuple):
    """P points of the surface, drawn from what frames show, and the faces that they lie on."""

    surface: MeshPoints
    face: Int


def frames_for_patterns(frames: Frames) -> list[int]:
    """Those in which patterns are looked for: all, or so many, evenly."""
    return sorted({round(i) for i in np.linspace(0, len(frames) - 1, _FRAMES)})


def points_of_patterns(
    scene: Scene, rays: RayScene, frames: Frames, looked_at: Sequence[int]
) -> PointsOfPatterns:
    """Points that the frames ``looked_at`` show, even over their pixels."""
    rng = np.random.default_rng(_SEED)
    places: list[Float] = []
    faces: list[Int] = []
    for camera in map(frames.camera, looked_at):
        drawn = rng.random((_POINTS // len(looked_at), 2))
        origins, directions = camera.rays(drawn * [camera.width, camera.height])
        hits = rays.closest(origins, directions)
        met = hits.face >= 0
        places.append((origins + hits.distance[:, None] * directions)[met])
        faces.append(hits.face[met])
    face = np.concatenate(faces)
    normal = face_normals_and_angles(scene.points, scene.triangles[face])[0]
    point = np.concatenate(places).astype(np.float64)
    return PointsOfPatterns(MeshPoints(point, normal, scene.face_object[face]), face)


def finer_where_patterned(
    sizes: TexelSizes,
    scene: Scene,
    rays: RayScene,
    points: PointsOfPatterns,
    pictures: Iterable[tuple[Camera, FramePixels]],
    num_frames: int,
) -> TexelSizes:
    """Finer texels for objects with patterns, as many as there are pixels to tell them.

    pictures    of the frames that were looked at
    num_frames  of the capture, or of its lighting that has most
    """
    surface, face = points
    first, second, times, density = np.zeros((4, len(face)))
    looked_at = 0
    for camera, pixels in pictures:
        seen, difference = _second_differences(surface, rays, scene, camera, pixels)
        first[seen] += difference
        second[seen] += difference**2
        times[seen] += 1
        own = _sides_of_pixels(surface.point[seen], surface.normal[seen], camera)
        density[seen] += (sizes.side[face[seen]] / own) ** 2
        looked_at += 1
    told = times >= _FEWEST_FRAMES
    owner = surface.owner[told]
    pairs = (first**2 - second)[told] / (times * (times - 1))[told]
    of_texel = density[told] * num_frames / looked_at
    finer = np.ones(len(scene.objects))
    for i in np.flatnonzero(np.bincount(owner) >= _FEWEST):
        # Medians: shadows have edges, patterns are everywhere.
        own = owner == i
        if float(np.median(pairs[own])) > _PATTERNED**2:
            finer[i] = np.clip(math.sqrt(_PIXELS / np.median(of_texel[own])), _FINEST, 1)
    return sizes._replace(side=(sizes.side * finer[scene.face_object]).astype(np.float32))


def _second_differences(
    surface: MeshPoints, rays: RayScene, scene: Scene, camera: Camera, pixels: FramePixels
) -> tuple[Long, Double]:
    """The points whose pixel and its four neighbours show their object (n,), and by which share
    of these each pixel is brighter than its neighbours (n,)."""
    seen, column, row = seen_points(surface, rays, camera)
    around = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    places = np.stack([column, row], axis=-1)[:, None] + around
    x, y = places[..., 0], places[..., 1]
    hits = rays.closest(*camera.rays(places.reshape(-1, 2) + 0.5))
    shown = np.where(hits.face >= 0, scene.face_object[hits.face], -1).reshape(x.shape)
    level = pixels.radiance[y, x].mean(axis=-1, dtype=np.float64)
    whole: Bool = pixels.valid[y, x].all(axis=1) & (level > 0).all(axis=1)
    whole &= (shown == surface.owner[seen, None]).all(axis=1)
    beside = level[:, 1:].mean(axis=1)
    difference = (level[:, 0] - beside) / np.where(whole, level[:, 0] + beside, 1)
    which = np.flatnonzero(seen)[whole]
    return which, np.clip(difference[whole], -_LARGEST, _LARGEST)
