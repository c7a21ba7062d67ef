"""A room of a few squares, lit and converted for nothing but the kernels that are compiled on the
way, in a child beside a user's first conversion (``job/first_run.py``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from usdbrdf import pipeline
from usdbrdf.files.documents import write_json
from usdbrdf.files.images import write_exr
from usdbrdf.files.ply import write_ply
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.model.arrays import Array, Double, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.options import ConvertOptions, TextureOptions
from usdbrdf.transport.brdf import DIELECTRIC, PAPER
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels
from usdbrdf.transport.lit_scene import TexturedScene, lit_scene, visible_points
from usdbrdf.transport.lobe_radiance import lobe_basis
from usdbrdf.transport.rays import RayScene

_FRAMES, _WIDTH, _HEIGHT, _LENS = 16, 32, 24, (20.0, 20.0, 16.0, 12.0)
# Texels along a square's side, and patches of them that irradiance is traced at.
_TEXELS, _PATCHES = 16, 4
_HALVES = (0, 1, 2), (0, 2, 3)  # of a square, as triangles of its corners
# Corner, two edges and radiance of each object: inner sides of a room 4 x 3 x 2.5 m, a lamp below
# its ceiling, and a table.
_SQUARES = {
    "floor": ((0, 0, 0), (4, 0, 0), (0, 3, 0), 0.2),
    "ceiling": ((0, 0, 2.5), (0, 3, 0), (4, 0, 0), 0.5),
    "south": ((0, 0, 0), (0, 0, 2.5), (4, 0, 0), 0.3),
    "north": ((0, 3, 0), (4, 0, 0), (0, 0, 2.5), 0.35),
    "west": ((0, 0, 0), (0, 3, 0), (0, 0, 2.5), 0.4),
    "east": ((4, 0, 0), (0, 0, 2.5), (0, 3, 0), 0.3),
    "lamp": ((1.5, 1, 2.4), (0, 1, 0), (1, 0, 0), 8.0),
    "table": ((1.6, 1.2, 0.7), (0.8, 0, 0), (0, 0.6, 0), 0.25),
}
# The table, the lamp and two walls, as cameras look at them in turn.
_LOOKED_AT = ((2.0, 1.5, 0.4), (2.0, 1.5, 2.4), (0.1, 1.4, 0.9), (2.1, 2.9, 0.8))


def compile_all(_arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
    """Light the room, then convert it; called in a child, by name. ``done``: the file that says it
    was done. The loops of light transport come first: they take longest, and the run that this is
    for comes to them when it has compiled those of its first steps itself."""
    _trace_light()
    # In the child's own folder, which the parent takes away, also from one that it ends.
    with TemporaryDirectory(dir=".") as folder:
        capture = Path(folder) / "room"
        _write_capture(capture)
        with pipeline.working_on(Path(folder) / "asset") as asset:
            options = ConvertOptions()
            pipeline.ingest(capture, asset, options.ingest, "transforms", plugins=False)
            pipeline.texture(asset, TextureOptions(texel_size=0.25))
            pipeline.shade(asset, options.shade)
            pipeline.fit(asset, options.fit)
    Path(parameters["done"]).touch()
    return {}


def _trace_light() -> None:
    """Irradiance in the room, and a lobe's reflection."""
    scene = _scene()
    texels = texels_from_atlas(scene, np.full((len(scene.objects), 2), _TEXELS, np.int32))
    surface = TexturedScene(scene, texels, RayScene(scene.points, scene.triangles))
    radiance = np.array([each[3] for each in _SQUARES.values()], np.float32)
    light = np.repeat(radiance[texels.object_index(), None], 3, axis=1)
    lit = lit_scene(surface, light, light[:, 0] > 1, black_environment())
    order, patch = tiles_of_texels(texels)
    some = np.flatnonzero(patch < _PATCHES)
    irradiance_at(
        surface.rays, lit.radiance, lit.lights, lit.environment, texels.position[order[some]],
        texels.normal[order[some]], patch[some], ConvertOptions().shade.sampling,
        surface.diagonal_m, light[order[some], 0],
    )  # fmt: skip
    camera = Camera(
        world_from_camera=_pose(0.0, _LOOKED_AT[0]), intrinsics=_LENS, width=_WIDTH, height=_HEIGHT
    )
    points = visible_points(lit, camera, camera.pixels(4))
    for lobe in (PAPER, DIELECTRIC):
        basis = lobe_basis(replace(lit, lobe=lobe), points, len(points.face), seed=0)
        basis(lobe, (0.1, 0.5))


