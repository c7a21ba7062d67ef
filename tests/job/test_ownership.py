"""Foreign folders are refused untouched; edits of our files are noticed."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from usdbrdf.errors import EnvironmentFailure, FolderBusy, InputRefused, OwnershipConflict
from usdbrdf.files.atomic import TEMPORARY_PREFIX
from usdbrdf.job.ownership import edited_files, owned_folder, reading, writing_alone


def own(asset):
    with owned_folder(asset) as state:
        return state


def names_in(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_new_and_empty_folders_become_ours(tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("new", "empty", "new", "above/it"):
        state = own(tmp_path / name)
        assert json.loads((state / "job.json").read_text())["tool"] == "usdbrdf"


def test_foreign_folder_is_refused_untouched(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(OwnershipConflict, match=r"not made by usdbrdf.+\[ownership.foreign\]"):
        own(tmp_path)
    assert names_in(tmp_path) == ["holiday.jpg"]


def test_folder_of_a_run_killed_before_its_record_is_ours_and_is_swept(tmp_path):
    (tmp_path / ".usdbrdf/stamps").mkdir(parents=True)
    (tmp_path / f".usdbrdf/{TEMPORARY_PREFIX}1-ab.json").write_text("{")
    (tmp_path / f".usdbrdf/stamps/{TEMPORARY_PREFIX}1-cd.json").write_text("{")
    own(tmp_path)
    assert (tmp_path / ".usdbrdf/job.json").is_file()
    assert not [name for name in names_in(tmp_path) if TEMPORARY_PREFIX in name]


@pytest.mark.fault("C13")
def test_damaged_record_is_written_again_and_a_newer_one_refused(tmp_path):
    state = own(tmp_path / "room")
    (state / "job.json").write_text("{")
    own(tmp_path / "room")
    assert json.loads((state / "job.json").read_text())["schema"] == 1
    (state / "job.json").write_text('{"schema": 2}')
    with pytest.raises(InputRefused, match=r"asset\.newer"):
        own(tmp_path / "room")


@pytest.mark.fault("R5")
def test_output_that_is_a_file_or_below_one(tmp_path):
    (tmp_path / "file").write_text("x")
    for output in (tmp_path / "file", tmp_path / "file/room"):
        with pytest.raises(EnvironmentFailure, match=r"is a file.+\[environment.output\]"):
            own(output)
    assert names_in(tmp_path) == ["file"]


@pytest.mark.fault("R5")
def test_output_over_a_link_that_leads_nowhere(tmp_path):
    (tmp_path / "link").symlink_to("gone")
    for output in (tmp_path / "link", tmp_path / "link/room"):
        with pytest.raises(EnvironmentFailure, match=r"a link to gone, .+\[environment.output\]"):
            own(output)
    assert names_in(tmp_path) == ["link"]


@pytest.mark.fault("R5")
@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_unwritable_parent(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(EnvironmentFailure, match=r"not writable.+\[environment.output\]"):
            own(tmp_path / "room")
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.fault("R5")
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_an_unwritable_parent_of_another_user():
    """What the test above cannot see as root. All is imported before the change: the interpreter
    may be out of reach after it."""
    code = """
import os, sys
from pathlib import Path
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.ownership import owned_folder
os.setgid(65534); os.setuid(65534)
for name in ("room", "above/room"):
    try:
        with owned_folder(Path(sys.argv[1]) / name):
            pass
    except EnvironmentFailure as error:
        print(error)
