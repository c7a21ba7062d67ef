"""How far work on many machines carries: a model of cost, and a simulation of up to 1,000 workers.

    python benchmarks/scale_model.py [-o FOLDER]

What a unit costs was measured (`Measured`); what the machines can is assumed (`Cluster`). SimPy
plays one scan, as one scene or divided into parts, and a farm of scans: workers ask a scheduler
for units, read through a storage that all share, compute, write, and wait at the end of each step.
Needs the extras `dev` (SimPy) and `report` (matplotlib). docs/scale.md tells what came of it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import simpy

FEWEST_TEXELS = 4096  # of a unit: a tile


@dataclass(frozen=True, kw_only=True)
class Measured:
    """CPU seconds and bytes, of the run of 16 million texels in docs/speed.md (4,980 CPU seconds,
    shared out by the clock of its phases) unless it says else."""

    texture: float = 33e-6  # per texel, at 400 frames of 1224 x 1024 for 16 million
    shade: float = 89e-6
    refine: float = 56e-6
    relight: float = 56e-6  # irradiance once more, with what was found
    fit: float = 0.98  # per object
    # Of one thread alone: reading and cleaning, and laying out charts, per triangle; packing and
    # writing maps and layers, per texel and step (benchmarks/step_costs.py on the sample).
    ingest_alone: float = 4.7e-6
    charts: float = 40e-6  # per triangle, object by object
    write_alone: float = 2e-6
    light_alone: float = 5.0  # one solve over the scene
    scene_cpu: float = 0.36e-6  # building the BVH, per triangle (RayScene of 4 million)
    scene_bytes: float = 100.0  # of it and of the mesh in memory, per triangle
    mesh_bytes: float = 30.0  # in a file, per triangle
    lit_bytes: float = 6.0  # L_d as every ray looks it up, per texel
    frame_bytes: float = 4.5e6  # 1224 x 1024, half float, ZIP
    frame_cpu: float = 0.05  # decoding it
    result_bytes: float = 40.0  # per texel of texture and refine; a quarter of that of the others
    start: float = 1.5  # of a task of a farm: loading the program (benchmarks/farm.py)


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """What is assumed of the machines."""

    workers: int = 1000
    cores: int = 2  # of a worker
    scheduler: float = 3.4e-3  # seconds per task, one after another (Dask 2026.8, LocalCluster)
    storage: float = 10e9  # bytes per second, all together
    link: float = 1.25e9  # bytes per second of a worker
    spread: float = 0.25  # of the logarithm of a unit's time
    slow: float = 0.02  # share of workers that take twice as long
    unit_seconds: float = 10.0  # that units are cut to, where there are enough


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A capture; what else it has follows from its texels as in the run that was measured."""

    texels: float
    # Of how many units each frame is read; None: every worker reads all frames in each step.
    readers: float | None = None
    # Units clean the mesh and write the maps too, and the scene goes from worker to worker.
    shared_out: bool = False

    @property
    def frames(self) -> float:
        return max(12.0, 400 * self.texels / 16e6)

    @property
    def triangles(self) -> float:
        return 5e6 * self.texels / 16e6

    @property
    def objects(self) -> int:
        return max(1, round(1000 * self.texels / 16e6))


@dataclass(frozen=True, kw_only=True)
class Step:
    """Seconds of one thread first, then units that anybody may do: CPU seconds of all together
    (of which ``twice`` are spent on what another unit did too), and what each worker needs once
    before its first."""

    name: str
    alone: float
    cpu: float
    units: int
    read: float  # bytes per unit
    written: float
    twice: float = 0.0
    handed_on: bool = False  # what is needed once comes from other workers, not from the storage
    once_cpu: float = 0.0
    once_read: float = 0.0


