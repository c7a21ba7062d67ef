"""True irradiance at points of a rendered capture, by Mitsuba 3.

    export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*/libLLVM.so.19.1)
    python benchmarks/path_traced_irradiance.py CAPTURE OUTPUT.npz [--points 6000] [--samples 6144]

CAPTURE holds mesh.ply with the face property object_id, objects.json, and truth/ with objects.json
(phi, psi, emission) and albedo_vertex.npz, as `samples/study` does. The scene is the true one:
the paper's BRDF (`samples/study_brdf.py`), the true albedo and lamps. Nothing of usdbrdf takes part
but its progress bar. Vertices that triangles share are smooth, as when the capture was rendered.

The irradiance is gathered: where a ray ends, the diffuse radiance is the mean over that triangle,
and only what is reflected specularly there is followed further. The means come from path tracing
with few rays per triangle, then one gathering of their own. Radiance is constant on each triangle,
and specular reflections before it do not count towards --max-depth: in a study rendered with 9
vertices that gave 0.8 +- 0.2 % more light than `--plain`, which traces whole paths instead, with
five times the standard error. Both are repeated independently, so that the standard error holds
every noise.

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
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.job.progress import progress

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
import make_study
import mitsuba as mi
from study_scene import StudyObject
from study_shapes import Array

import drjit as dr  # isort: skip  (follows Mitsuba's variant)

from true_scene import Points, joined, open_points, points_in, surface_points, true_objects

PASSES = 4  # fewer would hardly tell their own scatter
TRIANGLE_STRATA = 2, 3  # per dimension, for the path traced and the gathered means
SPECULAR_BOUNCES = 3  # each leaves less than a tenth, but at grazing angles


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--points", type=int, default=6000)
    parser.add_argument("--samples", type=int, default=6144, help="rays per point (%(default)s)")
    parser.add_argument("--plain", action="store_true", help="whole paths, nothing gathered")
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
    mean, error = irradiance(scene, objects, points, strata, bounces, options.seed, options.plain)
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
    scene: mi.Scene,
    objects: list[StudyObject],
    points: Points,
    strata: int,
    max_depth: int,
    seed: int,
    plain: bool,
) -> tuple[Array, Array]:
    """E and its standard error, both (N, 3): mean and scatter of independent passes."""
    passes = []
    for k in progress(range(PASSES), total=PASSES, label="irradiance", unit="passes"):
        own = 10_007 * seed + 10 * k
        if plain:
            estimated = traced(scene, points, strata, max_depth, own)
        else:
            gathering = gathering_scene(scene, objects, max_depth - 1, own + 5)
            estimated = gathered(gathering, points, strata, own)
        passes.append(estimated)
    return np.mean(passes, axis=0), np.std(passes, axis=0, ddof=1) / PASSES**0.5


def gathering_scene(
    scene: mi.Scene, objects: list[StudyObject], max_depth: int, seed: int
) -> mi.Scene:
    """The scene without diffuse reflection; triangles have ``face_radiance``, their mean of it."""
    rng = np.random.default_rng([seed, 1])
    black = [replace(item, albedo=np.zeros_like(item.albedo)) for item in objects]
    shapes = {item.name: make_study.mitsuba_shape(item) for item in black}
    result = scene
    for k, strata in enumerate(TRIANGLE_STRATA):
        points = joined(
            points_in(item, i, np.arange(len(item.triangles)), rng)
            for i, item in enumerate(objects)
        )
        if k == 0:
            light = traced(scene, points, strata, max_depth - 1, seed + 2)
        else:
            light = gathered(result, points, strata, seed)
        radiance = (points.albedo / np.pi * light).astype(np.float32)
        for i, shape in enumerate(shapes.values()):
            if k > 0:
                shape.remove_attribute("face_radiance")
            shape.add_attribute("face_radiance", 3, radiance[points.object == i].ravel())
        result = mi.load_dict({"type": "scene"} | shapes)
    return result


def traced(scene: mi.Scene, points: Points, strata: int, max_depth: int, seed: int) -> Array:
    """E (N, 3) from strata^2 whole paths per point."""
    path = mi.load_dict(
        {"type": "path", "max_depth": max_depth, "rr_depth": make_study.ROULETTE_DEPTH}
    )
    return estimate(scene, points, strata, seed, (lamp_light, partial(path_light, path)))


def gathered(scene: mi.Scene, points: Points, strata: int, seed: int) -> Array:
    """E (N, 3) from strata^2 rays per point in a ``gathering_scene``.

    Specular reflections are a small part and the dearest to follow: they get a quarter of the rays.
    """
    often = estimate(scene, points, strata, seed, (lamp_light, diffuse_light))
    return often + estimate(scene, points, max(1, strata // 2), seed + 1, (specular_light,))


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


def diffuse_light(scene: mi.Scene, rays: Rays) -> mi.Color3f:
    """What surfaces reflect diffusely, in a ``gathering_scene``."""
    return dr.pi * mean_diffuse(rays.hit)


def specular_light(scene: mi.Scene, rays: Rays) -> mi.Color3f:
    """What surfaces reflect specularly, in a ``gathering_scene``."""
    value, throughput = mi.Color3f(0), mi.Color3f(dr.pi)
    context, sampler, hit = mi.BSDFContext(), rays.sampler, rays.hit
    for _ in range(SPECULAR_BOUNCES):
        front = hit.is_valid() & (hit.wi.z > 0)
        bsdf = hit.bsdf()
        lamp, weight = scene.sample_emitter_direction(hit, sampler.next_2d(), True, front)
        reflected, pdf = bsdf.eval_pdf(context, hit, hit.to_local(lamp.d), front)
        found = front & (lamp.pdf > 0)
        value += dr.select(found, throughput * weight * reflected * share(lamp.pdf, pdf), 0)

        drawn, weight = bsdf.sample(context, hit, sampler.next_1d(), sampler.next_2d(), front)
        usable = front & (drawn.pdf > 0)
        throughput = dr.select(usable, throughput * weight, 0)
        ray = hit.spawn_ray(hit.to_world(dr.select(usable, drawn.wo, mi.Vector3f(0, 0, 1))))
        origin, hit = hit, scene.ray_intersect(ray, usable)
        emitted, lamp_pdf = lamp_at(scene, hit, origin)
        value += throughput * (mean_diffuse(hit) + emitted * share(drawn.pdf, lamp_pdf))
    return value


def mean_diffuse(hit: mi.SurfaceInteraction3f) -> mi.Color3f:
    front = hit.is_valid() & (hit.wi.z > 0)
    return dr.select(front, hit.shape.eval_attribute_3("face_radiance", hit, front), 0)


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
