"""A file is the old one or the new one, whatever happens in between."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import resource
import shutil
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.fault_injection import VARIABLE, Fault
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files import atomic
from usdbrdf.files.atomic import (
    cure_of_writing,
    environment_failures,
    failure_of_machine,
    flush_file,
    flush_folder,
    publish,
    raise_shortage,
    sha256_of,
    temporary_beside,
    temporary_folder,
    whole_folder,
    write_text_atomic,
)
from usdbrdf.files.documents import save_arrays
from usdbrdf.files.scratch import PREFIX, scratch_folder

ROOT = Path(__file__).parents[2]


def run_python(code, *arguments, fault=""):
    search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": search, VARIABLE: fault},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.mark.fault("R11")
def test_publish_replaces_and_readers_keep_the_old_file(tmp_path):
    final, staged = tmp_path / "final", tmp_path / "staged"
    final.write_text("old")
    staged.write_text("new")
    with final.open() as reader:
        publish(staged, final)
        assert reader.read() == "old"
    assert final.read_text() == "new"
    assert not staged.exists()


def test_sha256(tmp_path):
    content = bytes(range(256)) * 10_000
    (tmp_path / "x").write_bytes(content)
    assert sha256_of(tmp_path / "x") == hashlib.sha256(content).hexdigest()


def test_text_is_utf8_and_has_ordinary_permissions(tmp_path):
    path = tmp_path / "椅子.txt"
    write_text_atomic(path, "é\n")
    assert path.read_bytes() == b"\xc3\xa9\n"
    (tmp_path / "plain").touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_long_names(tmp_path):
    path = tmp_path / ("x" * 250 + ".json")
    write_text_atomic(path, "a")
    assert path.read_text() == "a"


def test_failure_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with contextlib.suppress(RuntimeError), temporary_beside(path) as staged:
        staged.write_text("half")
        raise RuntimeError
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.txt", "old")]


@pytest.mark.fault("R2")
@pytest.mark.parametrize("side", ["before", "after"])
def test_kill_around_the_rename(tmp_path, side):
    path = tmp_path / "a.txt"
    path.write_text("old")
    code = (
        "import sys; from pathlib import Path; from usdbrdf.files.atomic import write_text_atomic;"
        "from tests.fault_injection import arm_from_environment; arm_from_environment();"
        "write_text_atomic(Path(sys.argv[1]), 'new')"
    )
    assert run_python(code, path, fault=f"kill@publish:{side}_replace").returncode == -9
    assert path.read_text() == ("old" if side == "before" else "new")


NOBODY = 2**22 + 1  # no process has a higher number than 2^22


def named(process):
    """As temporary files of a process of this machine are."""
    machine = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]
    return f".tmp-{machine}-{process}-00000000"


def killed_while(tmp_path, work):
    """Have a process killed while something temporary lies in ``tmp_path``; what it leaves."""
    code = (
        "import os, sys; from pathlib import Path; from usdbrdf.files import atomic;"
        f"held = atomic.{work}(Path(sys.argv[1])); place = held.__enter__();"
        "(place / 'x' if place.is_dir() else place).write_text('half'); os.kill(os.getpid(), 9)"
    )
    assert run_python(code, tmp_path / "a.usda").returncode == -9
    return {path.name for path in tmp_path.iterdir()}


@pytest.mark.fault("R2")
@pytest.mark.parametrize("work", ["temporary_beside", "temporary_folder"])
def test_what_a_killed_process_left_goes_with_the_next_write_beside_it(tmp_path, work):
    left = killed_while(tmp_path, work)
    assert len(left) == 1
    # As USD names what it writes under a name of ours, and what only looks like one.
    (tmp_path / f"{left.pop().removesuffix('.usda')}.2YgHvW").touch()
    others = {".tmp-mine", ".tmp-12-notours", ".tmp-0badf00d-4194305-00000000", "tmp-1-00000000"}
    for name in others:
        (tmp_path / name).touch()
    write_text_atomic(tmp_path / "b.txt", "new")
    assert {path.name for path in tmp_path.iterdir()} == {"b.txt", *others}


def test_what_another_process_is_writing_stays(tmp_path):
    """Whether it can be seen, or only its lock: it may run in another container."""
    seen = tmp_path / "seen" / named(os.getppid())
    seen.mkdir(parents=True)
    write_text_atomic(tmp_path / "seen" / "a.txt", "new")
    assert seen.is_dir()
    (tmp_path / "locked").mkdir()
    unseen = tmp_path / "locked" / named(NOBODY)
    unseen.touch()
    with contextlib.ExitStack() as longest:
        # Two at once, of which the one that came first, and swept, ends first.
        with temporary_folder(tmp_path / "locked" / "mine"):
            unseen.touch()
            longest.enter_context(temporary_folder(tmp_path / "locked" / "mine"))
        code = (
            "import sys; from pathlib import Path; from usdbrdf.files.atomic import *;"
            "write_text_atomic(Path(sys.argv[1]), 'new')"
        )
        assert run_python(code, tmp_path / "locked" / "a.txt").returncode == 0
        assert unseen.is_file()
    assert run_python(code, tmp_path / "locked" / "a.txt").returncode == 0
    assert not unseen.exists()


def test_a_folder_that_cannot_be_removed_keeps_nothing_else(tmp_path, monkeypatch):
    """As one of those that a network disk fills with files which somebody holds open."""
    left = [tmp_path / f"{named(NOBODY)[:-2]}{k:02x}" for k in range(12)]
    for place in left[::3]:
        place.touch()
    for place in {*left} - {*left[::3]}:
        place.mkdir()
    stuck, remove = {left[1].name, left[7].name}, os.rmdir

    def refused(path, **named):
        if os.path.basename(path) in stuck:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), path)
        remove(path, **named)

    monkeypatch.setattr(os, "rmdir", refused)
    write_text_atomic(tmp_path / "a.txt", "new")
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", *stuck}


@pytest.mark.fault("R2")
def test_what_another_process_with_our_number_left_goes_and_ours_stays(tmp_path, monkeypatch):
    """In a container each command is process 1."""
    left = tmp_path / named(os.getpid())
    left.mkdir()
    with temporary_folder(tmp_path / "a") as mine, temporary_beside(tmp_path / "a.usda") as half:
        half.touch()
        as_usd_names_it = half.with_suffix(".2YgHvW")
        as_usd_names_it.touch()
        assert {path.name for path in tmp_path.iterdir()} == {
            mine.name, half.name, as_usd_names_it.name,
        }  # fmt: skip
        # One that was forked, and swept nowhere yet; the lock is ours, as for another descriptor.
        monkeypatch.setattr(atomic, "_swept", set())
        monkeypatch.setattr(fcntl, "flock", lambda _descriptor, _operation: None)
        write_text_atomic(tmp_path / "b.txt", "new")
        assert mine.is_dir()
        assert half.is_file()
        assert as_usd_names_it.is_file()


@pytest.mark.parametrize("name", [".", "..", "new", "../link"])
def test_a_folder_may_be_named_from_within(tmp_path, monkeypatch, name):
    here = tmp_path / "outer" / "here"
    (tmp_path / "apart").mkdir()
    here.mkdir(parents=True)
    (tmp_path / "outer" / "link").symlink_to(tmp_path / "apart")
    monkeypatch.chdir(here)
    if name == "..":  # holds this one
        with pytest.raises(OSError, match="not empty"), whole_folder(Path(name)):
            pass
        assert sorted(p.name for p in tmp_path.iterdir()) == ["apart", "outer"]
        return
    with whole_folder(Path(name)) as staged:
        (staged / "file").write_text("done")
    target = {".": here, "new": here / "new", "../link": tmp_path / "apart"}[name]
    assert (target / "file").read_text() == "done"


def test_without_locks_nothing_is_swept_and_all_is_written(tmp_path, monkeypatch):
    def failing(_descriptor, _operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    left = tmp_path / f"{named(NOBODY)}.txt"
    left.touch()
    monkeypatch.setattr(fcntl, "flock", failing)
    write_text_atomic(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "new"
    assert left.is_file()


def test_fault_at_the_kth_pass():
    fault = Fault("enospc@toy:kth:3")
    for _ in range(2):
        fault.point("toy:kth")
    with pytest.raises(OSError, match="No space left"):
        fault.point("toy:kth")
    fault.point("toy:kth")
    fault.point("toy:other")


@pytest.fixture
def on_disk(monkeypatch):
    """What reaches the disk, in order: names of files and folders that are flushed, and renames."""
    events, fsync, replace = [], os.fsync, os.replace

    def flushing(descriptor):
        events.append(("flush", Path(os.readlink(f"/proc/self/fd/{descriptor}")).name))
        fsync(descriptor)

    def renaming(source, target):
        events.append(("rename", Path(target).name))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", flushing)
    monkeypatch.setattr(os, "replace", renaming)
    return events


def test_content_is_on_disk_before_the_name_and_the_name_before_publish_returns(tmp_path, on_disk):
    staged, final = tmp_path / "staged", tmp_path / "final"
    staged.write_text("new")
    publish(staged, final)
    assert on_disk == [("flush", "staged"), ("rename", "final"), ("flush", tmp_path.name)]


def test_a_text_is_flushed_with_its_folder(tmp_path, on_disk):
    write_text_atomic(tmp_path / "a.json", "{}")
    (first, _), second, third = on_disk
    assert (first, second, third) == (
        "flush", ("rename", "a.json"), ("flush", tmp_path.name),
    )  # fmt: skip


@pytest.mark.fault("R1")
def test_folders_that_are_made_are_flushed_with_those_above(tmp_path, on_disk):
    with whole_folder(tmp_path / "new" / "above" / "it") as staged:
        assert on_disk == [("flush", tmp_path.name), ("flush", "new")]
        (staged / "a").touch()
    assert on_disk[-2:] == [("rename", "it"), ("flush", "above")]


@pytest.mark.parametrize("error", [errno.EINVAL, errno.ENOTSUP, errno.EIO])
def test_folders_that_cannot_be_flushed(tmp_path, monkeypatch, error):
    def failing(_descriptor):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(os, "fsync", failing)
    if error == errno.EIO:
        with pytest.raises(OSError, match="error"):
            flush_folder(tmp_path)
    else:
        flush_folder(tmp_path)  # network file systems say so


@pytest.mark.fault("R1")
def test_really_full_disk(tmp_path):
    """A limit on the file size fails in write() as a full disk does, at half the content."""
    code = """