def steps_of(scan: Scan, cluster: Cluster, known: Measured) -> list[Step]:
    """What one scan takes as one scene."""
    triangles, texels = scan.triangles, scan.texels
    mesh = triangles * known.mesh_bytes
    scene = {"once_cpu": triangles * known.scene_cpu, "once_read": mesh + texels * known.lit_bytes}

    def step(name: str, cpu: float, *, frames: bool = False, most: int = 2**31, alone: float = 0.0,
             written: float = 1.0, **once: float) -> Step:  # fmt: skip
        # Longer ones do no harm where a worker gets many.
        wanted = min(cpu / (cluster.unit_seconds * cluster.cores), 64 * cluster.workers)
        units = round(max(1, min(max(wanted, 4 * cluster.workers), texels / FEWEST_TEXELS, most)))
        read = twice = 0.0
        if frames:
            readers = float(cluster.workers) if scan.readers is None else scan.readers
            readers = min(readers, units)
            read = scan.frames * readers * known.frame_bytes / units
            # One decoding of each frame is in what was measured.
            twice = scan.frames * (readers - 1) * known.frame_cpu
        result = written * known.result_bytes * texels / units
        pack = texels * known.write_alone
        return Step(
            name=name, alone=alone + (0.0 if scan.shared_out else pack), units=units, read=read,
            cpu=cpu + twice + (pack if scan.shared_out else 0.0), written=result, twice=twice,
            handed_on=scan.shared_out, **once,
        )  # fmt: skip

    charts, cleaned = triangles * known.charts, triangles * known.ingest_alone
    pieces = min(scan.objects, 4 * cluster.workers if scan.shared_out else 10**5)
    return [
        Step(name="ingest", alone=0.0 if scan.shared_out else cleaned, units=pieces, written=0.0,
             cpu=charts + (cleaned if scan.shared_out else 0.0), read=mesh / pieces),
        step("texture", texels * known.texture, frames=True, once_read=mesh),
        step("shade", texels * known.shade, written=0.25, alone=known.light_alone, **scene),
        step("fit", scan.objects * known.fit, most=scan.objects, written=0.0),
        step("refine", texels * known.refine, frames=True),
        step("relight", texels * known.relight, written=0.25),
    ]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Seconds; what one worker would take, over what all together had; and the shares of that
    which went elsewhere, by cause."""

    workers: int
    seconds: float
    efficiency: float
    core_hours: float  # held
    lost: dict[str, float]
    steps: dict[str, float]


def played(steps: Sequence[Step], cluster: Cluster, seed: int = 0) -> Outcome:
    """One scan from its first step to its last."""
    rng = np.random.default_rng(seed)
    world = simpy.Environment()
    scheduler = simpy.Resource(world)
    lanes = simpy.Resource(world, max(1, round(cluster.storage / cluster.link)))
    slow = np.where(rng.random(cluster.workers) < cluster.slow, 2.0, 1.0)
    spent = dict.fromkeys(("work", "alone", "scheduler", "storage", "scene", "slow", "twice"), 0.0)
    ends: dict[str, float] = {}

    def moved(amount: float, cause: str) -> Iterator[Any]:
        if amount > 0:
            begun = world.now
            with lanes.request() as lane:
                yield lane
                yield world.timeout(amount / cluster.link)
            spent[cause] += world.now - begun

    def worker(number: int, step: Step, left: list[int]) -> Iterator[Any]:
        begun = False
        while left:
            times = left.pop()
            asked = world.now
            with scheduler.request() as turn:
                yield turn
                yield world.timeout(cluster.scheduler * times)
            spent["scheduler"] += world.now - asked
            if not begun:
                begun = True
                if step.handed_on:
                    yield world.timeout(step.once_read / cluster.link)
                    spent["scene"] += step.once_read / cluster.link
                else:
                    yield from moved(step.once_read, "scene")
                yield world.timeout(step.once_cpu / cluster.cores)
                spent["scene"] += step.once_cpu / cluster.cores
            yield from moved(step.read * times, "storage")
            mean = step.cpu * times / step.units / cluster.cores
            factor = math.exp(rng.normal(0.0, cluster.spread) - cluster.spread**2 / 2)
            yield world.timeout(mean * factor * slow[number])
            spent["work"] += mean * (1 - step.twice / step.cpu)
            spent["twice"] += mean * step.twice / step.cpu
            spent["slow"] += mean * (factor * slow[number] - 1)
            yield from moved(step.written * times, "storage")

    def scan() -> Iterator[Any]:
        for step in steps:
            yield world.timeout(step.alone)
            spent["work"] += step.alone
            spent["alone"] += step.alone * (cluster.workers - 1)
            left = [1] * step.units
            yield simpy.AllOf(
                world,
                [
                    world.process(worker(n, step, left))
                    for n in range(min(cluster.workers, step.units))
                ],
            )
            ends[step.name] = world.now

    world.run(world.process(scan()))
    names, times = [*ends], [0.0, *ends.values()]
    took = {n: round(b - a, 1) for n, a, b in zip(names, times, times[1:], strict=False)}
    return _outcome(world.now, spent, cluster, took)


def farmed(sizes: Sequence[float], cluster: Cluster, known: Measured, seed: int = 0) -> Outcome:
    """Scans that each one worker converts alone, in their order; sizes in texels."""
    rng = np.random.default_rng(seed)
    world = simpy.Environment()
    scheduler = simpy.Resource(world)
    lanes = simpy.Resource(world, max(1, round(cluster.storage / cluster.link)))
    slow = np.where(rng.random(cluster.workers) < cluster.slow, 2.0, 1.0)
    left = [*sizes][::-1]
    spent = dict.fromkeys(("work", "storage", "slow", "start"), 0.0)

    def worker(number: int) -> Iterator[Any]:
        while left:
            scan = Scan(texels=left.pop(), readers=1.0)
            alone = replace(cluster, workers=1)
            steps = steps_of(scan, alone, known)
            with scheduler.request() as turn:
                yield turn
                yield world.timeout(cluster.scheduler)
            amount = sum((s.read + s.written) * s.units for s in steps)
            begun = world.now
            with lanes.request() as lane:
                yield lane
                yield world.timeout(amount / cluster.link)
            spent["storage"] += world.now - begun
            useful = sum((s.cpu - s.twice) / cluster.cores + s.alone for s in steps)
            extra = known.start + sum(s.once_cpu / cluster.cores for s in steps)
            yield world.timeout((useful + extra) * slow[number])
            spent["work"] += useful
            spent["start"] += extra
            spent["slow"] += (useful + extra) * (slow[number] - 1)

    world.run(simpy.AllOf(world, [world.process(worker(n)) for n in range(cluster.workers)]))
    return _outcome(world.now, spent, cluster, {})


def _outcome(
    seconds: float, spent: dict[str, float], cluster: Cluster, steps: dict[str, float]
) -> Outcome:
    held = seconds * cluster.workers
    lost = {cause: amount / held for cause, amount in spent.items() if cause != "work"}
    lost["idle"] = 1 - spent["work"] / held - sum(lost.values())
    return Outcome(
        workers=cluster.workers,
        seconds=seconds,
        efficiency=spent["work"] / held,
        core_hours=held * cluster.cores / 3600,
        lost={cause: round(share, 3) for cause, share in lost.items()},
        steps=steps,
    )


def parts_of(scan: Scan, workers: int) -> list[float]:
    """Texels of each part of a scan that is divided, of 1 to 16 million and four for each worker,
    with a border of a fifth around the largest; that of smaller ones has the same width."""
    size = min(max(scan.texels / (4 * workers), 1e6), 16e6)
    count = max(1, round(scan.texels / size))
    border = 0.2 * math.sqrt(16e6 / size) if count > 1 else 0.0
    return [scan.texels * (1 + border) / count] * count


def memory_of(scan: Scan, known: Measured) -> float:
    """GiB that a worker needs: the scene, L_d, and a unit's state."""
    scene = scan.triangles * known.scene_bytes + scan.texels * known.lit_bytes
    return (scene + 1.5e9) / 2**30


