"""Two runs in one folder: the second is told who the first is."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from usdbrdf import working_on
from usdbrdf.errors import FolderBusy, InputRefused
from usdbrdf.job.ownership import folder_lock, reading

ROOT = Path(__file__).parents[2]
HOLD = """
import sys, time
from pathlib import Path
from usdbrdf.job.ownership import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def holder(tmp_path):
    search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": search},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.mark.fault("R6")
def test_second_run_is_refused_at_once_and_told_who_holds_it(tmp_path, holder):
    started = time.monotonic()
    with (
        pytest.raises(FolderBusy, match=rf"pid {holder.pid} on .+ since .+\[lock.busy\]"),
        folder_lock(tmp_path),
    ):
        pass
    assert time.monotonic() - started < 1


@pytest.mark.fault("R6")
def test_lock_of_a_killed_run_is_free(tmp_path, holder):
    holder.kill()
    holder.wait()
    with folder_lock(tmp_path):
        pass


def test_waiting_for_the_first_run(tmp_path, holder):
    timer = threading.Timer(0.3, lambda: (holder.stdin.write("\n"), holder.stdin.flush()))
    timer.start()
    with folder_lock(tmp_path, wait_s=200):
        timer.join()


def in_thread(function):
    with ThreadPoolExecutor() as pool:
        return pool.submit(function).result()


def locking_once(folder):
    with folder_lock(folder):
        pass


def locked_by_another_process(folder):
    said = subprocess.run(
        [sys.executable, "-c", HOLD, str(folder)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        input="\n",
        timeout=300,
        check=False,
    ).stderr
    return "FolderBusy" in said


def test_a_second_thread_is_refused_and_the_first_keeps_its_lock(tmp_path):
    with folder_lock(tmp_path):
        with pytest.raises(FolderBusy, match="another thread"):
            in_thread(lambda: locking_once(tmp_path))
        assert locked_by_another_process(tmp_path)
    assert (tmp_path / "lock").read_bytes() == b""
    in_thread(lambda: locking_once(tmp_path))


def test_the_thread_that_holds_it_may_enter_again(tmp_path):
    with folder_lock(tmp_path):
        with folder_lock(tmp_path):
            pass
        assert locked_by_another_process(tmp_path)  # leaving the inner one frees nothing
    assert not locked_by_another_process(tmp_path)


FORK = """
import os, sys
from pathlib import Path
from usdbrdf.errors import FolderBusy, InputRefused
from usdbrdf.job.ownership import folder_lock, reading
with folder_lock(Path(sys.argv[1])):
    child = os.fork()
    if child == 0:
        try:
            with folder_lock(Path(sys.argv[1])):
                os._exit(0)
        except FolderBusy:
            os._exit(5)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    sys.stdin.readline()
"""


def test_a_forked_child_has_no_part_in_the_lock(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", FORK, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "5\n"
        assert locked_by_another_process(tmp_path)


@pytest.mark.fault("R6")
def test_two_machines_that_share_a_folder_meet(tmp_path):
    """Two mount namespaces, where the folder lies in different places."""
    shared, there = tmp_path / "shared", tmp_path / "elsewhere"
    shared.mkdir()
    there.mkdir()
    own = ["unshare", "--map-root-user", "--mount"]
    if subprocess.run([*own, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no namespaces here")
    mounted = 'mount --bind "$1" "$2" && exec "$3" -c "$4" "$2"'
    with subprocess.Popen(
        [*own, "sh", "-c", mounted, "sh", str(shared), str(there), sys.executable, HOLD],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout.readline() == "held\n"
        assert not list(there.iterdir())  # it is mounted over there alone
        with pytest.raises(FolderBusy), folder_lock(shared):
            pass
        other.kill()
    with folder_lock(shared):
        pass


@pytest.mark.fault("R6")
@pytest.mark.parametrize("error", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_without_locks_a_run_refuses_unless_told_otherwise(tmp_path, monkeypatch, error):
    def no_locks(*_arguments):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(fcntl, "lockf", no_locks)
    with (
        pytest.raises(
            FolderBusy, match=r"no working locks .+ --without-lock.+\[lock\.none\]$"
        ) as e,
        folder_lock(tmp_path, wait_s=60),
    ):
        pass
    assert e.value.exit_code == 5
    with folder_lock(tmp_path, without_lock=True):
        assert str(os.getpid()) in (tmp_path / "lock").read_text()
    with pytest.raises(FolderBusy), working_on(tmp_path / "room"):
        pass
    with working_on(tmp_path / "room", without_lock=True):
        pass


def test_other_errors_of_the_lock_are_not_hidden(tmp_path, monkeypatch):
    def failing(*_arguments):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(fcntl, "lockf", failing)
    with pytest.raises(OSError, match="Input/output"), folder_lock(tmp_path, without_lock=True):
        pass


def test_folder_busy_through_the_task(tmp_path, toy, toy_process):
    toy.run_toy(tmp_path / "room")
    with folder_lock(tmp_path / "room/.usdbrdf"):
        assert "FolderBusy" in toy_process(tmp_path / "room").stderr


@pytest.mark.fault("C13")
@pytest.mark.parametrize("taking", ["work", "read"])
def test_what_a_newer_version_left_while_one_waited_is_not_taken(tmp_path, taking):
    state = tmp_path / "room/.usdbrdf"
    state.mkdir(parents=True)
    newer_runs = threading.Event()

    def newer_version():
        with folder_lock(state):
            newer_runs.set()
            time.sleep(0.3)
            (state / "job.json").write_text('{"schema": 2}')

    with ThreadPoolExecutor() as pool:
        ran = pool.submit(newer_version)
        newer_runs.wait(200)
        taken = (
            folder_lock(state, wait_s=200)
            if taking == "work"
            else reading(state.parent, wait_s=200)
        )
        with pytest.raises(InputRefused, match=r"job\.json: .+newer.+\[asset\.newer\]$"), taken:
            pass
        ran.result()
    (state / "job.json").unlink()
    with folder_lock(state):  # which is free again
        pass
