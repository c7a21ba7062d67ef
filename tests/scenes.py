"""Small captures with a known answer: a furnished box room, rendered by its first surfaces.

Every object has one constant radiance, the same in all directions, so that whatever is measured
can be compared with the number that was written. Faults are made by editing a good capture.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.material import turned_up
from usdbrdf.model.upright import usd_up
from usdbrdf.transport.rays import RayScene

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]

# Exact as half floats.
RADIANCE: dict[str, tuple[float, float, float]] = {
    "floor": (0.25, 0.125, 0.0625),
    "ceiling": (0.5, 0.5, 0.5),
    "walls": (0.375, 0.4375, 0.5),
    "box": (0.125, 0.25, 0.5),
    "lamp": (8.0, 7.0, 6.0),
}
ROOM = (4.0, 3.0, 2.5)  # metres


@dataclass(frozen=True, kw_only=True)
class MadeCapture:
    """A capture on disk and what it was made from.

    points (V, 3), triangles (F, 3), face_object (F,): index into ``names``
    world_from_camera (N, 4, 4); intrinsics (4,): fx, fy, cx, cy
    radiance  per object name, lin_rec709_scene
    """

    folder: Path
    points: Float
    triangles: Int
    face_object: Int
    names: tuple[str, ...]
    world_from_camera: Double
    intrinsics: Double
    radiance: dict[str, tuple[float, float, float]]

    @property
    def manifest(self) -> Path:
        return self.folder / "transforms.json"

    def image(self, i: int) -> Path:
        return self.folder / "frames" / f"{i:04d}.exr"


def make_capture(
    folder: Path,
    *,
    frames: int = 12,
    size: tuple[int, int] = (32, 24),
    room: bool = True,
    subdivisions: int = 4,
    poses: Double | None = None,
    radiance: Mapping[str, tuple[float, float, float]] | None = None,
    noise: float = 0.0,
    exposure_times: Sequence[float] = (0.02,),
    saturation_radiance: float = 64.0,
    noise_floor_radiance: float = 0.001,
    seed: int = 0,
    unit: float = 1.0,
) -> MadeCapture:
    """Write mesh.ply, objects.json, frames/*.exr and transforms.json into ``folder``.

    room                  False leaves only the box, seen closer, before a black background
    subdivisions          squares along each side of each quad
    poses                 (N, 4, 4) instead of ``ring_of_poses(frames)``
    noise                 standard deviation relative to the radiance
    exposure_times        taken in turn; the saturation and the floor of a frame scale with
                          1 / exposure, the given values belonging to the first
    unit                  factor on all that is radiance; images are floats if it is not 1
    """
    folder.mkdir(parents=True, exist_ok=True)
    points, triangles, face_object, names = room_mesh(room=room, subdivisions=subdivisions)
    shown = {**RADIANCE, **(radiance or {})}
    poses = ring_of_poses(frames) if poses is None else poses
    width, height = size
    focal = (0.6 if room else 1.2) * width
    intrinsics = np.array([focal, focal, width / 2, height / 2])
    write_ply(folder / "mesh.ply", points, triangles, face_object)
    _write_json(
        folder / "objects.json",
        {"objects": [{"id": i, "name": n, "class_name": n} for i, n in enumerate(names)]},
    )
    (folder / "frames").mkdir(exist_ok=True)
    table = np.array([*(shown[name] for name in names), (0.0, 0.0, 0.0)], np.float32)
    scene = RayScene(points, triangles)
    rng = np.random.default_rng(seed)
    entries = []
    for i, pose in enumerate(poses):
        camera = camera_at(pose, intrinsics, width, height)
        face = scene.closest(*camera.rays(camera.pixels())).face
        seen = np.where(face >= 0, face_object[face], len(names))
        image = table[seen].reshape(height, width, 3)
        image = image * (1 + noise * rng.standard_normal(image.shape))
        exposure = exposure_times[i % len(exposure_times)]
        gain = exposure_times[0] / exposure
        write_exr(
            folder / "frames" / f"{i:04d}.exr",
            np.float32(unit) * np.minimum(image, saturation_radiance * gain).astype(np.float32),
            half=unit == 1,
        )
        entries.append(
            {
                "file_path": f"frames/{i:04d}.exr",
                "transform_matrix": pose.tolist(),
                "exposure_time": exposure,
                "saturation_radiance": unit * saturation_radiance * gain,
                "noise_floor_radiance": unit * noise_floor_radiance * gain,
            }
        )
    camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), intrinsics.tolist(), strict=True))
    _write_json(
        folder / "transforms.json",
        {"camera_model": "PINHOLE", "w": width, "h": height, **camera, "frames": entries},
    )
    return MadeCapture(
        folder=folder,
        points=points,
        triangles=triangles,
        face_object=face_object,
        names=names,
        world_from_camera=poses,
        intrinsics=intrinsics,
        radiance={name: shown[name] for name in names},
    )


def rescale_images(capture: MadeCapture, factor: float) -> None:
    """Half or twice the pixels along each side of all frames, and nothing else changed."""
    for i in range(len(capture.world_from_camera)):
        image = read_exr(capture.image(i))
        image = image[::2, ::2] if factor == 0.5 else image.repeat(2, axis=0).repeat(2, axis=1)
        write_exr(capture.image(i), image)


def from_z_up(up: str) -> Double:
    """(4, 4) the capture's coordinates of which this axis is up, from those of the room as made:
    what ``upright`` does undone, after the room's z has become y where that is USD's up."""
    axis, turn = usd_up(up)
    before = np.eye(4)
    before[:3, :3] = turn.T
    return before @ turned_up("Z", axis)


def turned_capture(made: MadeCapture, folder: Path, up: str, *, stated: bool = False) -> Path:
    """The room again with another axis up; its frames stay where they are."""
    folder.mkdir(parents=True)
    turn = from_z_up(up)
    points = (made.points @ turn[:3, :3].T).astype(np.float32)
    write_ply(folder / "mesh.ply", points, made.triangles, made.face_object)
    document = json.loads(made.manifest.read_text())
    for i, frame in enumerate(document["frames"]):
        frame["file_path"] = str(made.image(i))
        frame["transform_matrix"] = (turn @ np.array(frame["transform_matrix"])).tolist()
    if stated:
        document["up_axis"] = up
    (folder / "transforms.json").write_text(json.dumps(document))
    (folder / "objects.json").write_bytes((made.folder / "objects.json").read_bytes())
    return folder


@contextmanager
def edited(path: Path) -> Iterator[dict[str, Any]]:
    """A JSON document to change in place; it is written back at the end, NaN and all."""
    document = json.loads(path.read_text())
    yield document
    path.write_text(json.dumps(document))


def as_mitsubas(capture: MadeCapture, mark: dict[str, Any]) -> None:
    """The same cameras as instant-ngp knows Mitsuba's, by such a mark: x to the left, z forward."""
    with edited(capture.manifest) as document:
        document |= mark
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, [0, 2]] *= -1
            frame["transform_matrix"] = pose.tolist()


def room_mesh(
    *, room: bool = True, subdivisions: int = 4
) -> tuple[Float, Int, Int, tuple[str, ...]]:
    """Points, triangles, object per face, names; z up, faces counter-clockwise from where one
    stands. Without ``room`` the box is alone."""
    x, y, z = ROOM
    quads: list[tuple[str, Sequence[float], Sequence[float], Sequence[float]]] = []
    if room:
        quads += [
            ("floor", (0, 0, 0), (x, 0, 0), (0, y, 0)),
            ("ceiling", (0, 0, z), (0, y, 0), (x, 0, 0)),
            ("walls", (0, 0, 0), (0, 0, z), (x, 0, 0)),
            ("walls", (0, y, 0), (x, 0, 0), (0, 0, z)),
            ("walls", (0, 0, 0), (0, y, 0), (0, 0, z)),
            ("walls", (x, 0, 0), (0, 0, z), (0, y, 0)),
            ("lamp", (1.5, 1.0, z - 0.1), (0, 1, 0), (1, 0, 0)),
        ]
    quads += [("box", *sides) for sides in _box((1.6, 1.2, 0.0), (0.8, 0.6, 0.7))]
    names = tuple(dict.fromkeys(name for name, *_ in quads))
    parts = [_grid(*map(np.array, sides), subdivisions) for _, *sides in quads]
    firsts = np.cumsum([0, *[len(p) for p, _ in parts]])
    triangles = np.concatenate([t + firsts[i] for i, (_, t) in enumerate(parts)])
    owner = np.repeat([names.index(name) for name, *_ in quads], [len(t) for _, t in parts])
    return (
        np.concatenate([p for p, _ in parts]).astype(np.float32),
        triangles.astype(np.int32),
        owner.astype(np.int32),
        names,
    )


def camera_at(pose: Double, intrinsics: Any, width: int, height: int) -> Camera:
    """fx, fy, cx, cy in pixels of a picture so wide and high."""
    return Camera(world_from_camera=pose, intrinsics=tuple(intrinsics), width=width, height=height)


def ring_of_poses(count: int, *, radius: float = 1.2, height: float = 1.4) -> Double:
    """(count, 4, 4) OpenGL cameras around the middle of the room, looking past it at the floor."""
    middle = np.array([ROOM[0] / 2, ROOM[1] / 2, 0.4])
    poses = []
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.1
        # Not quite a circle and not quite level: no two frames look alike.
        across, along = radius * np.cos(angle), 0.9 * radius * np.sin(angle)
        up = height - middle[2] + 0.2 * np.sin(3 * angle + 1)
        centre = middle + np.array([across, along, up])
        poses.append(look_at(centre, middle))
    return np.array(poses)


def poses_down_and_up(down: int, up: int) -> np.ndarray:
    """Some look down at the room from a ring, some up at its lamp."""
    lamp = np.array([2.0, 1.5, 2.4])
    places = [lamp + np.array([np.cos(a), np.sin(a), -1.3 - 0.05 * a]) for a in range(up)]
    return np.concatenate([ring_of_poses(down), [look_at(place, lamp) for place in places]])


def frames_at(poses: Sequence[Double], size: int = 64) -> Frames:
    """Pictures that nobody reads, (size, size) pixels with a right angle across."""
    count = len(poses)
    return Frames(
        image_paths=tuple(Path(f"{i}.exr") for i in range(count)),
        world_from_camera=np.stack(poses).astype(np.float64),
        intrinsics=np.full((count, 4), size / 2),
        resolution=np.full((count, 2), size, np.int32),
        exposure_time=np.ones(count),
        saturation_radiance=np.ones(count),
        noise_floor_radiance=np.zeros(count),
    )


def look_at(centre: Double, target: Double) -> Double:
    """World-from-camera matrix (4, 4), z up, looking down the camera's -z."""
    back = (centre - target) / np.linalg.norm(centre - target)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return pose


def write_ply(
    path: Path,
    points: npt.NDArray[Any],
    triangles: npt.NDArray[Any],
    object_id: npt.NDArray[Any] | None = None,
) -> None:
    """Binary PLY, optionally with the int face property ``object_id``; nothing is checked."""
    fields: list[Any] = [("count", "u1"), ("corners", "<i4", (3,))]
    label = []
    if object_id is not None:
        fields.append(("object_id", "<i4"))
        label = ["property int object_id"]
    faces = np.zeros(len(triangles), fields)
    faces["count"], faces["corners"] = 3, triangles
    if object_id is not None:
        faces["object_id"] = object_id
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *[f"property float {axis}" for axis in "xyz"],
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        *label,
        "end_header\n",
    ]
    vertices = np.ascontiguousarray(points, "<f4").tobytes()
    path.write_bytes("\n".join(header).encode() + vertices + faces.tobytes())


def _grid(origin: Double, u: Double, v: Double, n: int) -> tuple[Double, Int]:
    """A parallelogram of n x n squares whose normal is u x v."""
    steps = np.arange(n + 1) / n
    b, a = np.meshgrid(steps, steps, indexing="ij")
    points = origin + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    i, j = np.meshgrid(np.arange(n), np.arange(n))
    first = (j * (n + 1) + i).reshape(-1)
    square = np.stack([first, first + 1, first + n + 2, first + n + 1], axis=-1)
    return points, square[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)


def _box(
    low: Sequence[float], size: Sequence[float]
) -> list[tuple[Sequence[float], Sequence[float], Sequence[float]]]:
    """Sides of a box without its bottom, outward; each is a corner and two edges."""
    (x, y, z), (a, b, c) = low, size
    return [
        ((x, y, z + c), (a, 0, 0), (0, b, 0)),
        ((x, y, z), (a, 0, 0), (0, 0, c)),
        ((x, y + b, z), (0, 0, c), (a, 0, 0)),
        ((x, y, z), (0, 0, c), (0, b, 0)),
        ((x + a, y, z), (0, b, 0), (0, 0, c)),
    ]


def _write_json(path: Path, document: Any) -> None:
    path.write_text(json.dumps(document, indent=1))
