"""Speed and noise of the irradiance, each against a reference of the same run.

    python benchmarks/shading.py ASSET [-o FOLDER] [--quick]

ASSET was shaded. Measured are

    throughput  rays per second of the whole estimator (make rays, trace them, add up) over those of
                embreex when it is called with the very same rays in the same order and nothing else
    order       first hits in our order, one sample's rays after the other's over tiles of 8 x 8
                texels and as the estimator traces them, a group's parallel rays in a packet;
                against the same rays in random order, one by one; and beside that our order one by
                one, and random order in packets
    noise       relative RMSE of S against a converged one for 10,000 independent cosine-distributed
                rays (the paper's) and for ours with and without the lightmap filter; rays and time
                for equal noise
    bias        mean relative difference from the converged S over its standard error, of many seeds

Times are medians of turns taken side by side, CPU seconds of all threads and wall seconds.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from irradiance_noise import Sizes, bias, noise, shaded
from measure import (
    Lit,
    figure,
    lit_asset,
    median,
    parser_of,
    ratio,
    report,
    saved_plot,
    side_by_side,
)

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.options import Sampling
from usdbrdf.transport import irradiance
from usdbrdf.transport.irradiance import tiles_of_texels, whole_tiles
from usdbrdf.transport.rays import RayScene, closest_hits, closest_hits_of_groups, empty_hits
from usdbrdf.transport.sampling_loops import (
    Met,
    Receivers,
    cosine_directions,
    empty_picked,
    empty_segments,
    frames_of,
    light_segments,
    turns,
)
from usdbrdf.transport.surface_texture import AHEAD
from usdbrdf.transport.tile_draws import groups_of

THREADS = os.cpu_count() or 1
# Places of the scene that throughput is measured at.
RUNS = 16


class Call(NamedTuple):
    """Rays of one call: origins, directions (R, 3); of rays to lights distances (R,), of first hits
    in our order groups (R,)."""

    origins: np.ndarray
    directions: np.ndarray
    distances: np.ndarray | None = None
    group: np.ndarray | None = None


FULL = Sizes(1 << 15, 7, 3000, 1 << 13, 64)
QUICK = Sizes(1 << 15, 7, 800, 1 << 12, 24)


def main() -> int:
    options = parser_of(__doc__, "asset").parse_args()
    report("shading", measure(options.asset, options.quick), options.output, plot)
    return 0


def measure(asset: Path, quick: bool) -> dict[str, Any]:
    sizes = QUICK if quick else FULL
    lit = lit_asset(asset)
    results: dict[str, Any] = {
        "texels": len(lit.atlas.texels),
        "triangles": len(lit.scene.scene.triangles),
        "lights": len(lit.scene.lights.face),
        "threads": THREADS,
        "throughput": throughput(lit, sizes),
        "noise": noise(lit, sizes),
        "bias": bias(lit, sizes),
    }
    results["figures"] = figures(results)
    return results


def throughput(lit: Lit, sizes: Sizes) -> dict[str, Any]:
    order, tile = spread(*tiles_of_texels(lit.atlas.texels), sizes.traced)
    sampling = Sampling(standard_error=0, max_rays=64, seed=1)
    calls, scene = rays_of(lit, order, tile, sampling), embreex_scene(lit.scene.rays)
    ours, embree = side_by_side(
        [lambda: shaded(lit, order, tile, sampling), lambda: embreex(scene, calls)], sizes.turns
    )
    first_hits = [call for call in calls if call.distances is None]
    single = [call._replace(group=None) for call in first_hits]
    mixed = in_random_order(first_hits)
    packed = [call._replace(group=np.arange(len(call.origins)) // 8) for call in mixed]
    tiles, one_by_one, random, random_packets = side_by_side(
        [partial(traced, lit, rays) for rays in (first_hits, single, mixed, packed)], sizes.turns
    )
    rays = sum(len(call.origins) for call in calls)
    per_ray = {name: median(times) / rays for name, times in (("ours", ours), ("embreex", embree))}
    return {
        "rays": rays,
        "rays_per_cpu_second": {name: 1 / one.cpu for name, one in per_ray.items()},
        "rays_per_wall_second": {name: 1 / one.wall for name, one in per_ray.items()},
        "of_embreex": ratio(embree, ours)._asdict(),
        "patches_over_random_order": ratio(random, tiles)._asdict(),
        "one_by_one_over_random_order": ratio(random, one_by_one)._asdict(),
        "random_packets_over_random_order": ratio(random, random_packets)._asdict(),
    }


def spread(order: np.ndarray, tile: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` texels of the whole scene: RUNS runs of whole tiles, evenly spaced."""
    parts = whole_tiles(tile, count // RUNS)
    evenly = np.linspace(0, len(parts), RUNS, endpoint=False).astype(int)
    kept = np.concatenate([np.arange(len(tile))[parts[k]] for k in np.unique(evenly)])
    return order[kept], tile[kept]


def rays_of(lit: Lit, order: np.ndarray, tile: np.ndarray, sampling: Sampling) -> list[Call]:
    """All rays that the estimator traces, in its order: a call for each of its loops' calls."""
    calls: list[Call] = []

    def by_cosine(_: Met, receivers: Receivers, start: int, block: np.ndarray, *sums: Any) -> None:
        origin, draws, groups = (
            receivers.origin,
            receivers.draws,
            groups_of(receivers.draws.identity),
        )
        frames, scratch = frames_of(receivers.normal), np.empty((3, AHEAD), np.float32)
        found = []
        for first, last, sample in turns(groups, len(block)):
            origins = origin[first:last]
            directions = np.empty_like(origins)
            cosine_directions(frames, draws, start + sample, first, directions, scratch)
            found.append((origins, directions, groups[first:last]))
        origins, directions, group = (np.concatenate(parts) for parts in zip(*found, strict=True))
        calls.append(Call(origins, directions, group=group))

    def by_lights(_: Met, receivers: Receivers, start: int, block: np.ndarray, *sums: Any) -> None:
        scratch, segments, found = empty_picked(), empty_segments(), []
        for first, last, sample in turns(groups_of(receivers.draws.identity), len(block)):
            count = light_segments(receivers, start + sample, first, last, scratch, segments)
            ways = segments.direction[:count].copy()
            found.append((receivers.origin[segments.point[:count]], ways))
        origins, ways = (np.concatenate(parts) for parts in zip(*found, strict=True))
        calls.append(Call(origins, ways, np.full(len(ways), 0.9999, np.float32)))

    instead = {"add_cosine_samples": by_cosine, "add_light_samples": by_lights}
    with mock.patch.multiple(irradiance, **instead):
        shaded(lit, order, tile, sampling)
    return [call for call in calls if len(call.origins)]


def embreex_scene(rays: RayScene) -> EmbreeScene:
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, rays.points, rays.triangles)
    # Embree commits within the first query, which is not safe from two threads at once.
    scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
    return scene


