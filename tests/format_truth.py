"""One small room, rendered once, that tests of formats write in the way of each format, and the
proof that what was read is that room: mesh, cameras, objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import OpenImageIO as oiio

from tests.scenes import make_capture, ring_of_poses
from usdbrdf.files.images import read_exr
from usdbrdf.model.capture import Scan

WIDTH, HEIGHT = 32, 24
# Neither centred nor square, so that a half pixel or a swapped axis shows.
INTRINSICS = (19.5, 20.0, 15.25, 12.75)
FRAMES = 10


@dataclass(frozen=True, kw_only=True)
class Truth:
    """points (V, 3), triangles (F, 3), face_object (F,) index into names; world_from_camera
    (N, 4, 4) OpenGL; intrinsics (N, 4); images (H, W, 3) each, linear."""

    points: np.ndarray
    triangles: np.ndarray
    face_object: np.ndarray
    names: tuple[str, ...]
    world_from_camera: np.ndarray
    intrinsics: np.ndarray
    images: list[np.ndarray]

    @property
    def opencv(self) -> np.ndarray:
        """(N, 4, 4) world from camera, y down, looking down +z."""
        return self.world_from_camera @ np.diag([1.0, -1, -1, 1])

    def square(self) -> Truth:
        """With one focal length, for formats that have no other."""
        intrinsics = self.intrinsics.copy()
        intrinsics[:, 1] = intrinsics[:, 0]
        return replace(self, intrinsics=intrinsics)

    def centred(self) -> Truth:
        """With one focal length and the principal point in the middle."""
        intrinsics = self.square().intrinsics
        intrinsics[:, 2:] = WIDTH / 2, HEIGHT / 2
        return replace(self, intrinsics=intrinsics)


@cache
def truth() -> Truth:
    """The room, made once per process; nobody changes it."""
    with TemporaryDirectory() as folder:
        made = make_capture(Path(folder), frames=FRAMES, size=(WIDTH, HEIGHT), subdivisions=2)
        images = [read_exr(made.image(i)) for i in range(FRAMES)]
    return Truth(
        points=made.points,
        triangles=made.triangles,
        face_object=made.face_object,
        names=made.names,
        world_from_camera=ring_of_poses(FRAMES),
        intrinsics=np.tile(np.array(INTRINSICS), (FRAMES, 1)),
        images=images,
    )


def write_obj(path: Path, room: Truth, points: np.ndarray | None = None) -> None:
    """One group per object, in the order of the triangles."""
    lines = [
        f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in (room.points if points is None else points)
    ]
    for i, name in enumerate(room.names):
        lines.append(f"o {name}")
        lines += [f"f {a} {b} {c}" for a, b, c in room.triangles[room.face_object == i] + 1]
    path.write_text("\n".join(lines) + "\n")


def write_image(path: Path, linear: np.ndarray) -> None:
    """EXR as it is; PNG and JPEG as sRGB bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels, kind = linear.astype(np.float32), "float"
    if path.suffix != ".exr":
        code = np.where(linear < 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
        pixels, kind = np.clip(code * 255 + 0.5, 0, 255).astype(np.uint8), "uint8"
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, kind)
    if path.suffix in (".jpg", ".JPG"):
        spec.attribute("compression", "jpeg:100")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(pixels))
    assert output.close()


def assert_same(
    scan: Scan,
    room: Truth,
    *,
    points: np.ndarray | None = None,
    poses: np.ndarray | None = None,
    names: tuple[str, ...] | None = None,
) -> None:
    """The surface within 1e-4 of the room's size and what cameras see within .05 pixels, frame by
    frame. ``points`` and ``poses`` instead of the room's where the format has another frame or
    unit; ``names``, of the objects, where it knows them."""
    points = (room.points if points is None else points).astype(np.float64)
    poses = room.world_from_camera if poses is None else poses
    size = np.linalg.norm(np.ptp(points, axis=0))
    assert _spread(scan.mesh.points[scan.mesh.triangles], points[room.triangles]) < 1e-4 * size
    assert len(scan.frames) == len(poses)
    for i in range(len(poses)):
        seen = _project(scan.frames.world_from_camera[i], scan.frames.intrinsics[i], points)
        expected = _project(poses[i], room.intrinsics[i], points)
        assert np.nanmax(np.abs(seen - expected)) < 0.05, i
    np.testing.assert_array_equal(scan.frames.resolution, [(WIDTH, HEIGHT)] * len(poses))
    if names is not None:
        assert sorted(each.label for each in scan.objects) == sorted(names)


def _spread(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest distance between corners of triangles, whatever the order of these."""

    def ordered(corners: np.ndarray) -> np.ndarray:
        keys = np.round(corners.mean(axis=1), 3)
        return corners[np.lexsort(keys.T)]

    assert found.shape == expected.shape
    gaps = ordered(found.astype(np.float64))[:, :, None] - ordered(expected)[:, None]
    return float(np.linalg.norm(gaps, axis=-1).min(axis=2).max())


def _project(pose: np.ndarray, lens: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(V, 2) pixels, NaN behind the camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(all="ignore"):
        x, y = local[:, 0] / -local[:, 2], local[:, 1] / -local[:, 2]
    pixels = np.stack([lens[0] * x + lens[2], lens[3] - lens[1] * y], axis=1)
    pixels[local[:, 2] > -0.2] = np.nan
    return pixels


def radial(plane, terms):
    """Where a lens of k1, k2 ... shows a place of the plane one before it."""
    r2 = plane[0] ** 2 + plane[1] ** 2
    return tuple(p * (1 + sum(k * r2 ** (i + 1) for i, k in enumerate(terms))) for p in plane)


def brown(plane, terms):
    """As AliceVision's DistortionBrown.cpp and OpenMVG's Camera_Pinhole_Brown.hpp write it."""
    (x, y), (k1, k2, k3, t1, t2) = plane, terms
    r2 = x * x + y * y
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x + x * radial + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y,
        y + y * radial + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y,
    )


def fisheye(plane, terms):
    """As AliceVision's DistortionFisheye.cpp writes it, and OpenCV."""
    r = np.hypot(*plane)
    theta = np.arctan(r)
    bent = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(terms))
    return plane[0] * bent / r, plane[1] * bent / r


def assert_bends(camera, room, bend, terms):
    """The camera shows a place of the plane one before it where ``bend`` says."""
    plane = (0.31, -0.23)
    pixel = camera.lens.project(np.array([plane[0], -plane[1], -1.0]), camera.intrinsics)
    fx, fy, cx, cy = room.intrinsics[0]
    x, y = bend(plane, terms)
    np.testing.assert_allclose(pixel, [cx + fx * x, cy + fy * y], atol=1e-9)