"""
    folder = Path(tempfile.mkdtemp(prefix="usdbrdf-test-"))
    try:
        folder.chmod(0o755)
        search = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
        done = subprocess.run(
            [sys.executable, "-c", code, str(folder)],
            env={**os.environ, "PYTHONPATH": search},
            capture_output=True,
            text=True,
            check=True,
        )
        said = done.stdout.splitlines()
        assert len(said) == 2
        assert all(re.search(r"not writable.+\[environment\.output\]$", line) for line in said)
        assert names_in(folder) == []
    finally:
        shutil.rmtree(folder)


def test_an_unwritable_folder_is_named_once(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(EnvironmentFailure, match=rf"^{tmp_path}: not writable\. Change"):
        own(tmp_path)


def test_unwritable_parent_as_the_system_reports_it(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(EnvironmentFailure, match=r"not writable.+\[environment.output\]"):
        own(tmp_path / "above/room")
    assert names_in(tmp_path) == []


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


def fail_in(asset, meanwhile=lambda: None):
    def work():
        with owned_folder(asset):
            meanwhile()
            raise KeyError

    with pytest.raises(KeyError):
        work()


def test_what_was_not_there_before_a_failure_is_not_there_after_it(tmp_path):
    (tmp_path / "empty").mkdir()
    fail_in(tmp_path / "empty")
    fail_in(tmp_path / "new/room")
    assert names_in(tmp_path) == ["empty"]
    own(tmp_path / "empty")
    fail_in(tmp_path / "empty")
    assert (tmp_path / "empty/.usdbrdf/job.json").is_file()


@pytest.mark.fault("R6")
def test_a_run_that_finds_no_locks_takes_away_what_it_made_alone(tmp_path, monkeypatch):
    state = own(tmp_path / "old")
    (tmp_path / "empty").mkdir()

    def no_locks(*_arguments):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    before = names_in(tmp_path)
    monkeypatch.setattr(fcntl, "lockf", no_locks)
    for name in ("old", "empty", "new/room"):
        with pytest.raises(FolderBusy, match=r"\[lock\.none\]$"):
            own(tmp_path / name)
        assert names_in(tmp_path) == before, name
    assert json.loads((state / "job.json").read_text())["tool"] == "usdbrdf"
    with owned_folder(tmp_path / "new/room", without_lock=True) as state:
        assert state == tmp_path / "new/room/.usdbrdf"


def test_folders_that_hold_something_else_by_then_stay(tmp_path):
    fail_in(tmp_path / "new/room", (tmp_path / "new/other").mkdir)
    assert names_in(tmp_path) == ["new", "new/other"]


@pytest.mark.parametrize(
    ("failure", "stays"), [(KeyboardInterrupt, True), (InputRefused, False), (KeyError, True)]
)
def test_outputs_that_a_first_step_finished_stay_unless_the_input_is_refused(
    tmp_path, failure, stays
):
    asset = tmp_path / "room"

    def work(content):
        with owned_folder(asset):
            kept = asset / ".usdbrdf/work/ingest-1/2/kept"
            kept.mkdir(parents=True, exist_ok=True)
            found = (kept / "frame.exr").is_file()
            (kept / "frame.exr").write_text(content)
            raise failure(found)

    for again in (False, True):
        with pytest.raises(failure) as raised:
            work("finished")
        assert raised.value.args[0] == (again and stays)
        assert asset.is_dir() == stays


# Two runs that begin in the same new folder


def in_new_folder_while_another_waits(asset, second):
    """Fail in a new folder while ``second`` waits for its lock."""
    waiting = threading.Thread(target=second)

    def begin():
        waiting.start()
        time.sleep(0.5)
        assert waiting.is_alive()

    fail_in(asset, begin)
    waiting.join(timeout=200)


def test_a_failed_run_takes_nothing_from_one_that_waits(tmp_path, toy):
    asset = tmp_path / "new/room"

    def second():
        with owned_folder(asset, wait_s=200):
            toy.run_toy(asset)

    in_new_folder_while_another_waits(asset, second)
    assert (asset / "layers/toy.usda").is_file()
    assert (asset / ".usdbrdf/job.json").is_file()
    assert (asset / ".usdbrdf/lock").is_file()
    assert not toy.run_toy(asset).reran  # it is still ours


def test_the_one_that_waited_holds_the_lock_that_others_see(tmp_path):
    asset, seen = tmp_path / "room", []

    def second():
        with owned_folder(asset, wait_s=200) as state:
            said = subprocess.run(
                [sys.executable, "-c", TAKE, str(state)],
                capture_output=True,
                text=True,
                check=False,
            ).stderr
            seen.append(said)

    in_new_folder_while_another_waits(asset, second)
    assert f"in use by pid {os.getpid()}" in seen[0]


TAKE = """
import sys
from pathlib import Path
from usdbrdf.job.ownership import folder_lock
with folder_lock(Path(sys.argv[1])):
    pass
