"""A synthetic capture of any size, quickly, to measure speed and memory on.

    python benchmarks/generated_capture.py OUTPUT [--frames 30] [--width 1224] [--height 1024]
        [--triangles 200000] [--objects 100] [--threads N]

A room of 8 x 6 x 3 m with boxes and turned shapes on its floor and one lamp that saturates, seen
from a path through its middle. Radiance is analytic: a pattern on every object, lit by a point
below the ceiling without shadows, and a highlight that depends on the view, with 1 % of noise.
Frames are half float EXR with ZIP. The same numbers give the same files; the texel size is chosen
when the capture is converted (`--texel-size`, `--max-texels`).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.files.images import write_exr
from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.camera import Camera
from usdbrdf.transport.rays import RayScene

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
from study_camera import look_at
from study_shapes import Array, Mesh, box, rectangle, turned

ROOM = np.array([8.0, 6.0, 3.0])
LIGHT = np.array([4.0, 3.0, 2.7])
LAMP_RADIANCE, SATURATION, NOISE_FLOOR, NOISE = 40.0, 8.0, 1e-4, 0.01
# Of a width of the image; 68 degrees across.
FOCAL = 0.74


class Scene(NamedTuple):
    """points (V, 3) float32, triangles (F, 3) int32, owner (F,) int32, names per object."""

    points: np.ndarray
    triangles: np.ndarray
    owner: np.ndarray
    names: list[str]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--width", type=int, default=1224)
    parser.add_argument("--height", type=int, default=1024)
    parser.add_argument("--triangles", type=int, default=200_000)
    parser.add_argument("--objects", type=int, default=100, help="at least 8")
    parser.add_argument("--threads", type=int, default=2, help="frames encoded at a time")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")
    if options.objects < 8:
        parser.error("the room and its lamp are 7 objects already. Ask for 8 or more.")

    scene = generated_scene(options.objects, options.triangles)
    (options.output / "frames").mkdir(parents=True)
    write_mesh(options.output, scene)
    write_frames(options.output, scene, options)
    print(
        f"{options.frames} frames, {len(scene.triangles):,} triangles, {len(scene.names)} objects"
    )
    return 0


def write_tiny(folder: Path) -> None:
    """A room of eight objects in twelve frames, so small that each step takes about a second."""
    (folder / "frames").mkdir(parents=True)
    scene = generated_scene(8, 200)
    write_mesh(folder, scene)
    size = argparse.Namespace(output=folder, frames=12, width=24, height=18, threads=1)
    write_frames(folder, scene, size)


def generated_scene(objects: int, triangles: int) -> Scene:
    """The room, its lamp and the things in it; edges as long as the number of triangles wants."""
    coarse = assembled(shapes(objects, 0.2))
    edge = 0.2
    for _ in range(6):  # round numbers of rows make this a search
        edge *= math.sqrt(len(coarse.triangles) / triangles)
        coarse = assembled(shapes(objects, edge))
    return coarse


def assembled(parts: list[tuple[str, Mesh]]) -> Scene:
    meshes = [mesh for _, mesh in parts]
    first = np.cumsum([0] + [len(points) for points, _ in meshes])
    return Scene(
        points=np.concatenate([points for points, _ in meshes]).astype(np.float32),
        triangles=np.concatenate(
            [faces + start for (_, faces), start in zip(meshes, first, strict=False)]
        ).astype(np.int32),
        owner=np.repeat(np.arange(len(meshes), dtype=np.int32), [len(f) for _, f in meshes]),
        names=[name for name, _ in parts],
    )


def shapes(objects: int, edge: float) -> list[tuple[str, Mesh]]:
    """Room shell (faces inward), lamp, and the things on a lattice of cells on the floor."""
    x, y, z = np.diag(ROOM)
    corner = np.zeros(3)
    parts = [
        ("floor", rectangle(corner, x, y, edge)),
        ("ceiling", rectangle(z, y, x, edge)),
        ("wall_south", rectangle(corner, z, x, edge)),
        ("wall_north", rectangle(y, x, z, edge)),
        ("wall_west", rectangle(corner, y, z, edge)),
        ("wall_east", rectangle(x, z, y, edge)),
        ("lamp", box((3.6, 2.7, 2.9), (4.4, 3.3, 2.98), edge)),
    ]
    things = objects - len(parts)
    columns = math.ceil(math.sqrt(things * ROOM[0] / ROOM[1]))
    rows = math.ceil(things / columns)
    cell = np.array([(ROOM[0] - 0.6) / columns, (ROOM[1] - 0.6) / rows])
    rng = np.random.default_rng(0)
    for k in range(things):
        centre = 0.3 + cell * [k % columns + 0.5, k // columns + 0.5]
        half = cell.min() * rng.uniform(0.2, 0.4)
        height = min(0.9, cell.min() * rng.uniform(0.4, 1.5))
        if k % 2:
            low, high = (*(centre - half), 0.0), (*(centre + half), height)
            parts.append((f"box_{k:04d}", box(low, high, edge, without="d")))
        else:
            parts.append((f"vase_{k:04d}", vase(centre, half, height, edge)))
    return parts


def vase(centre: Array, radius: float, height: float, edge: float) -> Mesh:
    """A closed surface of revolution with two bellies, standing on the floor."""
    rings = max(4, round(1.5 * height / edge))
    t = np.arange(rings + 1) / rings
    outline = radius * (0.25 + 0.75 * np.abs(np.sin(2.6 * np.pi * t + 0.6))) * (1 - t**8)
    outline[-1] = 0.02 * radius
    segments = max(6, round(2 * np.pi * 0.6 * radius / edge))
    return turned((centre[0], centre[1]), np.column_stack([outline, t * height]), segments)


def write_mesh(folder: Path, scene: Scene) -> None:
    """mesh.ply with the int face property object_id, and objects.json."""
    face = np.dtype([("count", "u1"), ("vertices", "<i4", 3), ("object_id", "<i4")])
    faces = np.zeros(len(scene.triangles), face)
    faces["count"], faces["vertices"], faces["object_id"] = 3, scene.triangles, scene.owner
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(scene.points)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "property int object_id\nend_header\n"
    )
    with (folder / "mesh.ply").open("wb") as file:
        file.write(header.encode())
        file.write(scene.points.astype("<f4").tobytes())
        file.write(faces.tobytes())
    labels = [
        {"id": k, "name": name, "class_name": name.split("_")[0]}
        for k, name in enumerate(scene.names)
    ]
    (folder / "objects.json").write_text(json.dumps({"objects": labels}, indent=1) + "\n")


def pose(k: int, frames: int) -> Array:
    """On an orbit through the room that never comes back to the same place."""
    angle = 2 * np.pi * (3.3 * k / frames + 0.01)
    place = ROOM / 2 + np.array([1.9 * np.cos(angle), 1.3 * np.sin(angle), 0.3 * np.sin(7 * angle)])
    turn = angle + np.pi * (0.35 + 0.5 * np.sin(5.3 * angle))
    ahead = np.array([3 * np.cos(turn), 3 * np.sin(turn), (-1.6, -0.6, 0.3, -1.2, 1.2)[k % 5]])
    return look_at(place, place + ahead)


def write_frames(folder: Path, scene: Scene, options: argparse.Namespace) -> None:
    """All images, and transforms.json last."""
    width, height = options.width, options.height
    lens = (FOCAL * width, FOCAL * width, width / 2, height / 2)
    rays = RayScene(scene.points, scene.triangles)
    poses = [pose(k, options.frames) for k in range(options.frames)]
    names = [f"frames/{k:04d}.exr" for k in range(options.frames)]
    with ThreadPoolExecutor(max_workers=options.threads) as pool:
        writing = []
        for k, (name, there) in enumerate(zip(names, poses, strict=True)):
            camera = Camera(world_from_camera=there, intrinsics=lens, width=width, height=height)
            image = photograph(scene, rays, camera, np.random.default_rng(k))
            while len(writing) > options.threads:
                writing.pop(0).result()
            writing.append(pool.submit(write_exr, folder / name, image))
        for job in writing:
            job.result()
    camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), lens, strict=True))
    document = {
        "camera_model": "PINHOLE", "w": width, "h": height, **camera,
        "mesh": "mesh.ply", "objects": "objects.json",
        "exposure_time": 0.02, "saturation_radiance": SATURATION,
        "noise_floor_radiance": NOISE_FLOOR,
        "frames": [
            {"file_path": name, "transform_matrix": camera.tolist()}
            for name, camera in zip(names, poses, strict=True)
        ],
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(document, indent=1) + "\n")


def photograph(
    scene: Scene, rays: RayScene, camera: Camera, rng: np.random.Generator
) -> np.ndarray:
    """(H, W, 3) float32 radiance, cut at the saturation."""
    origins, directions = camera.rays(camera.pixels())
    hits = rays.closest(origins, directions)
    # As a sensor's noise: what a coder cannot compress.
    image = rng.standard_normal((len(hits.face), 3), np.float32)
    lamp = scene.names.index("lamp")
    shade(len(hits.face), scene.points, scene.triangles, scene.owner, hits.face, hits.distance,
          directions, camera.eye.copy(), LIGHT, lamp, image)  # fmt: skip
    return image.reshape(camera.height, camera.width, 3)


@parallel_kernel
def shade(
    first: int,
    last: int,
    points: np.ndarray,
    triangles: np.ndarray,
    owner: np.ndarray,
    face: np.ndarray,
    distance: np.ndarray,
    directions: np.ndarray,
    eye: Array,
    light: Array,
    lamp: int,
    image: np.ndarray,
) -> None:
    for r in range(first, last):
        f = face[r]
        if f < 0:
            image[r] = 0
            continue
        own = owner[f]
        d = directions[r].astype(np.float64)
        p = eye + distance[r] * d
        a = points[triangles[f, 0]].astype(np.float64)
        n = np.cross(points[triangles[f, 1]] - a, points[triangles[f, 2]] - a)
        n /= max(math.sqrt((n**2).sum()), 1e-30)
        if (n * d).sum() > 0:
            n = -n
        to_light = light - p
        away = math.sqrt((to_light**2).sum())
        to_light /= away
        half = to_light - d
        half /= max(math.sqrt((half**2).sum()), 1e-12)
        cosine = max(0.0, (n * to_light).sum())
        gloss = 0.1 * (own % 4)
        highlight = gloss * max(0.0, (n * half).sum()) ** (20.0 + 40.0 * (own % 3)) / away
        pattern = (
            0.5
            + 0.25 * math.sin(9 * p[0] + own) * math.sin(11 * p[1])
            + 0.2 * math.sin(13 * p[2] + 5 * p[0])
        )
        for c in range(3):
            albedo = (0.3 + 0.2 * math.sin(1.7 * own + 2.1 * c)) * (0.5 + pattern)
            value = albedo * (0.15 + 1.5 * cosine / (0.3 + away * away)) + highlight
            value = (LAMP_RADIANCE if own == lamp else value) * (1 + NOISE * image[r, c])
            image[r, c] = min(max(value, 0.0), SATURATION)


if __name__ == "__main__":
    sys.exit(main())
