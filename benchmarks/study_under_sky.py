"""A study room with truth, rendered again without its ceiling and lamps, under sun and sky.

    python benchmarks/study_under_sky.py CAPTURE OUTPUT [--inside] [--samples 64] [--frames F]
        [--elevation 50] [--azimuth 60] [--sun 1.0]

CAPTURE is a folder as `samples/study`: mesh.ply, objects.json, transforms.json, and truth/ with
objects.json, albedo_vertex.npz and views.json. OUTPUT gets the same files, its truth/ the true sky
too (environment.exr, z up). Lamps stay where they are, dark. The sun is a disc of one degree; its
light at right angles to it is ``--sun`` times what the sky sends down.

--inside keeps the frames alone in which no pixel sees the sky. Frames have the noise of their
samples, three exposures in turn, 12 bits and saturation. Needs what samples/make_study.py needs.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
from make_study import (
    Lens,
    mitsuba_scene,
    render,
    write_frames,
    write_json,
    write_mesh,
    write_objects,
)
from study_camera import EXPOSURES, Array, saturation_radiance, write_exr
from study_scene import StudyObject
from study_shapes import joined

from usdbrdf.model.camera import Camera
from usdbrdf.transport.rays import RayScene

import mitsuba as mi  # isort: skip  (its variant is set by make_study)
from true_scene import true_objects  # isort: skip

HEIGHT, WIDTH = 512, 1024
SUN_DEGREES = 1.0
# The middle exposure saturates at so many times the brightest tenth of ordinary pixels.
HEADROOM, BRIGHT, LOOKED_AT = 3.0, 90, 6
SEED = 40


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--inside", action="store_true", help="frames that see no sky alone")
    parser.add_argument("--samples", type=int, default=64, help="paths per pixel (%(default)s)")
    parser.add_argument("--frames", type=int, default=1000, help="at most")
    parser.add_argument("--elevation", type=float, default=50.0, help="of the sun, degrees")
    parser.add_argument("--azimuth", type=float, default=60.0, help="of the sun, from x to y")
    parser.add_argument("--sun", type=float, default=1.0, help="its light, in that of the sky")
    options = parser.parse_args()
    if options.output.exists():
        parser.error(f"{options.output} exists. Name a folder that does not.")

    objects = [
        replace(item, emission=(0.0, 0.0, 0.0))
        for item in true_objects(options.capture)
        if item.class_name != "ceiling"
    ]
    sky = sun_and_sky(options.elevation, options.azimuth, options.sun)
    document = json.loads((options.capture / "transforms.json").read_text("utf-8"))
    lens = Lens(document["w"], document["h"], document["fl_x"])
    poses = [np.array(frame["transform_matrix"]) for frame in document["frames"]]
    points, triangles = joined([(item.points, item.triangles) for item in objects])
    rays = RayScene(points.astype(np.float32), triangles.astype(np.int32))
    outwards = [sees_sky(rays, pose, lens) for pose in poses]
    if options.inside:
        poses = [pose for pose, outward in zip(poses, outwards, strict=True) if not outward]
    if not poses:
        parser.error(f"--inside: every frame of {options.capture} sees the sky.")
    poses = spread(poses, options.frames)
    sky *= brightness(objects, sky, poses, lens)
    scene = under(objects, sky)
    for folder in ("frames", "truth"):
        (options.output / folder).mkdir(parents=True)
    write_mesh(options.output / "mesh.ply", objects)
    write_objects(options.output, objects)
    write_exr(options.output / "truth/environment.exr", sky)
    header = {key: value for key, value in document.items() if key != "frames"}
    exposed = [(pose, EXPOSURES[k % len(EXPOSURES)]) for k, pose in enumerate(poses)]
    records = write_frames(options.output, scene, options.samples, exposed, SEED, lens)
    write_json(options.output / "transforms.json", header | {"frames": records})
    held_out(options, scene, lens)
    print(f"{len(poses)} frames, {sum(outwards)} of the capture's {len(outwards)} see the sky")
    return 0


def spread(poses: list[Array], count: int) -> list[Array]:
    """At most so many, spread over all."""
    chosen = np.linspace(0, len(poses) - 1, min(len(poses), count)).astype(int)
    return [poses[k] for k in chosen]


def sun_and_sky(elevation: float, azimuth: float, share: float) -> Array:
    """(HEIGHT, WIDTH, 3), z up, latitude and longitude as Mitsuba's after turning y to z: a blue
    sky, white at the horizon, over dark ground, with the sun."""
    polar = (np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi
    turn = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi
    up = np.cos(polar)[:, None, None]
    haze = (1 - np.clip(up, 0, 1)) ** 3
    sky = (1 - haze) * np.array([0.35, 0.55, 1.0]) + haze * np.array([1.2, 1.2, 1.2])
    sky = np.broadcast_to(np.where(up > 0, sky, 0.15), (HEIGHT, WIDTH, 3)).copy()
    towards = directions(polar, turn)
    angle = np.radians([elevation, azimuth])
    across = np.cos(angle[0]) * np.array([np.cos(angle[1]), np.sin(angle[1])])
    sun = np.array([*across, np.sin(angle[0])])
    solid = np.sin(polar)[:, None] * (np.pi / HEIGHT) * (2 * np.pi / WIDTH) * np.ones((1, WIDTH))
    disc = towards @ sun > np.cos(np.radians(SUN_DEGREES / 2))
    down = (sky * (np.clip(up, 0, 1) * solid[..., None])).sum(axis=(0, 1)).mean()
    sky[disc] += share * down / solid[disc].sum() * np.array([1.15, 1.0, 0.8])
    return sky


def directions(polar: Array, turn: Array) -> Array:
    """(H, W, 3), z up: of an environment's pixels."""
    # Mitsuba: u = atan2(x, -z) / 2 pi of the environment's own axes, whose y is up; turned by
    # ``TO_WORLD`` its (x, y, z) are the world's (x, z, -y).
    sine = np.sin(polar)[:, None]
    x, z = np.sin(turn), -np.cos(turn)
    own = np.stack([sine * x, np.cos(polar)[:, None] * np.ones_like(turn), sine * z], axis=-1)
    return np.stack([own[..., 0], -own[..., 2], own[..., 1]], axis=-1)