"""


def test_a_run_that_found_the_folder_busy_removes_nothing(tmp_path, toy):
    asset = tmp_path / "room"
    with owned_folder(asset):
        thread = threading.Thread(target=lambda: refused(asset))
        thread.start()
        thread.join()
        toy.run_toy(asset)
    assert not toy.run_toy(asset).reran


def refused(asset):
    with pytest.raises(FolderBusy), owned_folder(asset):
        pass


# Links


@pytest.mark.parametrize("name", [".usdbrdf", ".usdbrdf/stamps", ".usdbrdf/work", ".usdbrdf/lock"])
def test_state_that_is_linked_out_of_the_asset_is_refused(tmp_path, toy, name):
    asset, elsewhere = tmp_path / "room", tmp_path / "elsewhere"
    toy.run_toy(asset)
    (asset / name).rename(elsewhere)
    (asset / name).symlink_to(elsewhere)
    before = elsewhere.stat().st_size, names_in(elsewhere)
    with pytest.raises(OwnershipConflict, match=r"leads out of .+\[ownership.link\]$"):
        toy.run_toy(asset, 2)
    assert (elsewhere.stat().st_size, names_in(elsewhere)) == before


@pytest.mark.parametrize("name", ["textures", "layers"])
def test_nothing_is_published_through_a_link_out_of_the_asset(tmp_path, toy, name):
    asset, elsewhere = tmp_path / "room", tmp_path / "elsewhere"
    toy.run_toy(asset)
    (asset / name).rename(elsewhere)
    (asset / name).symlink_to(elsewhere)
    before = {path: path.read_bytes() for path in elsewhere.iterdir()}
    with pytest.raises(OwnershipConflict, match=r"leads out of .+\[ownership.link\]$"):
        toy.run_toy(asset, 2)
    assert {path: path.read_bytes() for path in elsewhere.iterdir()} == before
    (asset / name).unlink()
    elsewhere.rename(asset / name)
    assert toy.run_toy(asset, 2).reran


def test_work_that_is_linked_out_is_not_emptied(tmp_path, toy, toy_process):
    asset, elsewhere = tmp_path / "room", tmp_path / "elsewhere"
    toy_process(asset, fault="kill@toy:before_publish")
    (work,) = (asset / ".usdbrdf/work").iterdir()
    work.rename(elsewhere)
    work.symlink_to(elsewhere)
    before = names_in(elsewhere)
    with pytest.raises(OwnershipConflict, match=r"\[ownership.link\]$"):
        toy.run_toy(asset)
    assert names_in(elsewhere) == before


def test_links_within_the_asset_and_of_the_asset_are_followed(tmp_path, toy):
    (tmp_path / "disk/room/maps").mkdir(parents=True)
    own_folder = tmp_path / "room"
    own_folder.symlink_to(tmp_path / "disk/room")
    (own_folder / "maps").rmdir()
    toy.run_toy(own_folder)
    (own_folder / "textures").rename(own_folder / "maps")
    (own_folder / "textures").symlink_to("maps")
    assert toy.run_toy(own_folder, 2).reran
    assert not toy.run_toy(own_folder, 2).reran


def test_a_folder_that_is_gone_is_the_machine_s_and_no_defect(tmp_path):
    with pytest.raises(EnvironmentFailure, match="gone"), writing_alone(tmp_path / "gone"):
        pass


def test_an_asset_that_lost_the_record_of_its_maker_is_known_by_its_steps(tmp_path, toy):
    toy.run_toy(tmp_path / "room")
    before = names_in(tmp_path / "room")
    (tmp_path / "room/.usdbrdf/job.json").unlink()
    assert toy.run_toy(tmp_path / "room").reran is False
    assert names_in(tmp_path / "room") == before
    # Anybody may call a folder so.
    shutil.rmtree(tmp_path / "room/.usdbrdf")
    (tmp_path / "room/.usdbrdf/stamps").mkdir(parents=True)
    (tmp_path / "room/.usdbrdf/stamps/1-toy.json").write_text("{}")
    with pytest.raises(OwnershipConflict, match=r"hidden folder \.usdbrdf.+\[ownership.foreign\]"):
        own(tmp_path / "room")


@pytest.mark.parametrize("name", ["layers/material.usda", "layers/toy.usda", "textures/mine.exr"])
def test_without_the_record_of_its_maker_a_file_of_anothers_is_not_written_over(
    tmp_path, toy, name
):
    """One stamp that could be read was enough."""
    toy.run_toy(tmp_path / "room")
    (tmp_path / "room/.usdbrdf/job.json").unlink()
    (tmp_path / "room/layers/.DS_Store").touch()
    (tmp_path / "room" / name).write_text("#usda 1.0\n# theirs\n")
    before = names_in(tmp_path / "room")
    with pytest.raises(OwnershipConflict, match=rf"{name} is not as .+\[ownership.foreign\]"):
        own(tmp_path / "room")
    assert names_in(tmp_path / "room") == before
    (tmp_path / "room" / name).unlink()
    own(tmp_path / "room")


def test_a_journal_alone_does_not_make_a_folder_ours(tmp_path, toy):
    toy.run_toy(tmp_path / "room")
    state = tmp_path / "room/.usdbrdf"
    (state / "job.json").unlink()
    next(state.glob("stamps/*.json")).rename(state / "publishing-toy.json")
    with pytest.raises(OwnershipConflict, match=r"hidden folder \.usdbrdf.+\[ownership.foreign\]"):
        own(tmp_path / "room")


def test_a_link_to_nothing_in_the_place_of_a_folder_of_ours_is_named(tmp_path, toy):
    """A folder in it may be called anything, though."""
    toy.run_toy(tmp_path / "room")
    cache = tmp_path / "room/.usdbrdf/cache"
    (cache / "any").mkdir()
    own(tmp_path / "room")
    shutil.rmtree(cache)
    cache.symlink_to("gone")
    with pytest.raises(OwnershipConflict, match=rf"{cache}: this is no folder.+ownership.place"):
        own(tmp_path / "room")


@pytest.mark.parametrize("name", ["lock", "job.json", "stamps", "work", "cache"])
def test_what_lies_in_the_place_of_our_state_is_named(tmp_path, toy, name):
    toy.run_toy(tmp_path / "room")
    place = tmp_path / "room/.usdbrdf" / name
    if place.is_dir():
        shutil.rmtree(place)
        place.touch()
        found = "no folder, and a folder"
    else:
        place.unlink()
        place.mkdir()
        found = "a folder, and a file"
    if name == "stamps":
        (tmp_path / "room/holiday.jpg").touch()
    with pytest.raises(OwnershipConflict, match=rf"{place}: this is {found} .+ownership.place"):
        own(tmp_path / "room")


def test_a_pipe_or_a_link_for_a_lock_is_named_and_nobody_waits_for_it(tmp_path, toy):
    toy.run_toy(tmp_path / "room")
    lock = tmp_path / "room/.usdbrdf/lock"
    lock.unlink()
    os.mkfifo(lock)
    with pytest.raises(OwnershipConflict, match=rf"^{lock}: this is .+ a pipe .+ownership.place"):
        own(tmp_path / "room")
    with reading(tmp_path / "room"):
        pass
    lock.unlink()
    lock.symlink_to("job.json")
    with pytest.raises(OwnershipConflict, match=rf"^{lock}: this is a link, .+ownership.place"):
        own(tmp_path / "room")
    assert json.loads((lock.parent / "job.json").read_text())["tool"] == "usdbrdf"