def ways(
    scan: Scan, clusters: Sequence[Cluster], known: Measured
) -> dict[str, list[dict[str, Any]]]:
    """A scan as one scene in three ways, and divided into parts that each one worker converts."""
    kinds = {
        "all frames": scan,
        "its frames": replace(scan, readers=4.0),
        "shared out": replace(scan, readers=4.0, shared_out=True),
    }
    rows = {
        name: [asdict(played(steps_of(kind, cluster, known), cluster)) for cluster in clusters]
        for name, kind in kinds.items()
    }
    rows["parts"] = []
    for cluster in clusters:
        parts = parts_of(scan, cluster.workers)
        done = farmed(parts, cluster, known)
        # What borders cost twice is no work that was asked for.
        share = scan.texels / sum(parts)
        rows["parts"].append(asdict(replace(done, efficiency=done.efficiency * share)))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, help="folder for scale.json and scale.png")
    chosen = parser.parse_args(arguments)
    known, base = Measured(), Cluster()
    counts = (1, 10, 32, 100, 316, 1000)
    found: dict[str, Any] = {"measured": asdict(known), "assumed": asdict(base), "one": {}}
    for exponent in (6, 7, 8, 9, 10):
        scan = Scan(texels=10.0**exponent)
        rows = ways(scan, [replace(base, workers=workers) for workers in counts], known)
        found["one"][f"1e{exponent}"] = rows
        found.setdefault("memory_GiB", {})[f"1e{exponent}"] = round(memory_of(scan, known), 1)
        print(f"10^{exponent}", *(f"{n}: {told(r[-1])}" for n, r in rows.items()), sep="\n  ")
    many = [replace(base, workers=workers, cores=16) for workers in (1, 12, 40, 125)]
    found["large workers"] = ways(Scan(texels=1e9), many, known)
    for name, points in found["large workers"].items():
        print(f"10^9, workers of 16 cores, {name}: {told(points[-1])}")
    sizes = np.random.default_rng(1).lognormal(math.log(16e6), 0.6, 10_000)
    found["farm"] = {
        order: [asdict(farmed(some, replace(base, workers=n), known)) for n in counts]
        for order, some in (("as they come", sizes), ("largest first", np.sort(sizes)[::-1]))
    }
    for order, rows in found["farm"].items():
        print(f"10,000 scans, {order}: {told(rows[-1])}")
    if chosen.output is not None:
        chosen.output.mkdir(parents=True, exist_ok=True)
        (chosen.output / "scale.json").write_text(json.dumps(found, indent=2) + "\n")
        plot(found, chosen.output / "scale.png")
    return 0