def embreex(scene: EmbreeScene, calls: list[Call]) -> None:
    """Nothing but embreex's answers, by as many threads as the estimator has."""

    def one(call: Call) -> None:
        if call.distances is None:
            scene.run(call.origins, call.directions, output=True)
        else:
            scene.run(call.origins, call.directions, dists=call.distances, query="OCCLUDED")

    with ThreadPoolExecutor(max_workers=THREADS) as pool:
        list(pool.map(one, calls))


def traced(lit: Lit, calls: list[Call]) -> None:
    """First hits alone, as the estimator traces them: in groups where there are any."""
    scene = lit.scene.rays.address

    def one(call: Call) -> None:
        count = len(call.origins)
        if call.group is None:
            closest_hits(scene, call.origins, call.directions, empty_hits(count))
        else:
            closest_hits_of_groups(
                scene, call.origins, call.directions, call.group, empty_hits(count)
            )

    with ThreadPoolExecutor(max_workers=THREADS) as pool:
        list(pool.map(one, calls))


def in_random_order(calls: list[Call]) -> list[Call]:
    """The same rays, in as many calls."""
    origins = np.concatenate([call.origins for call in calls])
    directions = np.concatenate([call.directions for call in calls])
    order = np.random.default_rng(0).permutation(len(origins))
    return [Call(origins[part], directions[part]) for part in np.array_split(order, len(calls))]


def figures(results: dict[str, Any]) -> list[dict[str, Any]]:
    traced, study = results["throughput"], results["noise"]
    of_embreex, order = traced["of_embreex"], traced["patches_over_random_order"]
    rows = [
        figure("rays per CPU second, of embreex's own", 100 * of_embreex["cpu"], "%", least=85),
        figure("the same by the clock", 100 * of_embreex["wall"], "%"),
        figure("first hits in tiles and packets over random order", order["cpu"], "x", least=1.8),
        figure("in tiles, one by one", traced["one_by_one_over_random_order"]["cpu"], "x"),
        figure(
            "in random order, in packets", traced["random_packets_over_random_order"]["cpu"], "x"
        ),
        figure("RMSE of S by 10,000 cosine rays", 100 * study["paper"]["rmse"], "%"),
        figure("rays for that, unfiltered", study["rays_for_equal_noise"], "", most=100),
        figure("tracing time, unfiltered, CPU", study["unfiltered_tracing"]["cpu"], "x"),
    ]
    enough = [one for one in study["filtered"] if one["rmse"] <= study["paper"]["rmse"]]
    if enough:
        one = enough[0]
        rows += [
            figure("rays for that with the filter", one["rays"], "", most=8),
            figure("RMSE then", 100 * one["rmse"], "%"),
            figure("tracing time with the filter, CPU", one["tracing"]["cpu"], "x", least=200),
            figure("tracing and filter, CPU", one["total"]["cpu"], "x", least=80),
            figure("tracing and filter by the clock", one["total"]["wall"], "x"),
        ]
    return [
        *rows,
        figure("|z| of the raw estimate's bias", abs(results["bias"]["64 rays"]["z"]), "", most=3),
    ]


def plot(results: dict[str, Any], folder: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    study = results["noise"]
    drawing, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for name, points, mark in (
        ("ours", study["ours"], "o-"),
        ("ours and lightmap filter", study["filtered"], "s-"),
        ("paper: independent cosine rays", [study["paper"]], "D"),
    ):
        axes.loglog(
            [p["rays"] for p in points], [100 * p["rmse"] for p in points], mark, label=name
        )
    axes.axhline(100 * study["paper"]["rmse"], color="grey", linewidth=0.8, linestyle=":")
    axes.set(xlabel="rays per texel", ylabel="relative RMSE of S (%)")
    axes.legend()
    return saved_plot(drawing, folder / "shading.png")


if __name__ == "__main__":
    sys.exit(main())
