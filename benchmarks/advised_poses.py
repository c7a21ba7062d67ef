"""What advised photographs bring, against as many at random, in a capture whose truth is known.

    python benchmarks/advised_poses.py CAPTURE WORK [--poses 6] [--draws 5] [--samples 256]

CAPTURE is the sample, or another whose truth/ names phi, psi, emission and albedo of all objects.
Every third group of three of its frames (all exposures are among them) becomes an asset, which
`usdbrdf advise` is asked about. Its poses are path traced with the sample's path tracer
(`samples/make_study.py`), added to that third, and the whole is converted anew; so are as many
random poses from free space, in several draws. Counted are objects whose phi and psi count as
measured; and the area that the poses show, of what any of 1,000 random free poses shows and the
third of the frames does not. Free poses are those of `capture_of_scene.py`, which knows nothing of
advice. What lies in WORK already is not made again. WORK/advised_poses.json has all figures.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))
from capture_of_scene import CLEARANCE, free_places, looks_from
from make_study import Lens, mitsuba_scene, write_frames
from mitsuba_scene import write_json
from study_camera import Array
from true_scene import joined, random_points, triangle_areas, true_objects

from usdbrdf.model.camera import Camera
from usdbrdf.transport.rays import RayScene

FREE_POSES, POINTS, SEED = 1000, 20_000, 77
MIN_COSINE = 0.1  # flatter a surface is hardly seen


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--samples", type=int, default=256, help="paths per pixel")
    options = parser.parse_args()
    work = options.work
    work.mkdir(parents=True, exist_ok=True)

    third = third_of(options.capture, work / "third")
    before = measured(convert(third, work / "third_asset"))
    advice = advised(work / "third_asset", options.poses)
    scene = Scene(options.capture)
    free = scene.free_poses(third)
    times = sorted({frame["exposure_time"] for frame in document(third)["frames"]}, reverse=True)
    rng = np.random.default_rng(SEED)
    draws = [
        [(free[i], times[k % len(times)]) for k, i in enumerate(drawn[: options.poses])]
        for drawn in (rng.permutation(len(free)) for _ in range(options.draws))
    ]
    rows = {"advised": advice, **{f"random_{k}": draw for k, draw in enumerate(draws)}}
    shown = scene.shares(third, free, rows)
    print(json.dumps(shown, indent=1), flush=True)
    found: dict[str, Any] = {"before": before, "shares": shown, "rows": {}}
    for number, (name, poses) in enumerate(rows.items()):
        more = scene.with_more(third, work / name, poses, options.samples, SEED + 100 * number)
        after = measured(convert(more, more.with_name(f"{more.name}_asset")))
        found["rows"][name] = {"measured": after, "more": len(set(after) - set(before))}
        print(name, len(after), sorted(set(after) - set(before)), sorted(set(before) - set(after)),
              f"{shown['seen'][name]:.0%}", flush=True)  # fmt: skip
        write_json(work / "advised_poses.json", found)
    random = [len(row["measured"]) for name, row in found["rows"].items() if name != "advised"]
    gained = len(found["rows"]["advised"]["measured"]) - float(np.mean(random or [np.nan]))
    print(f"objects measured: {len(before)} before, {gained:+.1f} by advice against chance")
    return 0


def third_of(capture: Path, folder: Path) -> Path:
    """The capture with every third group of three of its frames."""
    if not folder.exists():
        half_done = folder.with_name(f"{folder.name}.half-done")
        shutil.rmtree(half_done, ignore_errors=True)
        shutil.copytree(capture, half_done)
        whole = document(half_done)
        whole["frames"] = [f for k, f in enumerate(whole["frames"]) if k // 3 % 3 == 0]
        write_json(half_done / "transforms.json", whole)
        half_done.rename(folder)
    return folder


def document(capture: Path) -> Any:
    return json.loads((capture / "transforms.json").read_text("utf-8"))


def run(*words: str | Path) -> Any:
    """What a command of usdbrdf says as JSON."""
    command = [sys.executable, "-m", "usdbrdf", *map(str, words), "--json", "-q"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def convert(capture: Path, asset: Path) -> Any:
    return run("convert", capture, "-o", asset)


def measured(summary: Any) -> list[str]:
    objects = summary["steps"]["fit"]["objects"]
    return sorted(name for name, row in objects.items() if row["status"] == "measured")


def advised(asset: Path, count: int) -> list[tuple[Array, float]]:
    """Poses (4, 4) and exposures of the advised photographs."""
    from pxr import Usd, UsdGeom

    found = run("advise", asset, "--poses", str(count))
    for pose in found["poses"]:
        print(pose["where"], pose["reason"])
    stage = Usd.Stage.Open(found["layer"])
    cameras = [prim for prim in stage.TraverseAll() if prim.IsA(UsdGeom.Camera)]
    poses = [np.array(UsdGeom.Xformable(c).ComputeLocalToWorldTransform(0)).T for c in cameras]
    return [(pose, row["exposure_time"]) for pose, row in zip(poses, found["poses"], strict=True)]


class Scene:
    """The true scene: its surface for rays, and for the path tracer."""

    def __init__(self, capture: Path) -> None:
        self.objects = true_objects(capture)
        first = np.cumsum([0, *(len(item.points) for item in self.objects)])
        self.rays = RayScene(
            np.concatenate([item.points for item in self.objects]).astype(np.float32),
            np.concatenate(
                [item.triangles + n for item, n in zip(self.objects, first, strict=False)]
            ).astype(np.int32),
        )
        whole = document(capture)
        self.lens = Lens(whole["w"], whole["h"], whole["fl_x"])
        areas = np.array([triangle_areas(item).sum() for item in self.objects])
        rng = np.random.default_rng(SEED)
        counts = np.round(POINTS * areas / areas.sum()).astype(int)
        self.points = joined(
            random_points(item, k, counts[k], rng) for k, item in enumerate(self.objects)
        )
        # Each stands for its object's share of area.
        self.area = np.repeat(areas / np.maximum(counts, 1), counts)

    def camera(self, pose: Array) -> Camera:
        width, height, focal = self.lens
        lens = (focal, focal, width / 2, height / 2)
        return Camera(world_from_camera=pose, intrinsics=lens, width=width, height=height)

    def free_poses(self, capture: Path) -> list[Array]:
        """1,000 of the free poses, at random."""
        rng = np.random.default_rng(SEED)
        eye = np.array(document(capture)["frames"][0]["transform_matrix"])[:3, 3]
        up = np.array([0.0, 0.0, 1.0])
        poses = [
            pose
            for place in free_places(self.rays, eye, up, rng)
            for pose in looks_from(place, up, rng)
        ]
        print(f"{len(poses)} free poses, {CLEARANCE} m from all surfaces")
        return [poses[i] for i in rng.permutation(len(poses))[:FREE_POSES]]

    def shows(self, pose: Array) -> np.ndarray:
        """(points,) bool: whether a photograph from there shows them."""
        camera, points = self.camera(pose), self.points
        way = points.position - camera.eye
        distance = np.linalg.norm(way, axis=1)
        facing = -np.einsum("nd,nd->n", points.geometric_normal, way) > MIN_COSINE * distance
        x, y, z = (way @ pose[:3, :3]).T
        width, height, focal = self.lens
        inside = (z < 0) & (np.abs(x) * focal < -z * width / 2)
        inside &= np.abs(y) * focal < -z * height / 2
        index = np.flatnonzero(facing & inside)
        origins = np.tile(camera.eye.astype(np.float32), (len(index), 1))
        hits = self.rays.closest(origins, way[index].astype(np.float32))
        seen = np.zeros(len(facing), bool)
        seen[index] = np.abs(hits.distance - 1) * distance[index] < 1e-3
        return seen

    def shares(
        self, third: Path, free: list[Array], rows: dict[str, list[tuple[Array, float]]]
    ) -> dict[str, Any]:
        """Of what free poses show and the third does not, how much each row's poses show."""

        def any_of(poses: list[Array]) -> np.ndarray:
            return np.any([self.shows(pose) for pose in poses], axis=0)

        frames = [np.array(f["transform_matrix"]) for f in document(third)["frames"]]
        unseen = any_of(free) & ~any_of(frames)
        whole = float(self.area @ unseen)
        seen = {
            name: round(float(self.area @ (unseen & any_of([p for p, _ in poses]))) / whole, 4)
            for name, poses in rows.items()
        }
        return {"unseen_m2": round(whole, 3), "seen": seen}

    def with_more(
        self, third: Path, folder: Path, poses: list[tuple[Array, float]], samples: int, seed: int
    ) -> Path:
        """The third with photographs from further poses, in a folder named after these."""
        told = repr([(pose.tolist(), time) for pose, time in poses]) + f" {samples} {seed}"
        folder = folder.with_name(f"{folder.name}_{hashlib.sha256(told.encode()).hexdigest()[:8]}")
        if not (folder / "transforms.json").exists():
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(third, folder, ignore=shutil.ignore_patterns("transforms.json"))
            new = folder / "more"
            (new / "frames").mkdir(parents=True)
            records = write_frames(
                new, mitsuba_scene(self.objects), samples, poses, seed, self.lens
            )
            for record in records:
                record["file_path"] = f"more/{record['file_path']}"
            whole = document(third)
            whole["frames"] += records
            write_json(folder / "transforms.json", whole)
        return folder


if __name__ == "__main__":
    sys.exit(main())
