"""A capture with truth of a scene that somebody else made for Mitsuba (0.6 or 3).

    python benchmarks/capture_of_scene.py SCENE.xml OUTPUT [--frames 48] [--views 8] [--width 320]
        [--samples 48] [--up Y] [--metres-per-unit 1] [--within METRES] [--around DEGREES]
        [--seed 0]

Path traced with the scene's own materials and lights, so independent of this program's BRDF. Frames
have three exposures in turn, a sensor's noise, 12 bits and saturation, and go through Open Image
Denoise where it is installed (extra ``denoise``; the output says so).

Cameras stand in the free space that is connected to the scene's own camera and look where surfaces
were seen least; with --around DEGREES up to as far as that from it, around what the scene's camera
looks at, and look there.

truth/: clean views from poses that are not among the frames (view_NN.exr, views.json), the
material's albedo there (albedo_NN.exr), materials.json (kind, phi, psi, F0, and of coated materials
what of the albedo reaches a viewer), objects.json (Mitsuba's own words).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
from generated_capture import write_mesh
from mitsuba_scene import load, world_mesh, write_json, write_materials
from study_camera import (
    EXPOSURES,
    Array,
    noise_floor_radiance,
    photograph,
    saturation_radiance,
    write_exr,
)

from usdbrdf.model.camera import Camera
from usdbrdf.transport.denoise import chosen_filter, denoise_picture
from usdbrdf.transport.rays import RayScene

FOCAL = 0.65  # of a width of the image: 75 degrees across
MAX_DEPTH, ROULETTE_FROM = 12, 6
PASS = 16  # samples per pixel in one call, for memory
# Where cameras may stand, metres: above what is below them, from any surface, and how they tilt.
HEIGHTS, CLEARANCE, PITCH = (0.5, 2.0), 0.3, (-50.0, 35.0)
FROM_AFAR = 2.5  # times how far from where it looks a thing before a backdrop reaches
PLACES, LOOKS = 300, 8  # candidates: places, and directions from each
CELL = 0.2  # m: the size of the pieces of surface that are to be seen
WORTH = np.array([1.0, 0.8, 0.6, 0.15, 0.05])  # of seeing a piece for the first, second ... time
# Brightness: the middle exposure saturates at so many times the brightest tenth of ordinary pixels.
HEADROOM, BRIGHT = 3.0, 90
# With less of the light left by the denoiser, fireflies were a part of it: a loft whose lamp shines
# through a glass star kept 0.67, the same without the star 0.98 to 1.
LEAST_KEPT = 0.95


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--width", type=int, default=320, help="pixels; three quarters as high")
    parser.add_argument("--samples", type=int, default=48, help="paths per pixel of a frame")
    parser.add_argument("--up", choices=("Y", "Z"), default="Y")
    parser.add_argument("--metres-per-unit", type=float, default=1.0)
    parser.add_argument(
        "--within",
        type=float,
        default=np.inf,
        help="metres from where the scene's own camera looks: the rest is a backdrop",
    )
    parser.add_argument(
        "--around",
        type=float,
        default=None,
        help="degrees from the scene's own camera, around what that looks at: a thing in the open",
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.around is not None and not 1 <= options.around <= 180:
        parser.error("--around: from 1 to 180 degrees.")
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")

    scene, own = load(options.scene)
    things = [*scene.shapes()]
    geometry = world_mesh(things, options.metres_per_unit)
    rays = RayScene(geometry.points, geometry.triangles)
    own[:3, 3] *= options.metres_per_unit
    cameras = chosen_cameras(rays, own, options)
    (options.output / "frames").mkdir(parents=True)
    (options.output / "truth").mkdir()
    write_mesh(options.output, geometry)
    write_materials(options.output / "truth", things, geometry.names)
    photographer = Photographer(scene, options.metres_per_unit)
    write_views(options.output / "truth", photographer, cameras[options.frames :], options)
    write_frames(options.output, photographer, cameras[: options.frames], options)
    if photographer.kept and (kept := float(np.median(photographer.kept))) < LEAST_KEPT:
        print(
            f"The denoiser kept {kept:.2f} of the light: few paths find a lamp, and the frames do "
            "not agree how bright things are. Take lamps out of glass, or more samples."
        )
    return 0


# ---- cameras -----------------------------------------------------------------------------------


class Candidate(NamedTuple):
    """A pose (4, 4), in metres, and the pieces of surface that it sees."""

    pose: Array
    pieces: np.ndarray


def chosen_cameras(rays: RayScene, own: Array, options: argparse.Namespace) -> list[Array]:
    """Poses (4, 4) of the frames, then of the held-out views: greedily what was seen least."""
    rng = np.random.default_rng(options.seed)
    up = np.eye(3)[" YZ".index(options.up)]
    eye, ahead = own[:3, 3], unit(own[:3, 2])
    aim = eye + ahead * distances(rays, eye, ahead[None])[0]
    if options.around is None:
        poses = [
            pose
            for place in free_places(rays, eye, up, rng)
            if not np.linalg.norm(place - aim) > FROM_AFAR * options.within
            for pose in looks_from(place, up, rng)
        ]
    else:
        poses = looks_around(eye, aim, options.around, up, rng)
    candidates = [
        Candidate(pose, pieces)
        for pose in poses
        if (pieces := pieces_seen(rays, pose, options, aim)) is not None
    ]
    if len(candidates) < 2 * (options.frames + options.views):
        raise SystemExit(f"only {len(candidates)} places to photograph from; is --up right?")
    _, numbers = np.unique(np.concatenate([c.pieces for c in candidates]), return_inverse=True)
    ends = np.cumsum([len(c.pieces) for c in candidates])[:-1]
    seen = np.split(numbers, ends)
    count = np.zeros(numbers.max() + 1, int)
    left, chosen = list(range(len(candidates))), []
    for _ in range(options.frames):
        worth = WORTH[np.minimum(count, len(WORTH) - 1)]
        best = max(left, key=lambda k: worth[seen[k]].sum())
        count[seen[best]] += 1
        left.remove(best)
        chosen.append(best)
    print(f"{len(candidates)} places; pieces of surface seen 3 times: {(count >= 3).mean():.0%}")
    # Held out: what frames saw three times, each view other things than the views before.
    fresh = (count >= 3).astype(float)
    for _ in range(options.views):
        best = max(left, key=lambda k: fresh[seen[k]].sum())
        fresh[seen[best]] *= 0.3
        left.remove(best)
        chosen.append(best)
    return [candidates[k].pose for k in chosen]


def free_places(rays: RayScene, eye: Array, up: Array, rng: np.random.Generator) -> list[Array]:
    """Points of the free space that a walk from the scene's camera reaches."""
    reached, places = [np.asarray(eye, np.float64)], []
    for _ in range(40 * PLACES):
        start = reached[rng.integers(len(reached))]
        toward = unit(rng.normal(size=3) * (1 - 0.6 * up))
        free = distances(rays, start, toward[None])[0]
        if not np.isfinite(free) or free < 2 * CLEARANCE:
            continue
        place = start + toward * rng.uniform(0, free - CLEARANCE)
        around = unit(rng.normal(size=(128, 3)))
        height, *near = distances(rays, place, np.concatenate([-up[None], around]))
        if min(near) < CLEARANCE or np.mean(np.isfinite(near)) < 0.5:
            continue
        reached.append(place)
        if HEIGHTS[0] <= height <= HEIGHTS[1]:
            places.append(place)
        if len(places) == PLACES:
            break
    return places


