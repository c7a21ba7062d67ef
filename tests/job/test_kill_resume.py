"""SIGKILL at every fault point of a task, then the same command: the same bytes as undisturbed."""

from __future__ import annotations

import ast
import shutil
import signal

import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.job import task as task_module
from usdbrdf.job.ownership import edited_files, reading

FAULTS = (
    [f"toy:checkpoint:{k}" for k in (1, 3, 4, 9)]
    + [f"toy:before_write:{k}" for k in (1, 2, 6)]
    + ["image:before_write:2", "toy:before_publish"]
    + [f"toy:mid_publish:{k}" for k in (1, 3, 5)]
    + ["toy:after_publish", "toy:before_stamp", "toy:after_stamp"]
)
# every rename of the run: job.json, 9 checkpoints, 3 images, journal, 5 outputs, once, stamp
RENAMES = [f"publish:{side}_replace:{k}" for side in ("before", "after") for k in (1, 2, 14, 21)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, toy, hashes):
    asset = tmp_path_factory.mktemp("undisturbed") / "room"
    assert toy.run_toy(asset).reran
    return hashes(asset)


@pytest.mark.fault("R2")
@pytest.mark.parametrize("fault", FAULTS + RENAMES)
def test_killed_run_resumes_to_the_same_bytes(
    tmp_path, toy, toy_process, hashes, undisturbed, fault
):
    asset = tmp_path / "room"
    killed = toy_process(asset, fault=f"kill@{fault}")
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert edited_files(asset) == []
    toy.run_toy(asset)
    assert hashes(asset) == undisturbed
    assert not toy.run_toy(asset).reran


@pytest.mark.parametrize("fault", ["mid_publish:2", "after_publish", "before_stamp"])
def test_killed_regeneration_is_not_taken_for_an_edit(
    tmp_path, toy, toy_process, hashes, undisturbed, fault
):
    asset = tmp_path / "room"
    toy.run_toy(asset, 7)
    (asset / "edits.usda").write_text("#usda 1.0\n# mine\n")
    assert toy_process(asset, "1", fault=f"kill@toy:{fault}").returncode == -9
    assert edited_files(asset) == []
    assert toy.run_toy(asset).reason == "publish interrupted"
    assert (asset / "edits.usda").read_text() == "#usda 1.0\n# mine\n"
    (asset / "edits.usda").write_text("#usda 1.0\n")
    assert hashes(asset) == undisturbed


def test_other_parameters_after_a_killed_publish(tmp_path, toy, toy_process, hashes, undisturbed):
    asset = tmp_path / "room"
    toy.run_toy(asset, 7)
    assert toy_process(asset, "8", fault="kill@toy:mid_publish:2").returncode == -9
    assert toy_process(asset, "1", "--fewer", fault="kill@toy:mid_publish").returncode == -9
    assert edited_files(asset) == []
    toy.run_toy(asset, 1, textures=2)
    assert not (asset / "textures/box2.lit.exr").exists()  # from seed 7 or 8, no longer made
    toy.run_toy(asset)
    assert hashes(asset) == undisturbed


@pytest.mark.fault("R2")
@pytest.mark.parametrize("moves", [0, 3])
def test_what_ran_before_a_stopped_publish_and_what_was_stopped_both_end_it(
    tmp_path, toy, hashes, undisturbed, monkeypatch, moves
):
    """Of the outputs that it has moved one is new and the others have the bytes of before."""
    asset, left = tmp_path / "room", iter(range(moves))
    toy.run_toy(asset, textures=2)
    before, move = hashes(asset), task_module.move

    def some(*places):
        if next(left, None) is None:
            raise KeyboardInterrupt
        move(*places)

    monkeypatch.setattr(task_module, "move", some)
    with pytest.raises(KeyboardInterrupt):
        toy.run_toy(asset)
    monkeypatch.undo()
    shutil.copytree(asset, tmp_path / "again")
    with pytest.raises(InputRefused, match=r"\[asset\.unfinished\]"), reading(asset):
        pass
    assert not toy.run_toy(asset, textures=2).reran
    assert hashes(asset) == before
    assert toy.run_toy(tmp_path / "again").reason == "publish interrupted"
    assert hashes(tmp_path / "again") == undisturbed


