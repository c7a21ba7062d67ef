"""How bright a rendered capture's frames are beside its true scene, by Mitsuba 3.

    export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*/libLLVM.so.19.1)
    python benchmarks/frames_against_reference.py CAPTURE [--every 3] [--samples 16] [--max-depth N]

A denoiser that took the noise out of a capture's frames may have taken light too. What the frames
lack, L_d lacks as well, however it is found: so this belongs beside `against_reference.py`, which
compares L_d with the true light. CAPTURE is as for `path_traced_irradiance.py`.

Every so many frames are rendered again from where they were taken, and the sums of radiance over
all squares of 8 x 8 pixels compared in which the frame knows every pixel: noise does not move a
ratio of sums as it moves a median. Printed as JSON: the frames' sum over the reference's, minus 1,
of each channel, of all frames together with its standard error over the frames, and of each.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.frames import read_frame
from usdbrdf.job.progress import progress
from usdbrdf.model.capture import Frames
from usdbrdf.options import IngestOptions
from usdbrdf.relighting.render import pinhole

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
import make_study
import mitsuba as mi
from true_scene import true_objects

SQUARE = 8  # pixels
Array = np.ndarray


class Sums(NamedTuple):
    """Radiance of one frame and of its reference, (3,) each, over its known squares."""

    frame: Array
    reference: Array


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--every", type=int, default=3, help="use each such frame (%(default)s)")
    parser.add_argument("--samples", type=int, default=16, help="paths per pixel (%(default)s)")
    parser.add_argument("--max-depth", type=int, default=make_study.MAX_DEPTH)
    options = parser.parse_args()

    frames = read_scan(options.capture, IngestOptions()).frames
    scene = make_study.mitsuba_scene(true_objects(options.capture))
    integrator = mi.load_dict(
        {"type": "path", "max_depth": options.max_depth, "rr_depth": make_study.ROULETTE_DEPTH}
    )
    chosen = range(0, len(frames), options.every)
    sums = {
        i: compared(frames, i, scene, integrator, options.samples)
        for i in progress(chosen, total=len(chosen), label="render", unit="frames")
    }
    sums = {i: one for i, one in sums.items() if one.reference.all()}
    if not sums:
        raise SystemExit(f"{options.capture}: no frame has a square of known pixels")
    frame, reference = (np.stack(some) for some in zip(*sums.values(), strict=True))
    excess = (frame - reference * frame.sum(axis=0) / reference.sum(axis=0)) / reference.sum(axis=0)
    report = {
        "frames": len(sums),
        "relative": rounded(frame.sum(axis=0) / reference.sum(axis=0) - 1),
        "standard_error": rounded(np.sqrt((excess**2).sum(axis=0))),
        "each": {i: rounded(one.frame / one.reference - 1) for i, one in sums.items()},
    }
    print(json.dumps(report, indent=2))
    return 0


def compared(
    frames: Frames, i: int, scene: mi.Scene, integrator: mi.Integrator, samples: int
) -> Sums:
    """The sums of frame ``i``, and of what the true scene shows from there."""
    pixels, sensor = read_frame(frames, i), pinhole_of(frames, i)
    image = mi.render(scene, sensor=sensor, spp=samples, seed=i, integrator=integrator)
    known = squares(pixels.valid.astype(np.float64)[..., None])[..., 0] == 1
    frame, reference = (
        squares(np.asarray(values, np.float64))[known].sum(axis=0)
        for values in (np.nan_to_num(pixels.radiance), image)
    )
    return Sums(frame, reference)


def pinhole_of(frames: Frames, i: int) -> mi.Sensor:
    camera = frames.camera(i)
    fx, fy, _, cy = camera.intrinsics
    if abs(fx - fy) > 1e-6 * fx:
        raise SystemExit(f"frame {i}: its pixels are not square, which is not provided for here")
    return pinhole(mi, camera, camera.height, cy)


def squares(image: Array) -> Array:
    """Means of (H, W, C) over squares of pixels; what is left at the edges is dropped."""
    height, width = (size // SQUARE for size in image.shape[:2])
    whole = image[: height * SQUARE, : width * SQUARE]
    return whole.reshape(height, SQUARE, width, SQUARE, -1).mean(axis=(1, 3))


def rounded(values: Array) -> list[float]:
    return [round(float(value), 5) for value in values]


if __name__ == "__main__":
    sys.exit(main())
