"""A short run over every reader, and what the fuzzer itself must do to be believed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.fuzzing.__main__ import findings, fuzz, table
from tests.fuzzing.mutation import mutated
from tests.fuzzing.process import Inputs, Lines, problem_of_error, problem_of_value
from tests.fuzzing.readers import READERS
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError

# What starts fast comes every time; the others, whose sound files take seconds to read first, at
# night with all the rest (.ci/nightly).
_QUICK = (
    "exr", "hdr", "png", "jpeg", "tiff", "published", "ply", "obj", "glb", "labelled-ply",
    "usd", "usd-materials", "review", "stamp", "manifest", "arrays", "truth", "matrix",
    "transforms", "objects", "eyeful-tower", "llff", "nice-slam", "metashape", "realityscan",
)  # fmt: skip
_INPUTS = 80


def test_no_reader_stumbles(tmp_path: Path) -> None:
    """Always the same inputs, as many of each on a slow machine as on a fast one."""
    fuzz(_QUICK, tmp_path, 1, 1 + _INPUTS, 600.0)
    assert findings(tmp_path) == [], table(tmp_path)
    for name in _QUICK:
        figures = [json.loads(f.read_text()) for f in (tmp_path / name).glob("figures-*.json")]
        assert sum(each["inputs"] for each in figures) >= _INPUTS, name


def test_the_same_number_gives_the_same_bytes(tmp_path: Path) -> None:
    inputs = Inputs(READERS["ply"], tmp_path / "seeds")

    def content(chain: tuple[int, ...]) -> dict[Path, bytes]:
        inputs.place(chain)
        return {path: path.read_bytes() for path in inputs.sound}

    first = content((17, 203))
    assert content((5,)) != first
    assert content((17, 203)) == first
    assert content((17,)) != first


@pytest.mark.parametrize("name", ["a.json", "a.xml", "a.csv", "a.bin", "a.png"])
def test_most_mutations_change_something(name: str) -> None:
    sound = {
        "a.json": b'{"w": 32, "frames": [{"k": [1.0, 2.0]}, {"k": [3.0, 4.0]}]}',
        "a.xml": b'<a><b c="1">2 3</b><b c="2">4 5</b></a>',
        "a.csv": b"name,x,y\na,1,2\nb,3,4\n",
        "a.bin": bytes(range(200)),
        "a.png": b"\x89PNG\r\n\x1a\n" + bytes(40),
    }[name]
    made = {mutated(name, sound, np.random.default_rng(i)) for i in range(100)}
    assert len(made - {sound}) > 60


def test_what_counts_as_a_fault() -> None:
    assert problem_of_error(InputRefused("a.ply: is empty. Export it. [mesh.empty]")) == ""
    assert "sentence" in problem_of_error(InputRefused("a.ply:\nis empty. [mesh.empty]"))
    assert "traceback" in problem_of_error(KeyError("frames"))
    assert "traceback" in problem_of_error(UsdBrdfError("it failed. [child.failed]"))
    assert "exit 4" in problem_of_error(EnvironmentFailure("a: disk. [environment.io]"))
    assert "memory" in problem_of_error(EnvironmentFailure("a: b. [environment.memory]"))
    assert problem_of_value({"a": (np.ones(3), 2.0)}, frozenset()) == ""
    assert problem_of_value({"a": (np.array([np.nan]),)}, frozenset()) == "NaN in a"
    assert problem_of_value({"a": (np.array([np.nan]),)}, frozenset(["a"])) == ""


def test_a_finding_can_be_made_again(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.fuzzing", "replay", "arrays", "3.4"]
    command += ["--keep", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "reads " in done.stdout
    assert "nothing wrong" in done.stdout, done.stdout + done.stderr


def test_every_line_that_counts_is_there() -> None:
    for reader in READERS.values():
        assert Lines(reader.lines).all, reader.name
