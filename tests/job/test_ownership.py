"""Foreign folders are refused untouched; edits of our files are noticed."""

from __future__ import annotations

import json
import os

import pytest

from usdbrdf.errors import EnvironmentFailure, OwnershipConflict
from usdbrdf.job.ownership import (
    edited_files,
    make_parents,
    prepare_asset_folder,
    removed_if_unused,
)


def test_new_and_empty_folders_become_ours(tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("new", "empty", "new"):
        state = prepare_asset_folder(tmp_path / name)
        assert json.loads((state / "job.json").read_text())["tool"] == "usdbrdf"


def test_foreign_folder_is_refused_untouched(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(OwnershipConflict, match=r"not made by usdbrdf.+\[ownership.foreign\]"):
        prepare_asset_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


def test_folder_of_a_run_killed_before_its_record_is_ours(tmp_path):
    (tmp_path / ".usdbrdf/stamps").mkdir(parents=True)
    (tmp_path / ".usdbrdf/.tmp-1-ab.json").write_text("{")
    prepare_asset_folder(tmp_path)
    assert (tmp_path / ".usdbrdf/job.json").is_file()


def test_damaged_record_is_written_again_and_a_newer_one_refused(tmp_path):
    state = prepare_asset_folder(tmp_path / "room")
    (state / "job.json").write_text("{")
    prepare_asset_folder(tmp_path / "room")
    assert json.loads((state / "job.json").read_text())["schema"] == 1
    (state / "job.json").write_text('{"schema": 2}')
    with pytest.raises(OwnershipConflict, match=r"ownership\.newer"):
        prepare_asset_folder(tmp_path / "room")


def test_output_that_is_a_file_or_has_no_parent(tmp_path):
    (tmp_path / "file").write_text("x")
    for output in (tmp_path / "file", tmp_path / "file/room", tmp_path / "none/room"):
        with pytest.raises(EnvironmentFailure):
            prepare_asset_folder(output)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_unwritable_parent(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(EnvironmentFailure, match=r"not writable.+\[environment.output\]"):
            prepare_asset_folder(tmp_path / "room")
    finally:
        tmp_path.chmod(0o700)


def test_unwritable_parent_as_the_system_reports_it(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(EnvironmentFailure, match=r"not writable.+\[environment.output\]"):
        prepare_asset_folder(tmp_path / "room")
    assert not (tmp_path / "room").exists()


def test_edited_files_are_listed(tmp_path, toy):
    asset = tmp_path / "room"
    toy.run_toy(asset)
    assert edited_files(asset) == []
    (asset / "edits.usda").write_text("#usda 1.0\n# the artist's\n")
    (asset / "layers/other.usda").write_text("not ours")
    (asset / "textures/box0.lit.exr").unlink()
    assert edited_files(asset) == []
    (asset / "layers/toy.usda").write_text("edited")
    (asset / "textures/box1.lit.exr").write_bytes(b"painted")
    assert edited_files(asset) == ["layers/toy.usda", "textures/box1.lit.exr"]


def fail_in(asset):
    new = make_parents(asset)
    prepare_asset_folder(asset)
    with pytest.raises(KeyError), removed_if_unused(new):
        raise KeyError


def test_what_was_not_there_before_a_failure_is_not_there_after_it(tmp_path):
    (tmp_path / "empty").mkdir()
    fail_in(tmp_path / "empty")
    fail_in(tmp_path / "new/room")
    assert [path.name for path in tmp_path.rglob("*")] == ["empty"]
    prepare_asset_folder(tmp_path / "empty")
    fail_in(tmp_path / "empty")
    assert (tmp_path / "empty/.usdbrdf/job.json").is_file()
