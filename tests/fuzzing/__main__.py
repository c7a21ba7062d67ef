"""Reads damaged files with every reader, and says what went wrong.

    python -m tests.fuzzing run [--seconds 60] [--inputs N] [--first N] [--results DIR] [READER ...]
    python -m tests.fuzzing replay READER INPUT [--keep DIR]
    python -m tests.fuzzing table DIR

``run`` gives each reader its share of the time. A finding says "READER INPUT: what happened";
``replay`` makes that input again, shows where its files lie and reads it once.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.fuzzing.process import Process, campaign
from tests.fuzzing.readers import READERS

HANG_SECONDS = 30.0  # for one input; of a process: until it reads the first one
_START_SECONDS, _LOOK_SECONDS = 300.0, 0.05
_MOST_PROCESSES = 200  # of one reader, each of which ended in a crash


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run")
    run.add_argument("readers", nargs="*", metavar="READER")
    run.add_argument("--seconds", type=float, default=60.0)
    run.add_argument("--inputs", type=int, default=1 << 40)
    run.add_argument("--first", type=int, default=1)
    run.add_argument("--results", type=Path)
    again = commands.add_parser("replay")
    again.add_argument("reader")
    again.add_argument("chain", metavar="INPUT")
    again.add_argument("--keep", type=Path)
    commands.add_parser("table").add_argument("results", type=Path)
    worker = commands.add_parser("read")  # started by ``run``
    for name in ("results", "first", "last", "seconds"):
        worker.add_argument(name)
    worker.add_argument("readers", nargs="+")
    given = parser.parse_args()
    if given.command == "read":
        read(given.readers, Path(given.results), int(given.first), int(given.last),
             float(given.seconds))  # fmt: skip
        return 0
    if given.command == "replay":
        return replay(given.reader, given.chain, given.keep)
    results = given.results or Path(tempfile.mkdtemp(prefix="fuzzing-"))
    if given.command == "run":
        names = given.readers or list(READERS)
        fuzz(names, results, given.first, given.first + given.inputs, given.seconds)
    print(table(results))
    found = findings(results)
    print("\n".join(found))
    return int(bool(found))


def read(names: Sequence[str], results: Path, first: int, last: int, seconds: float) -> None:
    """Each reader for its share of the time, in this process, which may crash."""
    begun = time.monotonic()
    for i, name in enumerate(names):
        left = max(begun + seconds - time.monotonic(), 0.0) / (len(names) - i)
        state = results / name
        (results / "reader").write_text(name)
        with tempfile.TemporaryDirectory(prefix="fuzzing-") as folder:
            last_chain = (state / "last").read_text() if (state / "last").is_file() else "0"
            start = max(first, int(last_chain.rpartition(".")[2]) + 1)
            campaign(READERS[name], Path(folder), state, start, last, left)


def fuzz(names: Sequence[str], results: Path, first: int, last: int, seconds: float) -> None:
    """Processes one after another, as a crash or a hang ends one of them. What happened is added to
    files below ``results``."""
    for name in names:
        (results / name).mkdir(parents=True, exist_ok=True)
    begun, waiting = time.monotonic(), list(names)
    for _ in range(_MOST_PROCESSES):
        left = begun + seconds - time.monotonic()
        if not waiting:
            break
        arguments = (str(results), str(first), str(last), str(max(left, 0.0)), *waiting)
        (results / "reader").write_text(waiting[0])
        with (results / "said").open("wb") as said:
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.fuzzing", "read", *arguments],
                stdout=said, stderr=said, env={**os.environ, "NUMBA_NUM_THREADS": "1"},
            )  # fmt: skip
            how = _watched(process, results)
        name = (results / "reader").read_text()
        waiting = waiting[waiting.index(name) :]
        state = results / name
        now = (state / "now").read_text().strip() if (state / "now").is_file() else ""
        if now == "end":
            break
        words = (results / "said").read_text("utf-8", "replace").strip().splitlines()[-1:]
        crashed = how.startswith("crash") and READERS[name].in_child
        crashed = crashed and "bad_alloc" not in "".join(words)
        with (state / ("crashes" if crashed else "found")).open("a") as file:
            file.write(json.dumps({"chain": now or "0", "problem": f"{how} {words}"[:400]}) + "\n")
        (state / "last").write_text(now)
        if not now:  # it did not even come to read
            del waiting[0]


def _watched(process: subprocess.Popen[bytes], results: Path) -> str:
    """How a process ended; one that reads the same input for too long is killed. Looks are counted,
    not time, in which both may have been stopped."""
    last, looks = ("", ""), 0
    while process.poll() is None:
        time.sleep(_LOOK_SECONDS)
        name = (results / "reader").read_text()
        state = results / name / "now"
        now = state.read_text().strip() if state.is_file() else ""
        looks = looks + 1 if (name, now) == last else 0
        last = name, now
        limit = HANG_SECONDS if now else _START_SECONDS
        if looks * _LOOK_SECONDS > limit:
            process.kill()
            process.wait()
            return f"hang: more than {limit:g} s"
    status = process.returncode
    return f"crash: {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"


def replay(name: str, chain: str, keep: Path | None) -> int:
    """Make one input again, and read it in this process."""
    folder = keep or Path(tempfile.mkdtemp(prefix="fuzzing-"))
    if (folder / "seeds").exists():
        shutil.rmtree(folder / "seeds")
    process = Process(READERS[name], folder)
    numbers = tuple(map(int, chain.split(".")))
    seed = process.inputs.place(numbers)
    print(f"reads {seed.entry}")
    for path in seed.targets:
        if path.read_bytes() != process.inputs.sound[path]:
            print(f"damaged {path}")
    sys.stdout.flush()
    problem = process.read(numbers)
    print(problem or "nothing wrong")
    return int(bool(problem))


def findings(results: Path) -> list[str]:
    """One line for all findings of a kind: how many, the first of them."""
    kinds: dict[tuple[str, str], list[dict[str, str]]] = {}
    for file in sorted(results.glob("*/found")):
        for row in map(json.loads, file.read_text().splitlines()):
            kind = re.sub(r"0x[0-9a-f]+|[\d.]+|'[^']*'|/\S+", "#", row["problem"])[:90]
            kinds.setdefault((file.parent.name, kind), []).append(row)
    return [
        f"{name} {rows[0]['chain']} ({len(rows)} times): {rows[0]['problem']}"
        for (name, _), rows in kinds.items()
    ]


def table(results: Path) -> str:
    """Per reader: inputs, share past the form, lines, findings."""
    heads = (
        "reader",
        "inputs",
        "past the form",
        "accepted",
        "lines",
        "crashes in a child",
        "found",
    )
    rows = [" | ".join(heads), " | ".join(["---"] * len(heads))]
    states = sorted(path for path in results.iterdir() if path.is_dir() and path.name in READERS)
    figures = {
        state.name: [json.loads(file.read_text()) for file in state.glob("figures-*.json")]
        for state in states
    }
    totals = [0, 0]
    for state in states:
        own = figures[state.name]
        inputs, past, accepted = (
            sum(each[key] for each in own) for key in ("inputs", "past", "accepted")
        )
        # Readers of the same lines, such as those of pictures, reach them together.
        alike = [n for n in figures if READERS[n].lines == READERS[state.name].lines]
        together = [each for name in alike for each in figures[name]]
        missed = set.intersection(*(set(each["missed"]) for each in together)) if together else {1}
        lines = 1 - len(missed) / (together[0]["lines"] if together else 1)
        crashes, found = (
            len((state / kind).read_text().splitlines()) if (state / kind).is_file() else 0
            for kind in ("crashes", "found")
        )
        totals = [totals[0] + inputs, totals[1] + found]
        shares = (f"{number / max(inputs, 1):.0%}" for number in (past, accepted))
        rows.append(" | ".join((state.name, str(inputs), *shares, f"{lines:.0%}", str(crashes),
                                str(found))))  # fmt: skip
    rows.append(f"all | {totals[0]} | | | | | {totals[1]}")
    return "\n".join(f"| {row} |" for row in rows)


if __name__ == "__main__":
    sys.exit(main())
