"""Pictures for people: a map on the surface, as one of the capture's cameras would see it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.images import write_preview_png
from usdbrdf.model.arrays import Float
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.transport.rays import Hits, RayScene
from usdbrdf.transport.surface_texture import surface_texture

_MAX_WIDTH = 640
# The camera is chosen among this many frames, by about this many rays through each.
_CANDIDATES, _RAYS = 64, 2000


@dataclass(frozen=True, kw_only=True)
class Overview:
    """What one camera sees first: the surface behind each pixel of a (height, width) picture."""

    scene: Scene
    hits: Hits
    height: int
    width: int

    def write(
        self, path: Path, texels: Texels, values: Float, exposure: float | None = None
    ) -> None:
        """Per-texel values (T, 3) as an 8-bit sRGB PNG; exposure None: chosen by the picture."""
        texture = surface_texture(texels, self.scene.face_object, values)
        shown = texture.at(self.hits.face, self.hits.u, self.hits.v)
        if exposure is None:
            exposure = display_exposure(shown[self.hits.face >= 0].mean(axis=1))
        picture = shown.reshape(self.height, self.width, 3)
        write_preview_png(path, to_display_srgb8(picture, exposure_scale=exposure))


def overview(scene: Scene, rays: RayScene, frames: Frames) -> Overview:
    """The view of the frame that sees the most objects, at most 640 pixels wide."""
    chosen = overview_frame(scene, rays, frames)
    width, height = (int(n) for n in frames.resolution[chosen])
    scale = min(1.0, _MAX_WIDTH / width)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    return Overview(
        scene=scene, hits=camera_hits(rays, frames, chosen, *size), width=size[0], height=size[1]
    )


def overview_frame(scene: Scene, rays: RayScene, frames: Frames) -> int:
    """The frame with the most objects in view, the first of equals."""
    count = min(len(frames), _CANDIDATES)
    candidates = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return int(max(candidates, key=lambda i: _objects_in_view(scene, rays, frames, int(i))))


def _objects_in_view(scene: Scene, rays: RayScene, frames: Frames, i: int) -> int:
    width, height = (int(n) for n in frames.resolution[i])
    scale = min(1.0, float(np.sqrt(_RAYS / (width * height))))
    hits = camera_hits(rays, frames, i, max(1, round(scale * width)), max(1, round(scale * height)))
    return len(np.unique(scene.face_object[hits.face[hits.face >= 0]]))


def camera_hits(rays: RayScene, frames: Frames, i: int, width: int, height: int) -> Hits:
    """First surfaces behind the frame's pixels, were it ``width`` x ``height`` pixels."""
    camera = frames.camera(i).at_size(width, height)
    return rays.closest(*camera.rays(camera.pixels()))
