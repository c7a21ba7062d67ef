"""A dark room whose glossy plate mirrors the lamp to one side alone, photographed from the other
side, with a wall that no frame shows. Lengths in metres, z up.

The plate stands upright in the plane x = PLATE_X, its front towards +x. The lamp hangs on the wall
y = 3; mirrored in the plate's plane it stands behind the plate, so that its reflection is seen from
low y. The frames stand at high y and look to low x.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.physics.brdf import f_nd
from tests.scenes import camera_at, look_at, write_ply
from usdbrdf.files.images import write_exr
from usdbrdf.transport.rays import RayScene

ROOM = (4.0, 3.0, 2.4)
PLATE_X, PLATE_Y, PLATE_Z = 0.4, (1.1, 1.9), (0.4, 1.8)
LAMP_X, LAMP_Y, LAMP_Z = (1.6, 2.4), 2.98, (0.7, 1.5)
# What a closed cabinet keeps cameras out of: low and high corner.
CABINET = ((3.0, 0.1, 0.0), (3.9, 1.1, 1.9))
RADIANCE = {
    "floor": 0.01, "ceiling": 0.012, "walls": 0.01, "east": 0.01, "plate": 0.3, "lamp": 60.0,
    "cabinet": 0.01,
}  # fmt: skip
SIZE, FOCAL = (48, 36), 30.0


def quads():
    """Name, corner and two edges; the normal is their cross product."""
    x, y, z = ROOM
    (lx, ly, lz), (hx, hy, hz) = CABINET
    a, b, c = hx - lx, hy - ly, hz - lz
    return [
        ("floor", (0, 0, 0), (x, 0, 0), (0, y, 0)),
        ("ceiling", (0, 0, z), (0, y, 0), (x, 0, 0)),
        ("walls", (0, 0, 0), (0, 0, z), (x, 0, 0)),
        ("walls", (0, y, 0), (x, 0, 0), (0, 0, z)),
        ("walls", (0, 0, 0), (0, y, 0), (0, 0, z)),
        ("east", (x, 0, 0), (0, 0, z), (0, y, 0)),
        ("plate", (PLATE_X, PLATE_Y[0], PLATE_Z[0]), (0, 0.8, 0), (0, 0, 1.4)),
        ("plate", (PLATE_X - 0.02, PLATE_Y[0], PLATE_Z[0]), (0, 0, 1.4), (0, 0.8, 0)),
        # Closed: what shines on the front does not shine between the two.
        ("plate", (PLATE_X - 0.02, PLATE_Y[0], PLATE_Z[0]), (0.02, 0, 0), (0, 0, 1.4)),
        ("plate", (PLATE_X - 0.02, PLATE_Y[1], PLATE_Z[0]), (0, 0, 1.4), (0.02, 0, 0)),
        ("plate", (PLATE_X - 0.02, PLATE_Y[0], PLATE_Z[0]), (0, 0.8, 0), (0.02, 0, 0)),
        ("plate", (PLATE_X - 0.02, PLATE_Y[0], PLATE_Z[1]), (0.02, 0, 0), (0, 0.8, 0)),
        ("lamp", (LAMP_X[0], LAMP_Y, LAMP_Z[0]), (0.8, 0, 0), (0, 0, 0.8)),
        ("cabinet", (lx, ly, hz), (a, 0, 0), (0, b, 0)),
        ("cabinet", (lx, ly, lz), (0, b, 0), (a, 0, 0)),
        ("cabinet", (lx, ly, lz), (a, 0, 0), (0, 0, c)),
        ("cabinet", (lx, hy, lz), (0, 0, c), (a, 0, 0)),
        ("cabinet", (lx, ly, lz), (0, 0, c), (0, b, 0)),
        ("cabinet", (hx, ly, lz), (0, b, 0), (0, 0, c)),
    ]


def mesh(squares: int = 6):
    """points (V, 3), triangles (F, 3), object (F,), names."""
    names = tuple(dict.fromkeys(name for name, *_ in quads()))
    points, triangles, owner, first = [], [], [], 0
    steps = np.arange(squares + 1) / squares
    b, a = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps, indexing="ij"))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(squares), np.arange(squares)))
    corner = j * (squares + 1) + i
    square = np.stack([corner, corner + 1, corner + squares + 2, corner + squares + 1], axis=-1)
    for name, origin, u, v in quads():
        points.append(np.array(origin) + a * np.array(u) + b * np.array(v))
        triangles.append(square[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3) + first)
        owner.append(np.full(2 * len(square), names.index(name)))
        first += len(points[-1])
    return (
        np.concatenate(points).astype(np.float32),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate(owner).astype(np.int32),
        names,
    )


def frame_poses():
    """Eight poses at high y that look to low x, or up and down, none towards the east wall."""
    targets = [(0.4, 1.5, 1.1), (0.2, 0.6, 0.6), (0.4, 2.4, 0.2), (0.6, 1.2, 2.3)]
    return (
        [
            look_at(np.array([1.9 + 0.2 * k, 2.35 + 0.05 * k, 1.0 + 0.2 * k]), np.array(target))
            for k, target in enumerate(targets)
        ]
        + [
            look_at(np.array([1.5 + 0.2 * k, 2.6 - 0.05 * k, 1.6 - 0.2 * k]), np.array(target))
            for k, target in enumerate(targets)
        ]
        + [look_at(np.array([1.2, 1.6, 1.2]), np.array([1.9, 2.98, 1.1]))]
    )


def write_capture(folder: Path) -> Path:
    """The capture, rendered by its first surfaces, of the same radiance from everywhere."""
    (folder / "frames").mkdir(parents=True)
    points, triangles, owner, names = mesh()
    write_ply(folder / "mesh.ply", points, triangles, owner)
    labels = [{"id": k, "name": name, "class_name": name} for k, name in enumerate(names)]
    (folder / "objects.json").write_text(json.dumps({"objects": labels}))
    table = np.array([[RADIANCE[name]] * 3 for name in names], np.float32)
    rays, (width, height) = RayScene(points, triangles), SIZE
    lens = (FOCAL, FOCAL, width / 2, height / 2)
    frames, rng = [], np.random.default_rng(5)
    for k, pose in enumerate(frame_poses()):
        camera = camera_at(pose, lens, width, height)
        face = rays.closest(*camera.rays(camera.pixels())).face
        image = table[owner[face]].reshape(height, width, 3)
        noise = 1 + 0.01 * rng.standard_normal(image.shape)
        write_exr(folder / f"frames/{k}.exr", (image * noise).astype(np.float32))
        frames.append({"file_path": f"frames/{k}.exr", "transform_matrix": pose.tolist()})
    document = {
        "camera_model": "PINHOLE", "w": width, "h": height, "fl_x": FOCAL, "fl_y": FOCAL,
        "cx": width / 2, "cy": height / 2, "mesh": "mesh.ply", "objects": "objects.json",
        "exposure_time": 0.02, "saturation_radiance": 500.0, "noise_floor_radiance": 0.0002,
        "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def highlight(eye, phi: float = 0.25, psi: float = 0.5) -> float:
    """Mean radiance that the plate's front would send to ``eye`` (3,) of the lamp's light by a lobe
    of the paper, written out: the lamp is a grid of small areas."""
    if eye[0] <= PLATE_X:
        return 0.0
    steps = np.linspace(0, 1, 9)
    y, z = (grid.ravel() for grid in np.meshgrid(_at(PLATE_Y, steps), _at(PLATE_Z, steps)))
    plate = np.stack([np.full(y.size, PLATE_X), y, z], axis=1)[:, None]
    x, z = (grid.ravel() for grid in np.meshgrid(_at(LAMP_X, steps), _at(LAMP_Z, steps)))
    lamp = np.stack([x, np.full(x.size, LAMP_Y), z], axis=1)[None]
    to_lamp, to_eye = lamp - plate, eye - plate
    far = np.linalg.norm(to_lamp, axis=-1)
    w = to_lamp / far[..., None]
    wo = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    n = np.array([1.0, 0, 0])
    reflected = f_nd(np.broadcast_to(n, w.shape), w, np.broadcast_to(wo, w.shape), phi, psi)
    area = (LAMP_X[1] - LAMP_X[0]) * (LAMP_Z[1] - LAMP_Z[0]) / x.size
    light = RADIANCE["lamp"] * np.maximum(w[..., 0], 0) * w[..., 1] * area / far**2
    return float((reflected * light).sum(axis=1).mean())


def _at(ends, steps):
    return ends[0] + (ends[1] - ends[0]) * steps