import resource, sys
from pathlib import Path
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.atomic import environment_failures, write_text_atomic
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
try:
    with environment_failures("stamp"):
        write_text_atomic(Path(sys.argv[1]), "x" * 10000)
except EnvironmentFailure as error:
    print(error)
"""
    path = tmp_path / "a.txt"
    path.write_text("old")
    said = run_python(code, path).stdout
    assert said.startswith(f"stamp: File too large ('{path}'). ")
    assert said.endswith("[environment.io]\n")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.txt", "old")]


@pytest.mark.parametrize(
    ("error", "cure"),
    [
        (PermissionError(errno.EACCES, "no"), "Correct the permission"),
        (PermissionError(errno.EPERM, "no"), "Correct the permission"),
        (OSError(errno.EROFS, "no"), "Make the file system writable, or name another place"),
        (OSError(errno.ENOSPC, "no"), "Free disk space"),
        (OSError(errno.EIO, "no"), "Check the disk, or the network that it is on"),
        (NotADirectoryError(errno.ENOTDIR, "no"), "Check the path, and see that nothing else .*"),
        # numpy's of a full disk, and numbers that mean neither
        (OSError("10 requested and 3 written"), "Free disk space or correct the permission"),
        (OSError(errno.ENOTSUP, "no"), "Free disk space or correct the permission"),
    ],
)
def test_what_helps_is_what_the_systems_number_says(tmp_path, monkeypatch, error, cure):
    with (
        pytest.raises(EnvironmentFailure, match=rf"^it: .*\. {cure}, then run the same"),
        environment_failures("it"),
    ):
        raise error

    def refused(*_):
        raise error

    monkeypatch.setattr(Path, "open", refused)
    assert re.fullmatch(cure, cure_of_writing(tmp_path / "a"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_library_that_tells_no_number_is_asked_for_by_writing_more(tmp_path):
    assert cure_of_writing(Path("/dev/full")) == "Free disk space"
    assert cure_of_writing(tmp_path / "a").startswith("Free disk space or ")


@pytest.mark.fault("R1")
def test_an_error_of_an_open_file_names_it(tmp_path, monkeypatch):
    """The system tells no name with what it says at a write, a flush, or as late as at closing,
    where a disk of the network may be full."""
    with (
        pytest.raises(EnvironmentFailure, match=r"^shade: No space left .+ \('/dev/full'\)\. "),
        environment_failures("shade"),
    ):
        save_arrays(Path("/dev/full"), {"a": np.zeros(3)})
    (tmp_path / "a.json").write_text("{}")

    def fails(_descriptor):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", fails)
    for flush, place in ((flush_file, tmp_path / "a.json"), (flush_folder, tmp_path)):
        with pytest.raises(OSError, match=f"Input/output error: '{place}'$"):
            flush(place)


def test_errors_of_the_machine_are_translated():
    with pytest.raises(EnvironmentFailure, match="out of memory"), environment_failures("x"):
        raise MemoryError
    with pytest.raises(EnvironmentFailure, match="out of memory"), environment_failures("x"):
        raise OSError(12, "Cannot allocate memory", "/a")
    with pytest.raises(EnvironmentFailure, match="Permission"), environment_failures("x"):
        raise PermissionError(13, "Permission denied", "/a")
    with pytest.raises(BrokenPipeError), environment_failures("x"):
        raise BrokenPipeError
    with pytest.raises(ValueError, match="ours"), environment_failures("x"):
        raise ValueError("ours")


def test_an_error_does_not_name_what_is_temporary(tmp_path):
    taken = tmp_path / "taken.txt"
    (taken / "x").mkdir(parents=True)
    with (
        pytest.raises(EnvironmentFailure, match=rf"^x: Is a directory \('{taken}'\)\."),
        environment_failures("x"),
    ):
        write_text_atomic(taken, "a")
    with (
        pytest.raises(EnvironmentFailure, match=rf"^x: No such file.* \('{tmp_path}'\)\."),
        environment_failures("x"),
        temporary_folder(tmp_path / "new") as staged,
    ):
        (staged / "none" / "below").touch()
    theirs = tmp_path / ".tmp-theirs" / "a"
    with pytest.raises(EnvironmentFailure, match=str(theirs)), environment_failures("x"):
        theirs.read_text()


def test_a_rename_that_is_refused_names_what_was_to_be_replaced(tmp_path):
    """As a task's finished files are called as those that they are to replace."""
    staged, taken = tmp_path / "staged" / "fit.usda", tmp_path / "fit.usda"
    (taken / "x").mkdir(parents=True)
    staged.parent.mkdir()
    staged.touch()
    named = rf"^x: Is a directory \('{taken}'\)\."
    with pytest.raises(EnvironmentFailure, match=named), environment_failures("x"):
        publish(staged, taken)
    immutable = PermissionError(errno.EPERM, "Not permitted", str(staged), None, str(taken))
    assert str(failure_of_machine(immutable)).startswith(f"{taken}: Not permitted")