@pytest.mark.fault("R2")
def test_what_two_stopped_publishes_put_there_goes(tmp_path, toy, hashes, monkeypatch):
    """The first moved one output beside the finished ones, and the second none, nor what lies in
    the place of another, which is not this task's."""
    asset = tmp_path / "room"
    toy.run_toy(asset, textures=1)
    (asset / "textures/box2.lit.exr").write_text("of another task")
    before = hashes(asset)

    def stopped(*_):
        raise KeyboardInterrupt

    for stop, seed, textures in (("_retire", 1, 2), ("move", 2, 3)):
        monkeypatch.setattr(task_module, stop, stopped)
        with pytest.raises(KeyboardInterrupt):
            toy.run_toy(asset, seed, textures=textures)
        monkeypatch.undo()
    assert not toy.run_toy(asset, textures=1).reran
    assert hashes(asset) == before


def test_file_edited_after_a_killed_publish_is_regenerated(tmp_path, toy, toy_process, hashes):
    asset = tmp_path / "room"
    assert toy_process(asset, fault="kill@toy:mid_publish:1").returncode == -9
    (asset / "textures/box0.lit.exr").write_bytes(b"mine")
    assert edited_files(asset) == ["textures/box0.lit.exr"]
    assert toy.run_toy(asset).reason == "not done before"
    assert edited_files(asset) == []


def test_finished_pieces_are_not_computed_again(tmp_path, toy, toy_process):
    asset = tmp_path / "room"
    toy_process(asset, fault="kill@toy:checkpoint:5")  # 3 tiles, frames 0 and 1
    toy.run_toy(asset)
    computed = ast.literal_eval(asset.with_suffix(".computed").read_text())
    assert computed == [102, 103, 104, 105]


def test_damaged_checkpoint_is_computed_again(tmp_path, toy, toy_process, hashes, undisturbed):
    asset = tmp_path / "room"
    toy_process(asset, fault="kill@toy:checkpoint:6")
    stored = sorted((asset / ".usdbrdf/work").glob("toy-*/*/checkpoints/*.npz"))
    assert [path.name[:5] for path in stored] == ["sum@0", "sum@0"] + 3 * ["tile%"]
    for path in stored[1:3]:  # the newer state and the first tile
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    toy.run_toy(asset)
    computed = ast.literal_eval(asset.with_suffix(".computed").read_text())
    assert computed == [0, 102, 103, 104, 105]
    assert hashes(asset) == undisturbed


def test_checkpoint_that_is_whole_but_not_what_was_saved_is_computed_again(
    tmp_path, toy, toy_process, hashes, undisturbed
):
    asset = tmp_path / "room"
    toy_process(asset, fault="kill@toy:checkpoint:3")
    first, _, last = sorted((asset / ".usdbrdf/work").glob("toy-*/*/checkpoints/*.npz"))
    first.write_bytes(last.read_bytes())  # arrays that can be read, of another tile
    toy.run_toy(asset)
    computed = ast.literal_eval(asset.with_suffix(".computed").read_text())
    assert computed == [0, 100, 101, 102, 103, 104, 105]
    assert hashes(asset) == undisturbed


def test_work_for_other_parameters_is_swept_even_where_nothing_runs(tmp_path, toy, toy_process):
    asset = tmp_path / "room"
    toy.run_toy(asset)
    toy_process(asset, "7", fault="kill@toy:checkpoint:3")
    assert list((asset / ".usdbrdf/work").iterdir())
    assert not toy.run_toy(asset).reran
    assert not list((asset / ".usdbrdf/work").iterdir())


@pytest.mark.fault("R1")
@pytest.mark.parametrize(
    "fault", ["before_write:4", "checkpoint:2", "before_publish", "mid_publish:2", "before_stamp"]
)
def test_full_disk_keeps_the_previous_asset_and_resumes(
    tmp_path, toy, toy_process, hashes, undisturbed, fault
):
    asset = tmp_path / "room"
    toy.run_toy(asset, 7)
    before = hashes(asset)
    failed = toy_process(asset, "1", fault=f"enospc@toy:{fault}")
    assert failed.returncode == 1
    assert "EnvironmentFailure: toy: No space left" in failed.stderr
    if "publish" not in fault and "stamp" not in fault:
        now = hashes(asset)
        assert {path: now[path] for path in before} == before
    toy.run_toy(asset)
    assert hashes(asset) == undisturbed