def distances(rays: RayScene, start: Array, directions: Array) -> Array:
    """To the next surface along each direction (N, 3); infinity where there is none."""
    origins = np.repeat(start[None].astype(np.float32), len(directions), axis=0)
    hits = rays.closest(origins, np.ascontiguousarray(directions, np.float32))
    return np.where(hits.face >= 0, hits.distance.astype(np.float64), np.inf)


def looks_from(place: Array, up: Array, rng: np.random.Generator) -> list[Array]:
    """Poses (4, 4), OpenGL's axes, in directions all round."""
    ahead, side = np.roll(up, 1), np.roll(up, 2)
    poses = []
    for k in range(LOOKS):
        turn = 2 * np.pi * (k + rng.random()) / LOOKS
        pitch = np.radians(rng.uniform(*PITCH))
        level = np.cos(turn) * ahead + np.sin(turn) * side
        poses.append(looking(place, np.cos(pitch) * level + np.sin(pitch) * up, up))
    return poses


def looks_around(
    eye: Array, aim: Array, degrees: float, up: Array, rng: np.random.Generator
) -> list[Array]:
    """Poses (4, 4), up to so many degrees from the ``eye`` and as far away, that look near the
    ``aim``."""
    reach, poses = float(np.linalg.norm(eye - aim)), []
    if not np.isfinite(reach):
        raise SystemExit("the scene's camera looks at nothing in its middle; --around needs that")
    while len(poses) < PLACES:
        away = unit(rng.normal(size=3))
        if away @ unit(eye - aim) < np.cos(np.radians(degrees)):
            continue
        place = aim + away * reach * rng.uniform(0.7, 1.1)
        near = aim + 0.2 * reach * rng.uniform(-1, 1, size=3)
        poses.append(looking(place, unit(near - place), up))
    return poses


def looking(place: Array, ahead: Array, up: Array) -> Array:
    """The pose (4, 4), OpenGL's axes, there, towards a unit vector."""
    right = unit(np.cross(up, -ahead))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(-ahead, right), -ahead, place], axis=1)
    return pose


def pieces_seen(
    rays: RayScene, pose: Array, options: argparse.Namespace, aim: Array
) -> np.ndarray | None:
    """Numbers of the pieces of surface before the camera, None if it stands before something."""
    camera = camera_of(pose, options.width).at_width(24)
    origins, directions = camera.rays(camera.pixels())
    hits = rays.closest(origins, directions)
    met = hits.face >= 0
    near = 0.8 if options.around is None else 0.2
    if met.mean() < 0.5 or np.median(hits.distance[met]) < near:
        return None
    points = origins[met] + directions[met] * hits.distance[met, None]
    points = points[~(np.linalg.norm(points - aim, axis=1) > options.within)]
    cell = np.floor(points / CELL).astype(np.int64) + (1 << 20)
    return np.unique(cell @ np.array([1, 1 << 21, 1 << 42]))


