"""A capture with pinhole frames, rewritten as if it had been taken through a lens.

    python benchmarks/lenses.py CAPTURE OUTPUT MODEL [--scale S]

CAPTURE is a folder with transforms.json, as `samples/study`; MODEL is OPENCV, OPENCV_FISHEYE or
EQUIRECTANGULAR. The frames are resampled from the capture's own by a cubic spline, with the rays of
pycolmap's cameras, S times as fine (1); what they do not show is black in the masks. Convert both
and compare them with `benchmarks/accuracy.py`: what differs is what lens, faces and resampling
cost.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from disturb_capture import DOCUMENT, copy_unchanged
from scipy import ndimage

from usdbrdf.files.images import read_radiance, write_exr, write_preview_png

Array = npt.NDArray[Any]
# What follows focal lengths and principal point, by the names of the document.
DISTORTION: dict[str, dict[str, float]] = {
    "OPENCV": {"k1": -0.12, "k2": 0.03, "p1": 0.001, "p2": -0.0015},
    "OPENCV_FISHEYE": {"k1": -0.03, "k2": 0.004, "k3": 0.0, "k4": 0.0},
    "EQUIRECTANGULAR": {},
}
SHARE_CLIPPED = 0.998


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("model", choices=DISTORTION)
    parser.add_argument("--scale", type=float, default=1.0, metavar="S")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")

    document = json.loads((options.capture / DOCUMENT).read_text())
    frames = document["frames"]
    copy_unchanged(options.capture, options.output, {frame["file_path"] for frame in frames})
    camera, words = lens_camera(document, options.model, options.scale)
    places = places_in_pinhole(camera, document)
    for frame in frames:
        pixels, mask = resampled(options.capture, frame, places)
        image = options.output / frame["file_path"]
        image.parent.mkdir(parents=True, exist_ok=True)
        write_exr(image, pixels)
        frame["mask_path"] = f"masks/{image.stem}.png"
        (options.output / "masks").mkdir(exist_ok=True)
        shown = np.repeat(np.uint8(255) * mask[..., None], 3, axis=2)
        write_preview_png(options.output / frame["mask_path"], shown)
    document.update(words)
    (options.output / DOCUMENT).write_text(json.dumps(document, indent=1) + "\n")
    print(f"{len(frames)} frames of {words['w']} x {words['h']} pixels, {options.model}")
    return 0


def lens_camera(document: dict[str, Any], model: str, scale: float) -> tuple[Any, dict[str, Any]]:
    """pycolmap's camera, and what the document says of it."""
    focal = scale * document["fl_x"]
    if model == "EQUIRECTANGULAR":
        width = 2 * round(np.pi * focal)
        size, numbers = (width, width // 2), [width, width // 2]
    else:
        size = (round(scale * document["w"]), round(scale * document["h"]))
        numbers = [focal, focal, size[0] / 2, size[1] / 2, *DISTORTION[model].values()]
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=numbers)
    words = {"camera_model": model, "w": size[0], "h": size[1], **DISTORTION[model]}
    named = dict(
        zip(("fl_x", "fl_y", "cx", "cy"), (focal, focal, size[0] / 2, size[1] / 2), strict=True)
    )
    return camera, words | named


def places_in_pinhole(camera: Any, document: dict[str, Any]) -> Array:
    """(h, w, 2): where the capture's frame shows what the lens' pixels look at; NaN for nowhere."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.cam_ray_from_img(np.stack([x, y], axis=-1).reshape(-1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(rays[:, 2:] > 1e-6, rays[:, :2] / rays[:, 2:], np.nan)
    focal, middle = (document["fl_x"], document["fl_y"]), (document["cx"], document["cy"])
    places = plane * focal + middle
    outside = ~((places >= 0.5) & (places <= np.array([document["w"], document["h"]]) - 0.5))
    places[outside.any(axis=1)] = np.nan
    return np.asarray(places.reshape(camera.height, camera.width, 2))


def resampled(capture: Path, frame: dict[str, Any], places: Array) -> tuple[Array, Array]:
    """The frame (h, w, 3) float32 through the lens, and where it shows anything."""
    source = read_radiance(capture / frame["file_path"])
    full = frame.get("saturation_radiance", float("inf"))
    known = np.isfinite(places[..., 0])
    column, row = np.nan_to_num(places[..., 0]) - 0.5, np.nan_to_num(places[..., 1]) - 0.5
    pixels = np.zeros((*known.shape, 3), np.float32)
    low, high = source.copy(), source.copy()
    for shift in ((1, 0), (0, 1), (1, 1)):
        beside = np.pad(source, ((0, shift[0]), (0, shift[1]), (0, 0)), mode="edge")
        beside = beside[shift[0] :, shift[1] :]
        low, high = np.minimum(low, beside), np.maximum(high, beside)
    j, i = row.astype(int).clip(0), column.astype(int).clip(0)
    for channel in range(3):
        smooth = ndimage.map_coordinates(source[..., channel], [row, column], order=3)
        value = smooth.clip(low[j, i, channel], high[j, i, channel])
        clipped = high[j, i, channel] >= SHARE_CLIPPED * full
        pixels[..., channel] = np.where(known, np.where(clipped, full, value), 0)
    return pixels, known


if __name__ == "__main__":
    sys.exit(main())
