"""Who reads an asset and who works in it never meet: what is read is of one moment."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from usdbrdf.errors import FolderBusy, InputRefused
from usdbrdf.job.ownership import folder_lock, reading
from usdbrdf.job.stamp import Stamp, stamp_path, write_stamp

ROOT = Path(__file__).parents[2]
HOLD = """
import sys
from pathlib import Path
from usdbrdf.job.ownership import folder_lock, reading
room = Path(sys.argv[2])
with reading(room) if sys.argv[1] == "reads" else folder_lock(room / ".usdbrdf"):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def room(tmp_path):
    state = tmp_path / "room" / ".usdbrdf"
    (state / "stamps").mkdir(parents=True)
    with folder_lock(state):  # which leaves its file
        pass
    return state.parent


@contextmanager
def another(does: str, room: Path):
    """Another process that reads the asset, or works in it; gives how to end it."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, does, str(room)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.mark.fault("R6")
def test_who_reads_is_told_who_works_there_or_waits(room):
    with another("works", room) as run:
        with pytest.raises(FolderBusy, match=rf"pid {run.pid} on .+\[lock.busy\]"), reading(room):
            pass
        ending = threading.Timer(0.3, lambda: run.communicate("\n"))
        ending.start()
        with reading(room, wait_s=200):
            ending.join()


@pytest.mark.fault("R6")
def test_a_run_is_refused_while_others_read_and_they_do_not_mind_each_other(room):
    with another("reads", room) as other:
        with reading(room), reading(room / "room.usda"), reading(room):
            pass
        with pytest.raises(FolderBusy, match=r"which reads it"), folder_lock(room / ".usdbrdf"):
            pass
        other.communicate("\n")
        with folder_lock(room / ".usdbrdf"):
            pass


def is_refused(room: Path) -> bool:
    """Whether a run in another process would be."""
    done = subprocess.run(
        [sys.executable, "-c", HOLD, "works", str(room)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        input="\n",
        timeout=600,
        check=False,
    )
    return "FolderBusy" in done.stderr


def in_thread(function) -> list[BaseException]:
    raised: list[BaseException] = []

    def caught():
        try:
            function()
        except FolderBusy as error:
            raised.append(error)

    thread = threading.Thread(target=caught)
    thread.start()
    thread.join(600)
    return raised


def test_threads_that_read_keep_the_lock_for_each_other(room):
    def read():
        with reading(room):
            pass

    def work():
        with folder_lock(room / ".usdbrdf"):
            pass

    with reading(room):
        assert in_thread(read) == []
        assert is_refused(room)  # closing the lock file in the other thread would have freed it
        assert len(in_thread(work)) == 1
    assert not is_refused(room)
    with folder_lock(room / ".usdbrdf"):
        with reading(room):  # its own work
            pass
        assert is_refused(room)
        assert len(in_thread(read)) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user")
def test_a_user_who_may_not_write_is_refused_too(room):
    # Not below pytest's own folder, which is its user's alone.
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        there = shutil.copytree(room, Path(name) / "room")
        (there / ".usdbrdf").chmod(0o555)
        (there / ".usdbrdf" / "lock").chmod(0o444)
        with another("works", there):
            os.seteuid(65534)
            try:
                with pytest.raises(FolderBusy, match=r"lock\.busy"), reading(there):
                    pass
            finally:
                os.seteuid(0)
        os.seteuid(65534)
        try:
            with reading(there):
                pass
        finally:
            os.seteuid(0)


@pytest.mark.fault("R6")
@pytest.mark.parametrize("error", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_without_locks_a_change_meanwhile_is_noticed(room, monkeypatch, error):
    def no_locks(*_arguments):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(fcntl, "lockf", no_locks)
    with reading(room):
        pass
    done = Stamp(
        stage="shade", version="1", parameters={}, inputs={}, outputs={"layers/shading.usda": "1"}
    )
    with pytest.raises(FolderBusy, match=r"may be a mixture.+\[lock\.changed\]$"), reading(room):
        write_stamp(stamp_path(room, 3, "shade"), done)
    with reading(room):
        pass


def test_half_a_run_is_not_read(room):
    (room / ".usdbrdf/publishing-shade.json").write_text("{}")
    with pytest.raises(InputRefused, match=r"was stopped.+\[asset\.unfinished\]$"), reading(room):
        pass


def test_what_nobody_works_in_is_just_read(tmp_path):
    with reading(tmp_path), reading(tmp_path / "nothing"):
        pass
    assert list(tmp_path.iterdir()) == []
