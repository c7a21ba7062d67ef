"""True irradiance at points of a rendered capture, by Mitsuba 3.

    export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*/libLLVM.so.19.1)
    python benchmarks/path_traced_irradiance.py CAPTURE OUTPUT.npz [--points 3000] [--samples 9216]

CAPTURE holds mesh.ply with the face property object_id, objects.json, and truth/ with objects.json
(phi, psi, emission) and albedo_vertex.npz, as `samples/study` does. The scene is the true one:
the paper's BRDF (`samples/study_brdf.py`), the true albedo and lamps. Nothing of usdbrdf takes part
but its progress bar. Vertices that triangles share are smooth, as when the capture was rendered.

Whole paths are traced from each point, in the way of the renderer that made the frames, and as many
rays go to the lamps; passes of them are repeated independently, which gives the standard error. One
point's error is skewed: most are a little too dark, few much too bright. With the default rays that
moves medians over many points by no more than 0.2 %.

Points lie at random on the objects that do not emit, uniformly on each, at least 100 on each that
has so many places open to the room: no more than a tenth of what a point sees may be the back of a
surface or nothing, and no more than nine tenths nearer than 5 cm (gaps no camera sees). Paths end
after --max-depth vertices: where the capture's did, or its frames lack light that E has. OUTPUT
holds, for N points:

    position, normal    (N, 3) metres, world frame; the shading normal
    object, names       (N,) index into names (objects,)
    area                (N,) m^2 of open surface that the point stands for
    E                   (N, 3) irradiance: the integral of the incident radiance times cosine
    standard_error      (N, 3) of E
    albedo              (N, 3) true; the true diffuse radiance is albedo / pi * E
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.job.progress import progress

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
import make_study
import mitsuba as mi
from study_shapes import Array

import drjit as dr  # isort: skip  (follows Mitsuba's variant)

from true_scene import Points, open_points, surface_points, true_objects

PASSES = 4  # fewer would hardly tell their own scatter


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--samples", type=int, default=9216, help="rays per point (%(default)s)")
    parser.add_argument(
        "--max-depth",
        type=int,
        default=make_study.MAX_DEPTH,
        help="path vertices with which the capture was rendered (%(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    start = time.monotonic()
    objects = true_objects(options.capture)
    scene = make_study.mitsuba_scene(objects)
    points = open_points(scene, objects, options.points, np.random.default_rng(options.seed))
    strata = max(1, round((options.samples / PASSES) ** 0.5))
    bounces = options.max_depth - 1  # the camera's own ray is one
    mean, error = irradiance(scene, points, strata, bounces, options.seed)
    names = np.array([item.name for item in objects])
    options.output.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        options.output,
        position=points.position.astype(np.float32),
        normal=points.normal.astype(np.float32),
        object=points.object.astype(np.int32),
        names=names,
        area=points.area.astype(np.float32),
        E=mean.astype(np.float32),
        standard_error=error.astype(np.float32),
        albedo=points.albedo.astype(np.float32),
    )
    print(json.dumps(summary(points, names, mean, error, PASSES * strata**2), indent=2))
    print(f"{time.monotonic() - start:.0f} s", file=sys.stderr)
    return 0


def irradiance(
    scene: mi.Scene, points: Points, strata: int, max_depth: int, seed: int
) -> tuple[Array, Array]:
    """E and its standard error, both (N, 3): mean and scatter of independent passes, each with
    strata^2 paths of at most ``max_depth`` edges per point."""
    path = mi.load_dict(
        {"type": "path", "max_depth": max_depth, "rr_depth": make_study.ROULETTE_DEPTH}
    )
    light = (lamp_light, partial(path_light, path))
    passes = [
        estimate(scene, points, strata, 10_007 * seed + k, light)
        for k in progress(range(PASSES), total=PASSES, label="irradiance", unit="passes")
    ]
    return np.mean(passes, axis=0), np.std(passes, axis=0, ddof=1) / PASSES**0.5


class Rays(NamedTuple):
    """Wavefront of rays from surface points, ``local`` their directions in the shading frames."""

    sampler: mi.Sampler
    origin: mi.Interaction3f
    frame: mi.Frame3f
    local: mi.Vector3f
    to_lamp: mi.Point2f
    ray: mi.Ray3f
    hit: mi.SurfaceInteraction3f


Integrand = Callable[[mi.Scene, Rays], mi.Color3f]


def estimate(
    scene: mi.Scene, points: Points, strata: int, seed: int, integrands: Sequence[Integrand]
) -> Array:
    """(N, 3) sum of the integrands' means over strata^2 cosine-distributed rays per point."""
    count = strata**2 * len(points.position)
    origin, frame = surface_points(points, strata**2)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    stratum = dr.arange(mi.UInt32, count) % strata**2

    def stratified() -> mi.Point2f:
        cell = mi.Point2f(stratum % strata, stratum // strata)
        return (cell + sampler.next_2d()) / strata

    local = mi.warp.square_to_cosine_hemisphere(stratified())
    ray = origin.spawn_ray(frame.to_world(local))
    rays = Rays(sampler, origin, frame, local, stratified(), ray, scene.ray_intersect(ray))
    value = sum((integrand(scene, rays) for integrand in integrands), mi.Color3f(0))
    return np.array(value, np.float64).T.reshape(-1, strata**2, 3).mean(axis=1)


def lamp_light(scene: mi.Scene, rays: Rays) -> mi.Color3f:
    """Lamps in sight, by the rays and as many towards lamps, with the balance heuristic."""
    lamp, weight = scene.sample_emitter_direction(rays.origin, rays.to_lamp, True)
    cosine = dr.maximum(dr.dot(lamp.d, rays.frame.n), 0)
    chosen = weight * cosine * share(lamp.pdf, cosine / dr.pi)
    emitted, lamp_pdf = lamp_at(scene, rays.hit, rays.origin)
    met = dr.pi * emitted * share(rays.local.z / dr.pi, lamp_pdf)
    return dr.select(lamp.pdf > 0, chosen, 0) + met


def path_light(path: mi.Integrator, scene: mi.Scene, rays: Rays) -> mi.Color3f:
    """What surfaces reflect, by Mitsuba's path tracer.

    It counts what the first surface itself emits, and its option to hide emitters does not change
    that.
    """
    radiance, _, _ = path.sample(scene, rays.sampler, rays.ray)
    return dr.pi * (radiance - rays.hit.emitter(scene).eval(rays.hit))


def share(own: mi.Float, other: mi.Float) -> mi.Float:
    """The balance heuristic; 0 where neither way is possible."""
    return own / dr.maximum(own + other, 1e-20)


def lamp_at(
    scene: mi.Scene, hit: mi.SurfaceInteraction3f, origin: mi.Interaction3f
) -> tuple[mi.Color3f, mi.Float]:
    """What the lamp at ``hit``, if it is one, sends to ``origin``, and its pdf as a chosen lamp."""
    emitter = hit.emitter(scene)
    shines = emitter != None  # noqa: E711  (per lane)
    there = mi.DirectionSample3f(scene, hit, origin)
    pdf = scene.pdf_emitter_direction(origin, there, shines)
    return dr.select(shines, emitter.eval(hit, shines), 0), dr.select(shines, pdf, 0)


def summary(
    points: Points, names: np.ndarray, mean: Array, error: Array, samples: int
) -> dict[str, object]:
    """The relative standard errors, mean of the channels, over all points and per object."""
    relative = (error / np.maximum(mean, 1e-12)).mean(axis=1)
    return {
        "points": len(relative),
        "samples": samples,
        "relative_standard_error": {
            "mean": float(relative.mean()),
            "median": float(np.median(relative)),
            "p99": float(np.quantile(relative, 0.99)),
        },
        "objects": {
            str(names[k]): {
                "points": int((points.object == k).sum()),
                "mean_relative_standard_error": float(relative[points.object == k].mean()),
            }
            for k in np.unique(points.object)
        },
    }


if __name__ == "__main__":
    sys.exit(main())
