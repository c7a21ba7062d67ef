"""Surfaces and views for the path tracer, without any file."""

from __future__ import annotations

from typing import Any

import numpy as np

from usdbrdf.model.camera import Camera
from usdbrdf.model.light import Light, RelitScene
from usdbrdf.model.material import Material, Surface, constant_map
from usdbrdf.relighting.render import mitsuba_scene, render_view

# A smooth lobe of no reflectance at normal incidence: seen and lit from above, it is Lambert's.
MATTE = {"f0": constant_map(0.0), "roughness": constant_map(0.1)[..., :1]}


def material(
    diffuse: Any = 0.5, *, emission: Any = 0.0, phi: float = 0.01, psi: float = 0.0
) -> Material:
    return Material(
        diffuse=constant_map(*np.atleast_1d(diffuse)),
        f0=constant_map(0.08 * psi),
        roughness=constant_map(phi**0.5)[..., :1],
        emission=constant_map(*np.atleast_1d(emission)),
    )


def surface(corners: Any, triangles: Any, stuff: Material, **more: Any) -> Surface:
    """Flat triangles of one material, facing where they are counter-clockwise."""
    points = np.array(corners, np.float64)
    faces = np.array(triangles, np.int32)
    edge = points[faces]
    normal = np.cross(edge[:, 1] - edge[:, 0], edge[:, 2] - edge[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Surface(
        name="surface",
        points=points,
        triangles=faces,
        corner_normals=np.repeat(normal[:, None], 3, axis=1).astype(np.float32),
        material=stuff,
        **more,
    )


def plate(stuff: Material, *, half: float = 50.0, z: float = 0.0, **more: Any) -> Surface:
    """A square that faces up, st from (0, 0) at its least corner to (1, 1)."""
    square = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    faces = [(0, 1, 2), (0, 2, 3)]
    return surface(square, faces, stuff, corner_uv=uv[np.array(faces)], **more)


def cube(stuff: Material, *, inside: bool = False, side: float = 1.0) -> Surface:
    """About the origin; its faces look out, or in."""
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    if inside:
        faces = [(a, c, b) for a, b, c in faces]
    return surface((np.array(corners) - 0.5) * side, faces, stuff)


def looking(eye: Any, target: Any, *, width: int = 4, height: int = 4, fov: float = 0.01) -> Camera:
    """A camera with ``fov`` radians across."""
    eye, target = np.array(eye, np.float64), np.array(target, np.float64)
    back = (eye - target) / np.linalg.norm(eye - target)
    helper = np.array([0.0, 1, 0]) if abs(back[2]) > 0.9 else np.array([0.0, 0, 1])
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    focal = width / 2 / np.tan(fov / 2)
    return Camera(
        name="view",
        world_from_camera=pose,
        intrinsics=(focal, focal, width / 2, height / 2),
        width=width,
        height=height,
    )


def photograph(
    mi: Any,
    surfaces: list[Surface],
    view: Camera,
    *,
    lights: list[Light] | None = None,
    samples: int = 64,
    bounces: int = 4,
) -> np.ndarray:
    """(H, W, 3) radiance."""
    scene = RelitScene(surfaces=tuple(surfaces), lights=tuple(lights or []))
    loaded = mitsuba_scene(mi, scene, bounces=bounces)
    return render_view(mi, loaded, view, samples=samples, seed=(1,), label="test")[0]
