"""Speed and memory of texturing: frames per second, its parts, and against stored samples.

    python benchmarks/texturing.py ASSET [--frames N] [--json FILE]

ASSET has been textured, for instance from benchmarks/generated_capture.py:

    python benchmarks/generated_capture.py CAPTURE
    usdbrdf ingest CAPTURE -o ASSET && usdbrdf texture ASSET --texel-size 0.0168

Printed are JSON and one row of a Markdown table. CPU seconds are of all threads; on a machine that
others use too they, and ratios, say more than the clock. `late_to_early` is the CPU time of the
same frames with all of them in the state already, over that with an empty one. The reference keeps
every sample and takes NumPy's median of each texel. Threads that wait for work burn CPU time unless
OMP_WAIT_POLICY=PASSIVE is in the environment.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from measure import figure

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.files.frames import read_frame
from usdbrdf.model.capture import Frames
from usdbrdf.texturing import psquare
from usdbrdf.texturing.exposures import Probes
from usdbrdf.texturing.observe import Observation, blocks_of_texels, samples_from_frames
from usdbrdf.texturing.samples import (
    MIN_COSINE,
    SAMPLE,
    Picture,
    first_surfaces,
    samples_from_frame,
)
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import RayScene

QUANTILE = 0.5
T = TypeVar("T")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--frames", type=int, help="only the first N")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()

    results = measure(options.asset, options.frames)
    text = json.dumps(results, indent=2)
    print(text)
    print(row(results))
    if options.json:
        options.json.write_text(text + "\n")
    return 0


def measure(asset: Path, most: int | None) -> dict[str, Any]:
    """All figures, of the first ``most`` frames."""
    stage = open_measured(Asset.at(asset))
    atlas, frames = AssetMaps(stage), frames_from_stage(stage)
    count = min(most or len(frames), len(frames))
    rays = RayScene(atlas.scene.points, atlas.scene.triangles)
    streamed(atlas, rays, frames, nothing(atlas, frames), 2)  # compiles

    observed = nothing(atlas, frames)
    early, wall = streamed(atlas, rays, frames, observed, count)
    median = psquare.quantile(observed.quantiles, QUANTILE)
    late, _ = streamed(atlas, rays, frames, observed, count)
    spent, samples = by_parts(atlas, rays, frames, count)
    exact = stored_median(samples)
    return {
        "frames": count,
        "resolution": frames.resolution[0].tolist(),
        "texels": len(atlas.texels),
        "triangles": len(atlas.scene.triangles),
        "cores": os.cpu_count(),
        "frames_per_second": count / wall,
        "cpu_s_per_frame": early / count,
        "frames_per_second_of_two_cores": 2 * count / early,
        "late_to_early": late / early,
        "state_bytes_per_texel": sum(a.nbytes for a in observed.arrays().values())
        / len(atlas.texels),
        "share": {name: used / sum(spent.values()) for name, used in spent.items()},
        "psquare_cpu_s": spent["psquare"],
        "stored": {
            "cpu_s": exact["cpu_s"],
            "bytes_per_texel": exact["bytes"] / len(atlas.texels),
            "median_abs_difference": difference(median, exact),
        },
    }


def figures(results: dict[str, Any]) -> list[dict[str, Any]]:
    """For the table of all benchmarks."""
    stored = results["stored"]
    return [
        figure("CPU per frame", 1000 * results["cpu_s_per_frame"], "ms"),
        figure("frames per second of two cores", results["frames_per_second_of_two_cores"], ""),
        figure("the last frames' time over the first ones'", results["late_to_early"], "x"),
        figure("NumPy median of stored samples over ours, CPU",
               stored["cpu_s"] / results["psquare_cpu_s"], "x"),
        figure("bytes per texel, stored samples over ours",
               stored["bytes_per_texel"] / results["state_bytes_per_texel"], "x"),
    ]  # fmt: skip


def nothing(atlas: AssetMaps, frames: Frames) -> Observation:
    """The state before the first frame."""
    count = len(atlas.texels)
    return Observation.empty(slice(0, count), Probes.empty(count, len(frames)))


def streamed(
    atlas: AssetMaps, rays: RayScene, frames: Frames, observed: Observation, count: int
) -> tuple[float, float]:
    """CPU and wall seconds of the first ``count`` frames, from one frame's end to another's."""
    read = functools.partial(read_frame, frames)
    surface = TexturedScene(atlas.scene, atlas.texels, rays)
    cpu, wall = time.process_time(), time.perf_counter()
    for some in samples_from_frames(surface, frames, read, range(count)):
        observed.add(some, QUANTILE)
    return time.process_time() - cpu, time.perf_counter() - wall


def by_parts(
    atlas: AssetMaps, rays: RayScene, frames: Frames, count: int
) -> tuple[dict[str, float], list[tuple[np.ndarray, np.ndarray]]]:
    """CPU seconds of each part, one after the other; and every frame's texels and radiances."""
    spent: dict[str, float] = defaultdict(float)

    def timed(name: str, work: Callable[..., T], *arguments: Any) -> T:
        start = time.process_time()
        result = work(*arguments)
        spent[name] += time.process_time() - start
        return result

    texels, owner = atlas.texels, atlas.texels.object_index()
    blocks = blocks_of_texels(texels, slice(0, len(texels)))
    observed = nothing(atlas, frames)
    samples = []
    for i in range(count):
        camera = frames.camera(i)
        pixels = timed("read", read_frame, frames, i)
        which = timed("cull", blocks.texels_in_view, camera, MIN_COSINE)
        face_object = atlas.scene.face_object
        surfaces = timed("occlusion", first_surfaces, rays, face_object, camera)
        kind, radiance = timed(
            "sample",
            functools.partial(samples_from_frame, which=which),
            texels,
            owner,
            surfaces,
            Picture(pixels.radiance, pixels.valid, pixels.clipped, pixels.dark),
            camera,
        )
        taken = which[kind == SAMPLE], radiance[kind == SAMPLE]
        timed("psquare", psquare.update, observed.quantiles, *taken, QUANTILE)
        samples.append(taken)
    return dict(spent), samples


