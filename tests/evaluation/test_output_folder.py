"""Results appear whole, beside nothing that is somebody else's."""

from __future__ import annotations

import pytest

from usdbrdf.asset.layout import Asset
from usdbrdf.errors import OwnershipConflict, UsageError
from usdbrdf.evaluation.report import FILES, files_of, output_folder
from usdbrdf.files.documents import read_json, write_json

DOCUMENT = "found.json"


def write(folder, *names):
    with output_folder(folder, DOCUMENT, ()) as work:
        for name in names:
            (work / name).parent.mkdir(exist_ok=True)
            (work / name).write_text(name)
        write_json(work / DOCUMENT, {FILES: [*files_of(work), DOCUMENT]})


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
