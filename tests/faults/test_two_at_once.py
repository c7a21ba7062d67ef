"""While a run puts its files in place all others are refused, and an artist who saves is not."""

from __future__ import annotations

import ast

import pytest

from tests.fault_injection import run_watched

PROGRAM = """
import os, shutil, sys
from pathlib import Path
sys.path.insert(0, "benchmarks")
from crash_cases import OPTIONS, in_fork
from generated_capture import write_tiny
from kill_sweep import STEPS, contents
from system_calls import can_watch, run_watched
from usdbrdf.cli import main
import usdbrdf.page.report, usdbrdf.delivery.package, usdbrdf.validation.validate
if not can_watch():
    sys.exit(77)
work = Path(sys.argv[1])
capture = work / "scan"
assert in_fork(lambda: write_tiny(capture) or 0) == 0

def run(step, room, options=0, *more):
    place = [str(room)] if step != "ingest" else [str(capture), "-o", str(room)]
    return main([step, "-q", *place, *OPTIONS[step][options], *more])

first, alone, disturbed = (work / name / "room" for name in ("a", "b", "c"))
for step in STEPS:
    assert in_fork(lambda: run(step, first)) == 0
for other in (alone, disturbed):
    shutil.copytree(first, other)
assert in_fork(lambda: run("shade", alone, 1)) == 0

others = {
    "convert": ["convert", str(capture), "-o", str(disturbed)],
    "fit": ["fit", str(disturbed), *OPTIONS["fit"][0]],
    "package": ["package", str(disturbed), "-o", str(work / "room.usdz")],
    "publish": ["publish", str(disturbed), str(work / "versions")],
    "report": ["report", str(disturbed), "-o", str(work / "room.html")],
    "validate": ["validate", str(disturbed)],
}
edits = disturbed / "edits.usda"
said = edits.read_bytes() + b"# the artist's\\n"
told, put = {}, 0

def answer(call):
    # In the middle of what a run must not be seen in: half of its files are in place.
    global put
    put += call.kind == "rename" and call.target.parent == disturbed / "textures"
    if put == 4 and not told:
        told["half"] = True
        saved = edits.with_suffix(".saved")
        saved.write_bytes(said)
        saved.replace(edits)
        for name, command in others.items():
            told[name] = in_fork(lambda: main(command))
    return None

told["shade"] = run_watched(lambda: run("shade", disturbed, 1), ("rename",), disturbed, answer)
expected, found = contents(alone), contents(disturbed)
told["edits"] = edits.read_bytes() == said
told["differ"] = sorted(k for k in {*expected, *found} if expected.get(k) != found.get(k))
told["made"] = sorted(os.listdir(work))
print(told)
"""


@pytest.mark.fault("R6")
def test_nobody_sees_half_a_run_and_an_artist_may_save(tmp_path):
    """In the middle of publishing, as the kernel sees it; the run ends in its own bytes."""
    done = run_watched("-c", PROGRAM, str(tmp_path), timeout_s=300)
    told = ast.literal_eval(done.stdout.splitlines()[-1])
    refused = dict.fromkeys(("convert", "fit", "package", "publish", "report", "validate"), 5)
    assert {name: told[name] for name in refused} == refused, done.stderr
    assert (told["shade"], told["edits"], told["differ"]) == (0, True, ["edits.usda"])
    assert told["made"] == ["a", "b", "c", "scan"]