def camera_of(pose: Array, width: int) -> Camera:
    height = width * 3 // 4
    lens = (FOCAL * width, FOCAL * width, width / 2, height / 2)
    return Camera(world_from_camera=pose, intrinsics=lens, width=width, height=height)


def unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


# ---- pictures ----------------------------------------------------------------------------------


class Photographer:
    """Renders the scene from poses in metres."""

    def __init__(self, scene: mi.Scene, scale: float) -> None:
        self.scene, self.scale = scene, scale
        self.denoises = chosen_filter("auto") == "oidn"
        self.kept: list[float] = []  # of each picture's light, by the denoiser
        print("pictures are denoised" if self.denoises else "pictures are not denoised")
        self.path = mi.load_dict(
            {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_FROM}
        )
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})

    def picture(self, pose: Array, width: int, samples: int, seed: int) -> tuple[Array, Array]:
        """Radiance and albedo, (H, W, 3) each, means over pixels."""
        camera = camera_of(pose, width)
        sensor = self.sensor(camera)

        def rendered(integrator: mi.Integrator, seed: int) -> Array:
            image = mi.render(self.scene, sensor=sensor, integrator=integrator, spp=PASS, seed=seed)
            return np.nan_to_num(np.array(image, np.float64), posinf=0, neginf=0)

        passes = max(1, round(samples / PASS))
        radiance = sum(rendered(self.path, 1000 * seed + k) for k in range(passes)) / passes
        albedo, normal = np.split(rendered(self.guides, 1000 * seed), 2, axis=2)
        if self.denoises:
            guides = (np.clip(albedo, 0, 1), normal)
            noisy = float(np.sum(radiance))
            radiance = denoise_picture(*(a.astype(np.float32) for a in (radiance, *guides)))
            self.kept.append(float(np.sum(radiance)) / max(noisy, 1e-12))
        return np.asarray(radiance, np.float64), albedo

    def sensor(self, camera: Camera) -> mi.Sensor:
        # Mitsuba's cameras look down +z with x to the left.
        pose = camera.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
        pose[:3, 3] /= self.scale
        film = {
            "type": "hdrfilm", "width": camera.width, "height": camera.height,
            "pixel_format": "rgb", "component_format": "float32", "rfilter": {"type": "box"},
        }  # fmt: skip
        return mi.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(np.degrees(2 * np.arctan(0.5 / FOCAL))),
                "near_clip": 0.01 / self.scale,
                "far_clip": 1000.0 / self.scale,
                "to_world": mi.ScalarTransform4f(pose),
                "sampler": {"type": "independent"},
                "film": film,
            }
        )


def write_views(
    folder: Path, photographer: Photographer, poses: list[Array], options: argparse.Namespace
) -> None:
    records = []
    for k, pose in enumerate(poses):
        seed = options.seed + 5000 + k
        radiance, albedo = photographer.picture(pose, options.width, 3 * options.samples, seed)
        write_exr(folder / f"view_{k:02d}.exr", radiance)
        write_exr(folder / f"albedo_{k:02d}.exr", albedo)
        records.append({"file_path": f"view_{k:02d}.exr", "transform_matrix": pose.tolist()})
    write_json(folder / "views.json", header(options.width) | {"frames": records})


def write_frames(
    folder: Path, photographer: Photographer, poses: list[Array], options: argparse.Namespace
) -> None:
    """All frames, transforms.json last. The exposures suit what the frames show."""
    pictures = [
        photographer.picture(pose, options.width, options.samples, options.seed + k)[0]
        for k, pose in enumerate(poses)
    ]
    bright = float(np.percentile([np.percentile(p.mean(axis=2), BRIGHT) for p in pictures], 50))
    # The sensor's own scale of radiance against the scene's.
    unit_radiance = HEADROOM * bright / saturation_radiance(EXPOSURES[1])
    records = []
    for k, (pose, radiance) in enumerate(zip(poses, pictures, strict=True)):
        exposure = EXPOSURES[k % len(EXPOSURES)]
        rng = np.random.default_rng([options.seed, k])
        name = f"frames/{k:04d}.exr"
        taken = photograph(radiance / unit_radiance, exposure, rng) * unit_radiance
        write_exr(folder / name, taken, exposure)
        records.append(
            {
                "file_path": name,
                "transform_matrix": pose.tolist(),
                "exposure_time": exposure,
                "saturation_radiance": saturation_radiance(exposure) * unit_radiance,
                "noise_floor_radiance": noise_floor_radiance(exposure) * unit_radiance,
            }
        )
    write_json(folder / "transforms.json", header(options.width) | {"frames": records})


def header(width: int) -> dict[str, Any]:
    camera = camera_of(np.eye(4), width)
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.intrinsics, strict=True))
    return {"camera_model": "PINHOLE", "w": width, "h": camera.height, **lens}


if __name__ == "__main__":
    sys.exit(main())
