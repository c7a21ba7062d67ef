"""Renders the sample capture ``samples/study``: a small room whose materials are known.

Independent of usdbrdf on purpose: it is what usdbrdf is measured against. It needs the extra
``render`` (Mitsuba 3), OpenImageIO, and an LLVM shared library of version 17 or newer, because a
BSDF in Python runs only in Mitsuba's vectorised variants. On Debian or Ubuntu:

    apt-get install libllvm19
    export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*/libLLVM.so.19.1)
    python samples/make_study.py --check          # the BSDF against plain NumPy
    python samples/make_study.py                  # rewrites samples/study
    python samples/make_study.py --samples 16 --output out/draft
    python samples/make_study.py --poses POSES.json --output out/more

The last photographs the room from other poses: a document like transforms.json, whose frames have
``transform_matrix`` and ``exposure_time``; written are these frames alone.

``study_scene`` holds the room, built of ``study_shapes``; ``study_brdf`` the BRDF;
``study_camera`` the camera and its sensor.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import study_brdf
from study_camera import (
    EXPOSURES,
    FOCAL,
    HEIGHT,
    WIDTH,
    Array,
    frame_poses,
    held_out_poses,
    noise_floor_radiance,
    photograph,
    saturation_radiance,
    write_exr,
)
from study_scene import StudyObject, study_objects
from study_shapes import vertex_normals

SEED = 20
SAMPLES_PER_PASS = 256  # bounds the memory of the vectorised path tracer
MAX_DEPTH = 14  # path vertices
ROULETTE_DEPTH = 4


class Lens(NamedTuple):
    """Of a camera whose principal point is the middle, in pixels."""

    width: int
    height: int
    focal: float


STUDY = Lens(WIDTH, HEIGHT, FOCAL)


def mitsuba_shape(item: StudyObject) -> mi.Mesh:
    bsdf = {"type": "paper_brdf", "phi": item.phi, "psi": item.psi}
    bsdf["albedo"] = {"type": "mesh_attribute", "name": "vertex_albedo"}
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    if max(item.emission) > 0:
        radiance = {"type": "rgb", "value": list(item.emission)}
        props["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    shape = mi.Mesh(
        item.name, len(item.points), len(item.triangles), props=props, has_vertex_normals=True
    )
    shape.add_attribute("vertex_albedo", 3, item.albedo.astype(np.float32).ravel())
    buffers = mi.traverse(shape)
    buffers["vertex_positions"] = item.points.astype(np.float32).ravel()
    buffers["vertex_normals"] = (
        vertex_normals(item.points, item.triangles).astype(np.float32).ravel()
    )
    buffers["faces"] = item.triangles.astype(np.uint32).ravel()
    buffers.update()
    return shape


def mitsuba_scene(
    objects: list[StudyObject], others: Mapping[str, Any] = MappingProxyType({})
) -> mi.Scene:
    """The objects, and ``others`` in Mitsuba's words."""
    scene: dict[str, Any] = {"type": "scene", **others}
    scene["integrator"] = {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH}
    scene |= {item.name: mitsuba_shape(item) for item in objects}
    return mi.load_dict(scene)


def render(
    scene: mi.Scene, world_from_camera: Array, samples: int, seed: int, lens: Lens = STUDY
) -> Array:
    """(H, W, 3) mean radiance over each pixel's square, from ``samples`` paths per pixel."""
    # Mitsuba's cameras look down +z with x to the left.
    pose = world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(lens.width / 2 / lens.focal))),
            "near_clip": 0.01,
            "far_clip": 100.0,
            "to_world": mi.ScalarTransform4f(pose),
            "sampler": {"type": "multijitter"},
            "film": {
                "type": "hdrfilm",
                "width": lens.width,
                "height": lens.height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )
    total = np.zeros((lens.height, lens.width, 3))
    passes = max(1, round(samples / SAMPLES_PER_PASS))
    for k in range(passes):
        image = mi.render(scene, sensor=sensor, spp=samples // passes, seed=seed * 1000 + k)
        total += np.array(image, dtype=np.float64)
    return total / passes


def write_mesh(path: Path, objects: list[StudyObject]) -> None:
    """All objects as one binary PLY with an int face property ``object_id``."""
    points = np.concatenate([item.points for item in objects]).astype("<f4")
    starts = np.cumsum([0] + [len(item.points) for item in objects])
    face = np.dtype([("count", "u1"), ("vertices", "<i4", 3), ("object_id", "<i4")])
    faces = np.zeros(sum(len(item.triangles) for item in objects), face)
    faces["count"] = 3
    faces["vertices"] = np.concatenate(
        [item.triangles + start for item, start in zip(objects, starts, strict=False)]
    )
    faces["object_id"] = np.repeat(np.arange(len(objects)), [len(o.triangles) for o in objects])
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "property int object_id",
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode() + points.tobytes() + faces.tobytes())


