"""A captured room with truth, as redraw_room.py needs it: faces of each object, cameras, true
materials, and what the held-out views show of each object's albedo and radiance."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy import ndimage

from usdbrdf.files.images import read_radiance
from usdbrdf.geometry.normals import corner_normals

Array = npt.NDArray[Any]

CREASE_ANGLE_DEG = 40.0  # as convert smooths normals
TEXTURE_SIZE = 192  # pixels along each of an object's three sides
REACH = 8  # pixels: farther from what is seen a texture has the object's median


class Room:
    """Faces of each object, cameras and true materials of a capture."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.transforms = json.loads((folder / "transforms.json").read_text())
        self.views = json.loads((folder / "truth/views.json").read_text())
        self.materials = json.loads((folder / "truth/materials.json").read_text())["objects"]
        self.described = {
            o["name"]: o["bsdf"] for o in json.loads((folder / "truth/objects.json").read_text())
        }
        mesh = trimesh.load(folder / "mesh.ply", process=False)
        labels = np.asarray(mesh.metadata["_ply_raw"]["face"]["data"]["object_id"]).ravel()
        points, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
        names = {o["id"]: o["name"] for o in self.labels()}
        normals = corner_normals(points, triangles, CREASE_ANGLE_DEG)
        self.corners = {
            name: (points[triangles[labels == k]], normals[labels == k])
            for k, name in names.items()
        }
        self.area = {name: triangle_area(corners) for name, (corners, _) in self.corners.items()}
        self.seen = self.what_views_show(triangles, labels, points, names)

    def labels(self) -> list[dict[str, Any]]:
        return list(json.loads((self.folder / "objects.json").read_text())["objects"])

    def what_views_show(
        self, triangles: Array, labels: Array, points: Array, names: dict[int, str]
    ) -> dict[str, tuple[Array, Array, Array, Array]]:
        """Per object (position, geometric normal, albedo, radiance) (N, 3) of the views' pixels
        that show nothing else nearby."""
        cast = trimesh.ray.ray_pyembree.RayMeshIntersector(
            trimesh.Trimesh(points, triangles, process=False), scale_to_box=False
        )
        found: dict[str, list[Array]] = {}
        for k, record in enumerate(self.views["frames"]):
            origin, direction = pixel_rays(self.views, np.array(record["transform_matrix"]))
            place, ray, face = cast.intersects_location(
                origin, direction, multiple_hits=False
            )[:3]  # fmt: skip
            radiance, albedo = (
                read_radiance(self.folder / "truth" / name).reshape(-1, 3)[ray]
                for name in (record["file_path"], f"albedo_{k:02d}.exr")
            )
            shown = np.full(len(origin), -1)
            shown[ray] = labels[face]
            alone = of_one_object(shown.reshape(self.views["h"], -1)).ravel()[ray]
            place, face, radiance, albedo = (
                values[alone] for values in (place, face, radiance, albedo)
            )
            a, b, c = np.moveaxis(points[triangles[face]], 1, 0)
            row = np.concatenate([place, np.cross(b - a, c - a), albedo, radiance], axis=1)
            for label in np.unique(labels[face]):
                found.setdefault(names[label], []).append(row[labels[face] == label])
        return {
            name: tuple(np.concatenate(rows).reshape(-1, 4, 3).swapaxes(0, 1))
            for name, rows in found.items()
        }


def of_one_object(objects: Array) -> Array:
    """(H, W) bool: the pixel and its eight neighbours show one object."""
    low, high = (
        extreme(objects, size=3, mode="constant", cval=-1)
        for extreme in (ndimage.minimum_filter, ndimage.maximum_filter)
    )
    return (low == high) & (objects >= 0)


def triangle_area(corners: Array) -> float:
    a, b, c = np.moveaxis(corners, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def pixel_rays(document: dict[str, Any], world_from_camera: Array) -> tuple[Array, Array]:
    """Through the centres of all pixels, row by row."""
    y, x = np.mgrid[: document["h"], : document["w"]] + 0.5
    rays = np.stack(
        [
            (x - document["cx"]) / document["fl_x"],
            (document["cy"] - y) / document["fl_y"],
            -np.ones_like(x),
        ],
        axis=-1,
    ).reshape(-1, 3)
    directions = rays @ world_from_camera[:3, :3].T
    return np.repeat(world_from_camera[None, :3, 3], len(rays), axis=0), directions


# ---- its albedo ----


def known_albedo(room: Room, name: str) -> list[float]:
    """The colour in Mitsuba's description, else the median of what views show, else a mid grey."""
    found = number_after(room.described[name], "reflectance")
    if found is None and name in room.seen:
        found = np.median(room.seen[name][2], axis=0).tolist()
    return [float(np.clip(c, 0.0, 0.98)) for c in found or [0.4] * 3]


def number_after(description: str, word: str) -> list[float] | None:
    """The three numbers of the first constant spectrum whose name ends with ``word``."""
    pattern = rf"{word} = SRGB\w+\[\s*value = \[\[([^\]]+)\]\]"
    match = re.search(pattern, description)
    return [float(part) for part in match[1].split(",")] if match else None


def pattern_of(room: Room, name: str) -> tuple[Array, Array] | None:
    """(bitmap (S, 3 S, 3), uv (3 F, 2)): albedo seen from the three axes, side by side; None where
    no view shows the object."""
    if name not in room.seen:
        return None
    corners, _ = room.corners[name]
    position, normal, albedo, _ = room.seen[name]
    low = corners.reshape(-1, 3).min(axis=0)
    extent = np.maximum(np.ptp(corners.reshape(-1, 3), axis=0), 1e-6)
    a, b, c = np.moveaxis(corners, 1, 0)
    side = np.repeat(np.abs(np.cross(b - a, c - a)).argmax(axis=1), 3)
    uv = side_coordinates((corners.reshape(-1, 3) - low) / extent, side)
    places = side_coordinates((position - low) / extent, np.abs(normal).argmax(axis=1))
    size = np.array([3 * TEXTURE_SIZE, TEXTURE_SIZE])
    x, y = np.clip((places * size).astype(int), 0, size - 1).T
    flat = y * size[0] + x
    counts = np.bincount(flat, minlength=size.prod())
    sums = np.stack([np.bincount(flat, channel, size.prod()) for channel in albedo.T], axis=-1)
    picture = (sums / np.maximum(counts, 1)[:, None]).reshape(size[1], size[0], 3)
    empty = (counts == 0).reshape(size[1], size[0])
    distance, near = ndimage.distance_transform_edt(empty, return_indices=True)
    picture = picture[tuple(near)]
    picture[distance > REACH] = np.median(albedo, axis=0)
    return np.clip(picture, 0, 0.98), uv


def side_coordinates(unit: Array, side: Array) -> Array:
    """uv in [0, 1]^2 of points in the unit cube, seen along axis ``side``, in its third of it."""
    rows = np.arange(len(unit))
    u, v = unit[rows, (side + 1) % 3], unit[rows, (side + 2) % 3]
    return np.stack([(side + np.clip(u, 0.001, 0.999)) / 3, v], axis=-1)
