"""Many small scans through a job bundle: does every good one become an asset and every bad one a
refusal by name, and does a second run do nothing?

    python benchmarks/farm.py OUT [--scans 40] [--frames 12] [--per-task 8] [--json FILE]

The scans are samples/study with different frames each, at coarse texels; three are damaged: one has
no mesh, one has poses that are none, one has truncated frames. `usdbrdf farm` writes the bundle,
`openjd run` runs it twice (extra `farm`). Exit code 1 if anything came out otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "study"
OPTIONS = ("--texel-size", "0.3", "--rays", "16", "--max-pixels", "60", "--environment", "none")


def write_scan(folder: Path, number: int, frames: int) -> None:
    """The sample with so many of its frames, drawn by the scan's number."""
    document = json.loads((SAMPLE / "transforms.json").read_text())
    drawn = np.random.default_rng(number).choice(len(document["frames"]), frames, replace=False)
    document["frames"] = [document["frames"][i] for i in sorted(drawn)]
    (folder / "frames").mkdir(parents=True)
    for frame in document["frames"]:
        shutil.copy(SAMPLE / frame["file_path"], folder / frame["file_path"])
    for name in ("mesh.ply", "objects.json"):
        shutil.copy(SAMPLE / name, folder / name)
    (folder / "transforms.json").write_text(json.dumps(document))


def without_mesh(folder: Path) -> None:
    (folder / "mesh.ply").unlink()


def with_flat_poses(folder: Path) -> None:
    document = json.loads((folder / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["transform_matrix"][0] = [0.0, 0.0, 0.0, 0.0]
    (folder / "transforms.json").write_text(json.dumps(document))


def with_truncated_frames(folder: Path) -> None:
    for frame in (folder / "frames").iterdir():
        frame.write_bytes(frame.read_bytes()[:1000])


DAMAGES = (without_mesh, with_flat_poses, with_truncated_frames)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("output", type=Path, help="new folder for scans and results")
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--per-task", type=int, default=8)
    parser.add_argument("--json", type=Path, help="write the figures into this file")
    chosen = parser.parse_args(arguments)
    scans = [chosen.output / "scans" / f"scan_{number:03}" for number in range(chosen.scans)]
    for number, scan in enumerate(scans):
        write_scan(scan, number, chosen.frames)
    # Spread over the tasks.
    bad = [scans[(2 * i + 1) * chosen.scans // (2 * len(DAMAGES))] for i in range(len(DAMAGES))]
    for damage, scan in zip(DAMAGES, bad, strict=True):
        damage(scan)
    bundle = chosen.output / "bundle"
    words = [*map(str, scans), "-o", str(bundle), "--chunk", str(chosen.per_task)]
    subprocess.run([sys.executable, "-m", "usdbrdf", "farm", *words, *OPTIONS], check=True)
    first, between = run(bundle), snapshot(bundle)
    second = run(bundle)
    second["written"] = sum(state != between.get(file) for file, state in snapshot(bundle).items())
    figures = {"scans": chosen.scans, "first": first, "second": second}
    text = json.dumps(figures, indent=2)
    print(text)
    if chosen.json is not None:
        chosen.json.write_text(text + "\n")
    return int(not as_expected(first, second, chosen.scans, {scan.name for scan in bad}))


def run(bundle: Path) -> dict[str, Any]:
    """One run of the whole bundle: its times, its status, that of the table, and what it says."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    command = ["openjd", "run", str(bundle / "template.json"), "--step", "Table"]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    job = subprocess.run(
        [*command, "--run-dependencies"], env=os.environ | {"PATH": path}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    wall = time.monotonic() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    table = subprocess.run(
        [sys.executable, "-m", "usdbrdf", "farm-table", str(bundle), "--json"],
        stdout=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    found = json.loads(table.stdout)
    return {
        "seconds": round(wall, 1),
        "cpu_seconds": round(
            after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1
        ),
        "peak_MiB": after.ru_maxrss // 1024,
        "job_status": job.returncode,
        "table_status": table.returncode,
        "counts": found["counts"],
        "objects": found["objects"],
        "measured": found["measured"],
        "not_good": {s["name"]: s["sentence"] for s in found["scans"] if s["status"] != "good"},
        "assets": len([*bundle.glob("results/assets/*/*.usda")]) // 2,
        "pages": len([*bundle.glob("results/pages/*.html")]),
    }


def snapshot(bundle: Path) -> dict[Path, tuple[int, int]]:
    """Of the files of all assets and pages when they were written, and how long they are; without
    those that tell who works there."""
    found = (p for part in ("assets", "pages") for p in (bundle / "results" / part).rglob("*"))
    files = (path for path in found if path.is_file() and path.name != "lock")
    return {path: ((state := path.stat()).st_mtime_ns, state.st_size) for path in files}


def as_expected(first: dict[str, Any], second: dict[str, Any], scans: int, bad: set[str]) -> bool:
    good = scans - len(bad)
    same = [key for key in first if key not in ("seconds", "cpu_seconds", "peak_MiB")]
    return (
        first["counts"] == {"good": good, "refused": len(bad)}
        and set(first["not_good"]) == bad
        and first["job_status"] != 0
        and first["table_status"] == 3
        and first["assets"] == first["pages"] == good
        and second["written"] == 0
        and all(first[key] == second[key] for key in same)
    )


if __name__ == "__main__":
    sys.exit(main())
