"""A capture with wrong poses, wrong exposures or an earlier clipping, to measure what that costs.

    python benchmarks/disturb_capture.py CAPTURE OUTPUT [--pose-degrees D] [--pose-mm M]
        [--exposure-drift S] [--clip RADIANCE] [--seed N]

CAPTURE is a folder with transforms.json, as `samples/study`. Disturbed are, frame by frame:

    poses     turned about each axis of the camera by Gaussian angles of D degrees, and moved along
              each by Gaussian distances of M mm
    exposure  radiance times exp(N(0, S)), as a wrong exposure time would have it: the frame's
              saturation and noise floor are wrong by the same factor
    clipping  radiance cut at --clip, which becomes the saturation of frames that went further

The same seed gives the same capture. Files that do not change are hard links where the file system
allows; the truth stays the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from usdbrdf.files.images import read_radiance, write_exr

DOCUMENT = "transforms.json"
# Draws of one kind do not depend on whether another kind was asked for.
POSES, EXPOSURES = 0, 1

Array = npt.NDArray[np.float64]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--pose-degrees", type=float, default=0.0, metavar="D")
    parser.add_argument("--pose-mm", type=float, default=0.0, metavar="M")
    parser.add_argument("--exposure-drift", type=float, default=0.0, metavar="S")
    parser.add_argument("--clip", type=float, default=float("inf"), metavar="RADIANCE")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")

    document = json.loads((options.capture / DOCUMENT).read_text())
    frames = document["frames"]
    images = {frame["file_path"] for frame in frames}
    rng = np.random.default_rng([options.seed, EXPOSURES])
    gains = np.exp(options.exposure_drift * rng.standard_normal(len(frames)))
    copy_unchanged(options.capture, options.output, images)
    for frame, gain in zip(frames, gains, strict=True):
        disturb_image(options.capture, options.output, frame, float(gain), options.clip)
    if options.pose_degrees or options.pose_mm:
        rng = np.random.default_rng([options.seed, POSES])
        for frame in frames:
            pose = np.array(frame["transform_matrix"])
            angles = options.pose_degrees * rng.standard_normal(3)
            metres = options.pose_mm / 1000 * rng.standard_normal(3)
            frame["transform_matrix"] = disturbed_pose(pose, angles, metres).tolist()
    (options.output / DOCUMENT).write_text(json.dumps(document, indent=1) + "\n")
    print(f"{len(frames)} frames, gains {gains.min():.3f} to {gains.max():.3f}")
    return 0


def copy_unchanged(source: Path, target: Path, images: set[str]) -> None:
    """All files but the document and the frames."""
    for path in sorted(source.rglob("*")):
        name = path.relative_to(source)
        if path.is_file() and name.as_posix() not in {DOCUMENT, *images}:
            link_or_copy(path, target / name)


def link_or_copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def disturb_image(
    source: Path, target: Path, frame: dict[str, Any], gain: float, clip: float
) -> None:
    """Write one frame, and its limits into its record."""
    name = frame["file_path"]
    full = frame.get("saturation_radiance", float("inf"))
    if gain == 1 and clip >= full:
        link_or_copy(source / name, target / name)
        return
    # The sensor clips; the wrong exposure time is met only afterwards.
    full = min(full, clip)
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    write_exr(target / name, np.minimum(read_radiance(source / name), full) * np.float32(gain))
    if np.isfinite(full):
        frame["saturation_radiance"] = full * gain
    if "noise_floor_radiance" in frame:
        frame["noise_floor_radiance"] *= gain
    if "exposure_time" in frame:
        frame["exposure_time"] /= gain


def disturbed_pose(pose: Array, degrees: Array, metres: Array) -> Array:
    """(4, 4) camera to world, turned by a rotation vector and moved in the camera's own axes."""
    result = pose.copy()
    result[:3, 3] += pose[:3, :3] @ metres
    result[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(degrees)).as_matrix()
    return result


if __name__ == "__main__":
    sys.exit(main())