def stored_median(samples: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """NumPy's median of every texel's samples, all of them kept: texels and medians, CPU seconds
    and bytes."""
    start = time.process_time()
    texel = np.concatenate([index for index, _ in samples])
    radiance = np.concatenate([values for _, values in samples])
    order = np.argsort(texel, kind="stable")
    texel, radiance = texel[order], radiance[order]
    first = np.flatnonzero(np.diff(texel, prepend=-1))
    seen = np.diff(np.append(first, len(texel)))
    median = np.empty((len(first), 3), np.float32)
    for count in np.unique(seen):
        own = seen == count
        rows = first[own, None] + np.arange(count)
        median[own] = np.median(radiance[rows], axis=1)
    return {
        "texel": texel[first],
        "count": seen,
        "median": median,
        "cpu_s": time.process_time() - start,
        "bytes": texel.nbytes + radiance.nbytes,
    }


def difference(median: np.ndarray, exact: dict[str, Any]) -> float:
    """Median relative difference of the streaming median from the exact one, of texels with more
    than the five samples up to which it is exact."""
    many = exact["count"] > 5
    known = np.maximum(exact["median"][many], 1e-9)
    return float(np.median(np.abs(median[exact["texel"][many]] / known - 1)))


def row(results: dict[str, Any]) -> str:
    width, height = results["resolution"]
    share = ", ".join(f"{name} {100 * part:.0f} %" for name, part in results["share"].items())
    return (
        f"| {width} x {height} | {results['texels']:,} | {results['triangles']:,} "
        f"| {results['frames_per_second']:.1f} ({results['frames_per_second_of_two_cores']:.1f}) "
        f"| {1000 * results['cpu_s_per_frame']:.0f} ms | {share} | {results['late_to_early']:.2f} "
        f"| {results['state_bytes_per_texel']:.0f} B | "
        f"{results['stored']['cpu_s'] / results['psquare_cpu_s']:.1f} x time, "
        f"{results['stored']['bytes_per_texel']:.0f} B |"
    )


if __name__ == "__main__":
    sys.exit(main())