def test_a_refusal_names_what_was_to_become_of_something_temporary(tmp_path):
    output = tmp_path / "room.usdz"
    with (
        pytest.raises(EnvironmentFailure) as refused,
        scratch_folder(output) as scratch,
        temporary_folder(scratch / "textures") as folder,
        temporary_beside(folder / "a.exr") as staged,
    ):
        raise EnvironmentFailure(f"{staged}: no ({staged.with_suffix('.dd3.temp.exr')}). Free it.")
    place = f"{output}/textures/a.exr"
    assert str(refused.value) == f"{place}: no ({place}). Free it."


def test_a_copy_that_does_not_fit_names_its_place_and_the_limit(tmp_path):
    source, scratch = tmp_path / "sound.usda", tmp_path / f"{PREFIX}abc" / "sound.usda"
    scratch.parent.mkdir()
    source.write_bytes(bytes(5000))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with (
            pytest.raises(
                EnvironmentFailure, match=rf"^x: File too large \('{tmp_path}'\)\. .*ulimit"
            ),
            environment_failures("x"),
        ):
            shutil.copyfile(source, scratch)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_asking_whether_a_process_lives_does_nothing_to_it(monkeypatch):
    # A shell may have told its children to overlook that it hung up.
    waits = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL); print(flush=True); input()"
    )
    command = [sys.executable, "-c", waits]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        assert atomic._is_in_use("x", str(other.pid))
        time.sleep(0.2)
        assert other.poll() is None
        other.communicate(b"\n")
    assert not atomic._is_in_use("x", str(other.pid))
    assert not atomic._is_in_use("x", "9" * 30)
    monkeypatch.setattr(atomic, "_own", {"ours"})
    assert atomic._is_in_use("ours", str(os.getpid()))
    assert not atomic._is_in_use("another", str(os.getpid()))

    def forbidden(process, signal):
        raise PermissionError

    monkeypatch.setattr(os, "kill", forbidden)
    assert atomic._is_in_use("x", "1")


