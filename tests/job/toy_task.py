"""A task with tiles, a running state, textures, layers and a once-only file; run as a script.

python toy_task.py ASSET [seed] [--fewer]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from tests.fault_injection import arm_from_environment
from usdbrdf.files.images import write_exr
from usdbrdf.job.ownership import owned_folder
from usdbrdf.job.task import TaskResult, TaskRun, run_task

TILES = 3
FRAMES = 6


def toy_work(run: TaskRun, seed: int, textures: int) -> dict[str, object]:
    computed = []

    def tile(index: int) -> dict[str, np.ndarray]:
        computed.append(index)
        generator = np.random.default_rng((seed, index))
        return {"radiance": generator.random((8, 8, 3)).astype(np.float32)}

    tiles = [run.checkpoint(f"tile/{i}", lambda i=i: tile(i))["radiance"] for i in range(TILES)]
    done = run.latest("sum")
    first, total = (done[0] + 1, done[1]["total"]) if done else (0, np.zeros(3))
    for frame in range(first, FRAMES):
        computed.append(100 + frame)
        total = total / 3 + np.random.default_rng((seed, 9, frame)).random(3)
        run.save_latest("sum", frame, {"total": total})
    for index in range(textures):
        write_exr(run.output(f"textures/box{index}.lit.exr"), tiles[index])
    run.output("layers/toy_uv.usdc").write_bytes(total.tobytes())
    run.output("layers/toy.usda").write_text(f"#usda 1.0\n# {total.tolist()}\n", "utf-8")
    run.output_once("edits.usda").write_text("#usda 1.0\n", "utf-8")
    run.asset.with_suffix(".computed").write_text(repr(computed), "utf-8")
    return {"total": total.tolist(), "textures": textures}


def run_toy(asset: Path, seed: int = 1, *, textures: int = 3) -> TaskResult:
    with owned_folder(asset):
        return run_task(
            asset,
            "toy",
            order=20,
            parameters={"seed": seed, "textures": textures},
            inputs={"scan": "ab" * 32},
            work=lambda run: toy_work(run, seed, textures),
        )


if __name__ == "__main__":
    arm_from_environment()
    options = [argument for argument in sys.argv[2:] if argument.startswith("--")]
    numbers = [int(argument) for argument in sys.argv[2:] if not argument.startswith("--")]
    result = run_toy(Path(sys.argv[1]), *numbers, textures=2 if "--fewer" in options else 3)
    print(result.reran, result.reason)
