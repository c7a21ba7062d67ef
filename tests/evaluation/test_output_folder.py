"""Results appear whole, beside nothing that is somebody else's."""

from __future__ import annotations

import resource

import pytest

from tests.fault_injection import run_fresh
from usdbrdf.asset.layout import Asset
from usdbrdf.errors import EnvironmentFailure, OwnershipConflict, UsageError
from usdbrdf.evaluation.report import (
    FILES,
    files_of,
    output_folder,
    write_document,
    write_plot,
    write_prose,
    write_table,
)
from usdbrdf.files.documents import read_json, write_json

DOCUMENT = "found.json"
METRICS = ("l2", "l2_shown", "flip")
ROWS = [{f"{metric}_{model}": 1 / 3 for metric in METRICS for model in ("baseline", "full")}] * 40


def write(folder, *names):
    with output_folder(folder, DOCUMENT, ()) as work:
        for name in names:
            (work / name).parent.mkdir(exist_ok=True)
            (work / name).write_text(name)
        write_json(work / DOCUMENT, {FILES: [*files_of(work), DOCUMENT], "whole": True})


def test_a_second_run_replaces_what_the_first_made_and_nothing_else(tmp_path):
    folder = tmp_path / "deep" / "out"
    write(folder, "pictures/a.png", "pictures/b.png")
    (folder / "notes.txt").write_text("mine")
    write(folder, "pictures/b.png", "c.csv")
    assert files_of(folder) == ["c.csv", DOCUMENT, "notes.txt", "pictures/b.png"]
    assert read_json(folder / DOCUMENT)[FILES] == ["c.csv", "pictures/b.png", DOCUMENT]
    assert [p.name for p in folder.parent.iterdir()] == ["out"]


def test_a_failure_leaves_the_folder_as_it_was(tmp_path):
    write(tmp_path / "out", "a")

    def fail():
        with output_folder(tmp_path / "out", DOCUMENT, ()) as work:
            (work / "b").write_text("")
            raise ValueError

    with pytest.raises(ValueError):  # noqa: PT011 (our own)
        fail()
    assert files_of(tmp_path) == ["out/a", f"out/{DOCUMENT}"]


@pytest.mark.parametrize("content", ["", "[]", '{"files": 3}'])
def test_a_folder_of_somebody_else_is_refused(tmp_path, content):
    (tmp_path / DOCUMENT).write_text(content)
    with pytest.raises(OwnershipConflict, match=r"\[evaluate.output\]"):
        write(tmp_path, "a")
    assert files_of(tmp_path) == [DOCUMENT]


def test_an_asset_is_no_place_for_results(tmp_path):
    with (
        pytest.raises(UsageError, match=r"\[evaluate.output\]"),
        output_folder(tmp_path / "asset" / "out", DOCUMENT, (Asset(tmp_path / "asset", "asset"),)),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_stale_list_cannot_delete_outside(tmp_path):
    (tmp_path / "precious").write_text("")
    write(tmp_path / "out", "a")
    write_json(tmp_path / "out" / DOCUMENT, {FILES: ["../precious", "a"]})
    write(tmp_path / "out", "b")
    assert files_of(tmp_path) == ["out/b", f"out/{DOCUMENT}", "precious"]


KILLED = """
import sys
from pathlib import Path
from tests.evaluation.test_output_folder import DOCUMENT, FILES, files_of, read_json, write
from tests.fault_injection import killed_at_each_change
top = Path(sys.argv[1])
for number in killed_at_each_change(lambda: write(top / "new" / "out", "pictures/a", "b")):
    write(top / "new" / "out", "b", "c")
    assert files_of(top) == [f"new/out/{name}" for name in ("b", "c", DOCUMENT)], files_of(top)
folder, mixed = top / "new" / "out", 0
write(folder, "b", "c")
for number in killed_at_each_change(lambda: write(folder, "a", "pictures/b")):
    there, told = files_of(folder), read_json(folder / DOCUMENT)
    if "whole" not in told:
        mixed += 1
    elif told[FILES] == ["b", "c", DOCUMENT]:
        assert [name for name in there if name[0] != "."] == ["b", "c", DOCUMENT], there
    else:
        assert {"a", "pictures/b"} <= {*there}
    write(folder, "b", "c")
    assert files_of(top) == [f"new/out/{name}" for name in ("b", "c", DOCUMENT)], files_of(top)
print(number, mixed)
"""


@pytest.mark.fault("R2")
def test_killed_at_any_change_the_next_run_knows_the_folder_and_nobody_reads_a_mixture(tmp_path):
    number, mixed = map(int, run_fresh(KILLED, tmp_path).split())
    assert number > mixed > 2


@pytest.mark.fault("R1")
@pytest.mark.parametrize(
    ("name", "write_result"),
    [
        ("a.csv", lambda work: write_table(work / "a.csv", ROWS)),
        ("a.md", lambda work: write_prose(work / "a.md", "x" * 10_000)),
        ("a.png", lambda work: write_plot(work / "a.png", ROWS)),
        ("a.svg", lambda work: write_plot(work / "a.svg", ROWS)),
        (DOCUMENT, lambda work: write_document(work, DOCUMENT, {"rows": ROWS})),
    ],
)
def test_a_disk_that_takes_no_results_is_said_and_leaves_what_was_there(
    tmp_path, name, write_result
):
    write(tmp_path / "out", "a")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fail():
        with output_folder(tmp_path / "out", DOCUMENT, ()) as work:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
            try:
                write_result(work)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    with pytest.raises(EnvironmentFailure, match=rf"{name}: File too large.*\[environment.io\]"):
        fail()
    assert files_of(tmp_path) == ["out/a", f"out/{DOCUMENT}"]
