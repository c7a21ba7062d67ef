"""Cycles and Hydra Storm, each in Blender's own process, which must not see our build of USD."""

import json
from pathlib import Path

import numpy as np

from tests.blender import in_blender
from usdbrdf.files.images import read_radiance

_PROGRAMS = Path(__file__).resolve().parents[2] / "benchmarks"


def _run(program, job, folder):
    document = folder / f"{program}.json"
    document.write_text(json.dumps(job))
    in_blender(_PROGRAMS / f"{program}.py", document, folder=folder, timeout=900)


def cycles(layer, views, folder, *, samples, surroundings):
    """(views, H, W, 3) float32 radiance."""
    job = {"layer": str(layer), "views": views, "out": str(folder), "denoise": False}
    _run("blender_views", job | {"samples": samples, "surroundings": surroundings}, folder)
    files = [folder / f"view_{i:02d}.exr" for i in range(len(views))]
    return np.stack([read_radiance(file)[..., :3] for file in files])


def storm(layer, camera, times, folder, *, width):
    """(times, H, W, 3) float32 radiance."""
    files = [folder / f"storm_{i:02d}.exr" for i in range(len(times))]
    frames = [
        {"camera": camera, "time": time, "width": width, "out": str(file)}
        for time, file in zip(times, files, strict=True)
    ]
    _run("storm_views", {"layer": str(layer), "frames": frames}, folder)
    return np.stack([read_radiance(file)[..., :3] for file in files])