def _write_capture(folder: Path) -> None:
    (folder / "frames").mkdir(parents=True)
    points, triangles, owner = _mesh()
    write_ply(folder / "mesh.ply", points, triangles, owner)
    names = [{"id": i, "name": name, "class_name": name} for i, name in enumerate(_SQUARES)]
    write_json(folder / "objects.json", {"objects": names})
    radiance = np.array([*(each[3] for each in _SQUARES.values()), 0.0], np.float32)
    scene, rng, frames = RayScene(points, triangles), np.random.default_rng(0), []
    for i in range(_FRAMES):
        camera = Camera(
            world_from_camera=_pose(2 * np.pi * i / _FRAMES, _LOOKED_AT[i % len(_LOOKED_AT)]),
            intrinsics=_LENS,
            width=_WIDTH,
            height=_HEIGHT,
        )
        face = scene.closest(*camera.rays(camera.pixels())).face
        seen = radiance[np.where(face >= 0, owner[face], len(_SQUARES))]
        noise = 1 + 0.02 * rng.standard_normal((len(seen), 3))
        image = (seen[:, None] * noise).reshape(_HEIGHT, _WIDTH, 3).astype(np.float32)
        write_exr(folder / f"frames/{i:02d}.exr", image)
        frames.append(
            {
                "file_path": f"frames/{i:02d}.exr",
                "transform_matrix": camera.world_from_camera.tolist(),
                "exposure_time": 0.02,
                "saturation_radiance": 64.0,
                "noise_floor_radiance": 0.001,
            }
        )
    size = {"camera_model": "PINHOLE", "w": _WIDTH, "h": _HEIGHT}
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), _LENS, strict=True))
    write_json(folder / "transforms.json", {**size, **lens, "frames": frames})


def _mesh() -> tuple[Float, Int, Int]:
    corners = [np.array(each[:3]) for each in _SQUARES.values()]
    points = np.concatenate([[o, o + u, o + u + v, o + v] for o, u, v in corners])
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.concatenate([first + half for half in _HALVES], axis=1).reshape(-1, 3)
    owner = np.repeat(np.arange(len(corners)), 2)
    return points.astype(np.float32), triangles.astype(np.int32), owner.astype(np.int32)


def _scene() -> Scene:
    """The room with an atlas of its own for each square, all covered."""
    points, triangles, owner = _mesh()
    objects = tuple(
        SceneObject(
            prim_path=f"/room/{name}", identifier=name, label=name, class_name=name,
            first_face=2 * i, num_faces=2,
        )
        for i, name in enumerate(_SQUARES)
    )  # fmt: skip
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Scene(
        objects=objects,
        points=points,
        triangles=triangles,
        corner_normals=corner_normals(points, triangles, 30.0),
        face_object=owner,
        corner_uv=np.tile(corners[np.array(_HALVES)], (len(_SQUARES), 1, 1)),
    )


def _pose(angle: float, target: Sequence[float]) -> Double:
    """World from camera: from an ellipse about the table towards the target."""
    centre = np.array([2 + 1.3 * np.cos(angle), 1.5 + 1.1 * np.sin(angle), 1.5])
    back = (centre - target) / np.linalg.norm(centre - target)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return pose
