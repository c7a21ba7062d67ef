"""Small captures through lenses: pycolmap tells the ray of each pixel, Embree what it meets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy import ndimage

from tests.scenes import MadeCapture, make_capture
from usdbrdf.files.images import write_exr
from usdbrdf.transport.rays import RayScene

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
# Model -> width, height and parameters.
CAMERAS = {
    "PINHOLE": (48, 36, (30.0, 31.0, 24.5, 17.5)),
    "OPENCV": (48, 36, (30.0, 31.0, 24.5, 17.5, -0.12, 0.03, 0.002, -0.001)),
    "OPENCV_FISHEYE": (48, 36, (20.0, 20.5, 24.5, 17.5, -0.02, 0.004, 0.0, 0.0)),
    "EQUIRECTANGULAR": (96, 48, (96, 48)),
}


def camera_of(model, scale=1):
    import pycolmap

    width, height, numbers = CAMERAS[model]
    camera = pycolmap.Camera(model=model, width=width, height=height, params=list(numbers))
    if scale != 1:
        camera.rescale(scale)
    return camera


def rays_of(camera):
    """(h, w, 3) unit directions of the pixels' centres, x right, y up, looking down -z; NaN where
    pycolmap finds none."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.cam_ray_from_img(np.stack([x, y], axis=-1).reshape(-1, 2))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return (rays @ OPENGL_FROM_OPENCV).reshape(camera.height, camera.width, 3)


def seen_through(camera, pose, made: MadeCapture):
    """(h, w, 3) float32 radiance of the first surfaces."""
    rays = rays_of(camera).reshape(-1, 3) @ pose[:3, :3].T
    scene = RayScene(made.points, made.triangles)
    origins = np.broadcast_to(pose[:3, 3], rays.shape).astype(np.float32)
    face = scene.closest(np.ascontiguousarray(origins), rays.astype(np.float32)).face
    table = np.array([*(made.radiance[name] for name in made.names), (0, 0, 0)], np.float32)
    shown = np.where(face >= 0, made.face_object[face], len(made.names))
    return table[shown].reshape(camera.height, camera.width, 3)


def capture_through(folder: Path, model: str, *, frames: int = 10, scale=1) -> MadeCapture:
    """The box room of ``make_capture`` with its frames through a lens, in nerfstudio's words."""
    made = make_capture(folder, frames=frames)
    camera = camera_of(model, scale)
    document = json.loads(made.manifest.read_text())
    for i, frame in enumerate(document["frames"]):
        write_exr(made.image(i), seen_through(camera, made.world_from_camera[i], made))
        frame["saturation_radiance"] = 64.0
    numbers = [float(n) for n in camera.params]
    named = ("fl_x", "fl_y", "cx", "cy")
    more = ("k1", "k2", "k3", "k4") if "FISHEYE" in model else ("k1", "k2", "p1", "p2")
    if model == "EQUIRECTANGULAR":
        numbers = []
    document |= {"w": camera.width, "h": camera.height, "camera_model": model}
    document |= dict(zip((*named, *more), numbers, strict=False))
    made.manifest.write_text(json.dumps(document))
    return made


def surface_of(made: MadeCapture, camera):
    """Object numbers (h, w) that a pinhole camera sees, -1 near edges and for nothing."""
    scene = RayScene(made.points, made.triangles)
    face = scene.closest(*camera.rays(camera.pixels())).face
    shown = np.where(face >= 0, made.face_object[face], -1).reshape(camera.height, camera.width)
    around = np.ones((9, 9))
    same = ndimage.minimum_filter(shown, footprint=around) == ndimage.maximum_filter(
        shown, footprint=around
    )
    return np.where(same, shown, -1)