def told(row: dict[str, Any]) -> str:
    lost = sorted(row["lost"].items(), key=lambda item: -item[1])[:4]
    why = ", ".join(f"{cause} {share:.0%}" for cause, share in lost if share > 0.01)
    return (
        f"{row['workers']} workers {row['seconds']:,.0f} s, efficiency {row['efficiency']:.0%}, "
        f"{row['core_hours']:,.0f} core-hours; lost: {why}"
    )


def plot(found: dict[str, Any], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 2, figsize=(11, 7.5), layout="constrained")
    one = found["one"]["1e9"]
    titles = {
        "all frames": "one scene, every worker reads all frames",
        "its frames": "one scene, units read the frames that see them",
        "shared out": "the same, and units clean, write and hand on",
        "parts": "parts of 1 to 16 million texels",
    }
    for column, (rows, labels) in enumerate(((one, titles), (found["farm"], {}))):
        for name, points in rows.items():
            workers = [point["workers"] for point in points]
            label = labels.get(name, name)
            axes[0][column].loglog(
                workers, [p["seconds"] / 3600 for p in points], "o-", label=label
            )
            axes[1][column].loglog(workers, [p["core_hours"] for p in points], "o-", label=label)
        axes[0][column].set(
            ylabel="hours", title=("one scan of 10^9 texels", "10,000 scans")[column]
        )
        axes[1][column].set(xlabel="workers of 2 cores", ylabel="core-hours held")
        axes[1][column].legend(loc="upper left")
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