def test_flushing_a_folder_leaves_nothing_open(tmp_path):
    before = len(os.listdir("/proc/self/fd"))
    atomic.flush_folder(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_only_errors_of_permission_disk_files_and_threads_are_the_machine_s():
    for number in (errno.EACCES, errno.ENOSPC, errno.EMFILE, errno.EIO):
        found = failure_of_machine(OSError(number, os.strerror(number), "room/a.exr"))
        assert isinstance(found, EnvironmentFailure)
        assert str(found).startswith(f"room/a.exr: {os.strerror(number)}")
    assert isinstance(
        failure_of_machine(RuntimeError("can't start new thread")), EnvironmentFailure
    )
    for defect in (
        OSError(errno.ENOENT, "none"),
        OSError("odd"),
        ValueError("x"),
        RuntimeError("y"),
    ):
        assert failure_of_machine(defect) is None


def _answered(answer):
    """The error by which a library answers a disk that fails."""
    try:
        try:
            raise OSError(errno.EIO, "Input/output error")
        except OSError as disk:
            answer(disk)
    except Exception as error:
        return error


def _no_zip(disk):
    raise ValueError("not a zip file")


def _no_zip_because(disk):
    raise ValueError("not a zip file") from disk


def _row_3(disk):
    raise ValueError("row 3") from None


@pytest.mark.parametrize("answer", [_no_zip, _no_zip_because])
def test_a_disk_that_fails_is_told_whatever_a_library_makes_of_it(answer):
    with pytest.raises(EnvironmentFailure, match="Input/output error"):
        raise_shortage(_answered(answer))


def test_what_a_library_says_has_nothing_to_do_with_its_error_is_not_looked_at():
    raise_shortage(_answered(_row_3))


@pytest.mark.parametrize("length", [1, 3])
def test_errors_that_are_their_own_cause_come_to_an_end(length):
    errors = [ValueError(str(i)) for i in range(length)]
    for error, cause in zip(errors, errors[1:] + errors[:1], strict=True):
        error.__cause__ = cause
    raise_shortage(errors[0])
