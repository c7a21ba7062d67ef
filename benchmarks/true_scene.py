"""The true scene of a capture whose truth is known, for Mitsuba, and points on its open surface."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
import mitsuba as mi
from study_scene import StudyObject
from study_shapes import Array, vertex_normals

import drjit as dr  # isort: skip  (follows Mitsuba's variant)


MIN_POINTS = 100
CANDIDATES = 8  # per point wanted
OPENNESS_RAYS = 64
LARGEST_HIDDEN_SHARE = 0.1
GAP = 0.05  # m
LARGEST_NEAR_SHARE = 0.9


class Points(NamedTuple):
    """position, normal (shading), geometric_normal, albedo (N, 3); object (N,); area (N,) m^2."""

    position: Array
    normal: Array
    geometric_normal: Array
    albedo: Array
    object: np.ndarray
    area: Array

    def take(self, index: np.ndarray) -> Points:
        return Points(*(column[index] for column in self))


def true_objects(capture: Path) -> list[StudyObject]:
    """The capture's objects with their truth, in the order of truth/objects.json."""
    mesh = trimesh.load(capture / "mesh.ply", process=False)
    labels = np.asarray(mesh.metadata["_ply_raw"]["face"]["data"]["object_id"]).ravel()
    points, triangles = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    with np.load(capture / "truth/albedo_vertex.npz", allow_pickle=False) as file:
        albedo = file["albedo"].astype(np.float64)
    if len(albedo) != len(points):
        raise SystemExit(f"{capture}: {len(albedo)} albedos for {len(points)} vertices of the mesh")
    classes = {
        o["id"]: o["class_name"]
        for o in json.loads((capture / "objects.json").read_text())["objects"]
    }
    objects = []
    for truth in json.loads((capture / "truth/objects.json").read_text()):
        vertices, own = np.unique(triangles[labels == truth["id"]], return_inverse=True)
        objects.append(
            StudyObject(
                name=truth["name"],
                class_name=classes[truth["id"]],
                points=points[vertices],
                triangles=own.reshape(-1, 3).astype(np.int32),
                albedo=albedo[vertices],
                phi=truth["phi"],
                psi=truth["psi"],
                emission=tuple(truth["emission"]),
            )
        )
    return objects


# ---- where -------------------------------------------------------------------------------------


def open_points(
    scene: mi.Scene, objects: list[StudyObject], count: int, rng: np.random.Generator
) -> Points:
    """About ``count`` points: MIN_POINTS per object, the rest shared out by area."""
    dark = [k for k, item in enumerate(objects) if max(item.emission) == 0]
    areas = {k: float(triangle_areas(objects[k]).sum()) for k in dark}
    spare = max(0, count - MIN_POINTS * len(dark)) / sum(areas.values())
    chosen = []
    for k in dark:
        quota = MIN_POINTS + round(spare * areas[k])
        candidates = random_points(objects[k], k, CANDIDATES * quota, rng)
        usable = np.flatnonzero(is_open(scene, candidates, k))
        kept = candidates.take(usable[:quota])
        open_area = areas[k] * len(usable) / (CANDIDATES * quota)
        chosen.append(kept._replace(area=np.full(len(kept.area), open_area / max(1, len(kept[0])))))
    return joined(chosen)


def joined(parts: Iterable[Points]) -> Points:
    return Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def triangle_areas(item: StudyObject) -> Array:
    a, b, c = np.moveaxis(item.points[item.triangles], 1, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def random_points(item: StudyObject, index: int, count: int, rng: np.random.Generator) -> Points:
    """Uniform on the object's surface."""
    area = triangle_areas(item)
    return points_in(item, index, rng.choice(len(area), count, p=area / area.sum()), rng)


def points_in(item: StudyObject, index: int, face: np.ndarray, rng: np.random.Generator) -> Points:
    """One random point in each of the faces; normal and albedo linear between the vertices."""
    count = len(face)
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    corner = item.triangles[face]
    normals = vertex_normals(item.points, item.triangles)
    p, n, albedo = (
        np.einsum("nk,nkd->nd", weights, values[corner])
        for values in (item.points, normals, item.albedo)
    )
    a, b, c = np.moveaxis(item.points[corner], 1, 0)
    flat = np.cross(b - a, c - a)
    return Points(
        position=p,
        normal=n / np.linalg.norm(n, axis=1, keepdims=True),
        geometric_normal=flat / np.linalg.norm(flat, axis=1, keepdims=True),
        albedo=albedo,
        object=np.full(count, index),
        area=np.zeros(count),
    )


def is_open(scene: mi.Scene, points: Points, seed: int) -> np.ndarray:
    """(N,) bool: neither inside nor behind something, nor in a gap."""
    count = len(points.position) * OPENNESS_RAYS
    random = mi.PCG32(size=count, initstate=seed)
    origin, frame = surface_points(points, OPENNESS_RAYS)
    u = mi.Point2f(random.next_float32(), random.next_float32())
    direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
    hit = scene.ray_intersect(origin.spawn_ray(direction))
    hidden = ~hit.is_valid() | (dr.dot(hit.n, direction) > 0)
    near = hit.t < GAP
    hidden_share, near_share = (
        np.array(rays).reshape(-1, OPENNESS_RAYS).mean(axis=1) for rays in (hidden, near)
    )
    return (hidden_share <= LARGEST_HIDDEN_SHARE) & (near_share <= LARGEST_NEAR_SHARE)


def surface_points(points: Points, rays: int) -> tuple[mi.Interaction3f, mi.Frame3f]:
    """Mitsuba's points and shading frames, each ``rays`` times in a row."""

    def repeated(values: Array) -> mi.Vector3f:
        return mi.Vector3f(np.repeat(values.astype(np.float32), rays, axis=0).T)

    origin = dr.zeros(mi.Interaction3f, rays * len(points.position))
    origin.p = mi.Point3f(repeated(points.position))
    origin.n = mi.Normal3f(repeated(points.geometric_normal))
    return origin, mi.Frame3f(repeated(points.normal))