def write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def write_objects(folder: Path, objects: list[StudyObject]) -> None:
    labels = [
        {"id": k, "name": item.name, "class_name": item.class_name}
        for k, item in enumerate(objects)
    ]
    truth = [
        {"id": k, "name": item.name, "phi": item.phi, "psi": item.psi, "emission": item.emission}
        for k, item in enumerate(objects)
    ]
    write_json(folder / "objects.json", {"objects": labels})
    write_json(folder / "truth/objects.json", truth)
    np.savez_compressed(
        folder / "truth/albedo_vertex.npz",
        albedo=np.concatenate([item.albedo for item in objects]).astype(np.float16),
    )


def capture_header() -> dict[str, Any]:
    return {
        "camera_model": "PINHOLE",
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
    }


def write_frames(
    folder: Path,
    scene: mi.Scene,
    samples: int,
    poses: list[tuple[Array, float]],
    seed: int = SEED,
    lens: Lens = STUDY,
) -> list[dict[str, Any]]:
    """Photographs from poses (4, 4), each with its exposure in seconds; returns their records."""
    records = []
    for k, (pose, exposure) in enumerate(poses):
        clean = render(scene, pose, samples, seed=seed + k, lens=lens)
        name = f"frames/{k:04d}.exr"
        rng = np.random.default_rng([seed, k])
        write_exr(folder / name, photograph(clean, exposure, rng), exposure)
        records.append(
            {
                "file_path": name,
                "transform_matrix": pose.tolist(),
                "exposure_time": exposure,
                "saturation_radiance": saturation_radiance(exposure),
                "noise_floor_radiance": noise_floor_radiance(exposure),
            }
        )
    return records


def poses_of(document: Path) -> list[tuple[Array, float]]:
    """Those of a document like transforms.json."""
    frames = json.loads(document.read_text("utf-8"))["frames"]
    return [(np.array(f["transform_matrix"], np.float64), f["exposure_time"]) for f in frames]


def write_held_out(folder: Path, scene: mi.Scene, samples: int) -> None:
    records = []
    for k, pose in enumerate(held_out_poses()):
        name = f"view_{k:02d}.exr"
        write_exr(folder / "truth" / name, render(scene, pose, samples, seed=SEED + 900 + k))
        records.append({"file_path": name, "transform_matrix": pose.tolist()})
    write_json(folder / "truth/views.json", capture_header() | {"frames": records})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    default = Path(__file__).resolve().parent / "study"
    parser.add_argument("--output", type=Path, default=default, help="folder (%(default)s)")
    parser.add_argument("--samples", type=int, default=256, help="paths per pixel (%(default)s)")
    parser.add_argument("--poses", type=Path, help="photograph from these alone")
    parser.add_argument("--check", action="store_true", help="only check the BSDF")
    options = parser.parse_args()
    if options.check:
        print("\n".join(study_brdf.check_brdf()))
        return
    if options.poses and options.output == default:
        parser.error("--poses: name another folder with --output.")
    start = time.monotonic()
    if options.poses:
        (options.output / "frames").mkdir(parents=True)
        scene = mitsuba_scene(study_objects())
        # Random numbers of their own: the same noise as in the sample's frames would be no noise.
        records = write_frames(
            options.output, scene, options.samples, poses_of(options.poses), SEED + 5000
        )
        write_json(options.output / "transforms.json", capture_header() | {"frames": records})
        return
    for folder in ("frames", "truth"):
        (options.output / folder).mkdir(parents=True, exist_ok=True)
    objects = study_objects()
    write_mesh(options.output / "mesh.ply", objects)
    write_objects(options.output, objects)
    scene = mitsuba_scene(objects)
    poses = [(pose, EXPOSURES[k % len(EXPOSURES)]) for k, pose in enumerate(frame_poses())]
    records = write_frames(options.output, scene, options.samples, poses)
    header = capture_header() | {"mesh": "mesh.ply", "objects": "objects.json"}
    write_json(options.output / "transforms.json", header | {"frames": records})
    write_held_out(options.output, scene, 8 * options.samples)
    files = [p for p in options.output.rglob("*") if p.is_file()]
    size = sum(p.stat().st_size for p in files) / 1e6
    print(f"{len(files)} files, {size:.1f} MB, {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