TO_WORLD = [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]


def under(objects: list[StudyObject], sky: Array) -> mi.Scene:
    bitmap = mi.Bitmap(np.ascontiguousarray(sky, np.float32))
    turned = mi.ScalarTransform4f(TO_WORLD)
    return mitsuba_scene(objects, {"sky": {"type": "envmap", "bitmap": bitmap, "to_world": turned}})


def sees_sky(rays: RayScene, pose: Array, lens: Lens) -> bool:
    """Whether any pixel's middle misses all surfaces."""
    intrinsics = lens.focal, lens.focal, lens.width / 2, lens.height / 2
    camera = Camera(
        world_from_camera=pose, intrinsics=intrinsics, width=lens.width, height=lens.height
    )
    return bool((rays.closest(*camera.rays(camera.pixels())).face < 0).any())


def brightness(objects: list[StudyObject], sky: Array, poses: list[Array], lens: Lens) -> float:
    """What the sky is to be multiplied by for the frames' middle exposure to suit them."""
    scene = under(objects, sky)
    looked = (render(scene, pose, 16, SEED, lens) for pose in spread(poses, LOOKED_AT))
    pixels = np.concatenate([picture.max(axis=-1).ravel() for picture in looked])
    return float(saturation_radiance(EXPOSURES[1]) / HEADROOM / np.percentile(pixels, BRIGHT))


def held_out(options: argparse.Namespace, scene: mi.Scene, lens: Lens) -> None:
    source = json.loads((options.capture / "truth/views.json").read_text("utf-8"))
    records = []
    for k, frame in enumerate(source["frames"]):
        name = f"view_{k:02d}.exr"
        pose = np.array(frame["transform_matrix"])
        view = render(scene, pose, 2 * options.samples, SEED + 900 + k, lens)
        write_exr(options.output / "truth" / name, view)
        records.append({"file_path": name, "transform_matrix": pose.tolist()})
    header = {key: value for key, value in source.items() if key != "frames"}
    write_json(options.output / "truth/views.json", header | {"frames": records})


if __name__ == "__main__":
    sys.exit(main())
