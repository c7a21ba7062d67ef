"""A child that crashes, hangs, runs out of memory or refuses its input is told apart."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from usdbrdf.errors import CrashedChild, EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.files import scratch
from usdbrdf.job import child as module
from usdbrdf.job.child import run_child

CHILDREN = """
import os, resource, signal, sys, tempfile, time
import numpy as np
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.job.child import in_a_copy, shared_zeros

def double(arrays, parameters):
    print("chatter on stdout")
    return {name: array * parameters["factor"] for name, array in arrays.items()}

def die(arrays, parameters):
    print("about to die", file=sys.stderr, flush=True)
    os.kill(os.getpid(), getattr(signal, parameters["signal"]))

def die_wordless(arrays, parameters):
    os.kill(os.getpid(), signal.SIGSEGV)

def hang(arrays, parameters):
    grandchild = os.fork()
    if grandchild:
        with open(parameters["note"] + ".part", "w") as file:
            file.write(f"{os.getpid()} {grandchild}")
        os.rename(parameters["note"] + ".part", parameters["note"])
    time.sleep(600)

def note(arrays, parameters):
    with open(parameters["note"], "w") as file:
        file.write(str(os.getpid()))
    time.sleep(600)

def spin(arrays, parameters):
    while True:
        pass

def fill_disk(arrays, parameters):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    return {"a": np.zeros(9)}

def open_too_many(arrays, parameters):
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    raise ValueError("of another kind")

def leave(arrays, parameters):
    print("no memory for a thread", file=sys.stderr, flush=True)
    os._exit(1)

def imports(arrays, parameters):
    import missing_library

def refuse(arrays, parameters):
    raise InputRefused("mesh: no triangles. [mesh.empty]")

def broken(arrays, parameters):
    return {"x": 1 / 0}

def litter(arrays, parameters):
    with open(os.path.join(tempfile.gettempdir(), "crash-report"), "w") as file:
        file.write("of a library")
    os.abort()

def hungry(arrays, parameters):
    return {"x": np.ones(1 << 32)}

def threads(arrays, parameters):
    from threadpoolctl import threadpool_info
    return {"threads": np.array([pool["num_threads"] for pool in threadpool_info()])}

class Undying:
    def __del__(self):
        time.sleep(600)

def copies(arrays, parameters):
    found, undying = shared_zeros((3, 2), np.int64), []
    def work(i):
        undying.append(Undying())
        found[i] = len(undying), os.getpid()
    for i in range(3):
        in_a_copy(lambda: work(i))
    return {"found": found, "own": np.array([os.getpid()])}

def in_copy(arrays, parameters):
    in_a_copy(lambda: globals()[parameters["work"]](arrays, parameters))

def spin_in_turns(arrays, parameters):
    def spin_awhile():
        while sum(os.times()[:2]) < 0.7:
            pass
    while True:
        in_a_copy(spin_awhile)

def objects(arrays, parameters):
    return {"x": np.array([object()])}
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    (tmp_path / "toy_children.py").write_text(CHILDREN)
    monkeypatch.syspath_prepend(str(tmp_path))

    def run(name, arrays=None, timeout_s=30.0, memory_limit_bytes=None, **parameters):
        return run_child(
            f"toy_children:{name}",
            arrays or {},
            parameters,
            timeout_s,
            "unwrap of <chair>",
            memory_limit_bytes=memory_limit_bytes,
        )

    return run


def test_arrays_there_and_back(child, capfd):
    given = {"file": np.arange(6.0).reshape(2, 3), "faces": np.zeros((0, 3), np.int32)}
    got = child("double", given, factor=2)
    assert list(got) == ["file", "faces"]
    assert np.array_equal(got["file"], given["file"] * 2)
    assert got["faces"].dtype == np.int32
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGFPE"])
def test_crash_is_a_refused_input(child, name):
    expected = rf"^unwrap of <chair> crashed \({name}\).+about to die.+\[child\.crashed\]$"
    with pytest.raises(InputRefused, match=expected):
        child("die", signal=name)


@pytest.mark.fault("R4")
def test_kill_from_outside_is_the_environment(child):
    with pytest.raises(EnvironmentFailure, match=r"out of memory.+\[child\.killed\]"):
        child("die", signal="SIGKILL")


def test_what_a_crash_leaves_among_temporary_files_goes_too(child, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(CrashedChild):
        child("litter")
    assert list(tmp_path.rglob("crash-report")) == []


def test_a_crash_without_words_has_none(child):
    with pytest.raises(InputRefused) as refused:
        child("die_wordless")
    expected = "unwrap of <chair> crashed (SIGSEGV). Repair the input. [child.crashed]"
    assert str(refused.value) == expected


def test_a_child_that_cannot_start_is_the_environment(child):
    with pytest.raises(EnvironmentFailure, match=r"status 1.+for a thread.+\[child\.start\]$"):
        child("leave")
    with pytest.raises(EnvironmentFailure, match=r"missing_library.+\[child\.start\]$"):
        child("imports")


@pytest.mark.fault("R1")
def test_a_child_whose_disk_is_full_says_which(child, tmp_path, monkeypatch):
    """Not even what is wrong can be left there: it was told as one that could not be started."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    expected = rf"^unwrap of <chair>: .+ written into {tmp_path}, .+TMPDIR.+\[environment\.io\]$"
    with pytest.raises(EnvironmentFailure, match=expected):
        child("fill_disk")


def test_a_child_that_may_open_no_file_is_not_told_to_free_disk_space(child):
    with pytest.raises(EnvironmentFailure, match=r"Too many open files.+\[child\.start\]$"):
        child("open_too_many")


def test_hang_is_stopped_with_all_that_it_started(child, tmp_path, monkeypatch):
    """The clock starts when the child says that it hangs, however long its interpreter takes."""
    note = tmp_path / "pids"
    wait = subprocess.Popen.wait

    def wait_once_it_hangs(process, timeout=None):
        if timeout is not None:
            _appears(note)
        return wait(process, timeout)

    monkeypatch.setattr(subprocess.Popen, "wait", wait_once_it_hangs)
    with pytest.raises(EnvironmentFailure, match=r"within 0\.2 s.+\[child\.timeout\]") as late:
        child("hang", timeout_s=0.2, note=str(note))
    assert late.value.exit_code == 4
    assert all(_ended(int(pid)) for pid in note.read_text().split())


def test_computing_without_end_is_told_from_waiting(child):
    crashed = pytest.raises(CrashedChild, match=r"for longer than it may.+\[child\.endless\]$")
    with crashed, module.child("toy_children:spin", {}, {}, 600, "spinning", cpu_limit_s=2) as end:
        end()


def test_copies_leave_with_what_they_made_and_hand_over_what_they_found(child):
    got = child("copies")
    assert got["found"][:, 0].tolist() == [1, 1, 1]
    assert len({*got["found"][:, 1].tolist(), *got["own"].tolist()}) == 4


def test_a_child_ends_as_a_copy_of_it_does(child):
    with pytest.raises(CrashedChild, match=r"crashed \(SIGSEGV\).+about to die"):
        child("in_copy", work="die", signal="SIGSEGV")
    with pytest.raises(EnvironmentFailure, match=r"\[child\.killed\]$"):
        child("in_copy", work="die", signal="SIGKILL")
    with pytest.raises(InputRefused, match=r"^mesh: no triangles\. \[mesh\.empty\]$"):
        child("in_copy", work="refuse")
    with pytest.raises(UsdBrdfError, match=r"ZeroDivisionError.+\[child\.failed\]$"):
        child("in_copy", work="broken")


def test_copies_share_the_time_that_a_child_may_compute(child):
    crashed = pytest.raises(CrashedChild, match=r"\[child\.endless\]$")
    beside = partial(module.child, arrays={}, parameters={}, timeout_s=600, label="spinning")
    with crashed, beside("toy_children:spin_in_turns", cpu_limit_s=4) as end:
        end()


@pytest.mark.fault("R4")
@pytest.mark.parametrize(("most", "who"), [(None, "limit"), (600, "limit"), (3, "endless")])
def test_a_limit_of_the_shell_on_computing_is_the_environment(child, tmp_path, most, who):
    """In a shell of its own: its limit also holds for who starts the child."""
    code = (
        "import sys\n"
        "from resource import RLIMIT_CPU, getrlimit, setrlimit\n"
        "from usdbrdf.job.child import child\n"
        "setrlimit(RLIMIT_CPU, (4, getrlimit(RLIMIT_CPU)[1]))\n"
        f"with child('toy_children:spin', {{}}, {{}}, 600, 'x', cpu_limit_s={most}) as end:\n"
        "    try:\n        end()\n"
        "    except Exception as error:\n        sys.exit(f'{error.exit_code}: {error}')\n"
    )
    search = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2]), *sys.path])
    said = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": search},
        capture_output=True,
        text=True,
    ).stderr
    assert said.startswith("4: " if who == "limit" else "3: "), said
    assert f"[child.{who}]" in said
    assert ("(4 s)" in said and "ulimit -t" in said) == (who == "limit")


def test_a_copy_is_ended_with_its_child(child, tmp_path):
    note = tmp_path / "note"
    given = {"work": "note", "note": str(note)}
    with module.child("toy_children:in_copy", {}, given, 600, "beside"):
        _appears(note)
        while not note.read_text():
            time.sleep(0.02)
    assert _ended(int(note.read_text()))


def test_a_child_beside_is_ended_with_the_block(child, tmp_path):
    note = tmp_path / "note"
    with module.child("toy_children:note", {}, {"note": str(note)}, 600, "beside"):
        deadline = time.monotonic() + 300
        while not (note.exists() and note.read_text()):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        number = int(note.read_text())
        os.kill(number, 0)
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


def test_what_a_child_beside_cannot_do_is_nobodys_concern(child, capfd):
    with module.child("toy_children:broken", {}, {}, 600, "beside"):
        time.sleep(0.1)
    assert capfd.readouterr() == ("", "")


def test_a_child_dies_with_its_parent_and_its_folder_is_swept(tmp_path, monkeypatch):
    (tmp_path / "toy_children.py").write_text(CHILDREN)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    note = tmp_path / "pids"
    code = (
        "from usdbrdf.job.child import run_child\n"
        f"run_child('toy_children:hang', {{}}, {{'note': {str(note)!r}}}, 600, 'hanging')"
    )
    search = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2]), *sys.path])
    parent = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": search}
    )
    _appears(note)
    (left,) = tmp_path.glob(f"{scratch.PREFIX}*")
    os.utime(left, (0, 0))
    child, grandchild = (int(pid) for pid in note.read_text().split())
    try:
        assert _sweeps(tmp_path) == {left}, "it has an owner"
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert _ended(child)
        fresh = tmp_path / f"{scratch.PREFIX}fresh"
        link = tmp_path / f"{scratch.PREFIX}link"
        fresh.mkdir()
        link.symlink_to(tmp_path)
        assert _sweeps(tmp_path) == {fresh, link}, "one is too young to be without owner"
    finally:
        os.kill(grandchild, signal.SIGKILL)


def _sweeps(folder):
    """The scratch folders that the next run leaves."""
    scratch._sweep.cache_clear()
    with scratch.scratch_folder() as own:
        return set(folder.glob(f"{scratch.PREFIX}*")) - {own}


def _appears(path):
    for _ in range(1200):
        if path.exists():
            return
        time.sleep(0.1)
    pytest.fail(f"{path} did not appear")


def _ended(pid):
    """Whether a process is gone, or a zombie that its new parent has not collected."""
    for _ in range(600):
        try:
            os.kill(pid, 0)
            status = Path(f"/proc/{pid}/status")
            if status.is_file() and "State:\tZ" in status.read_text():
                return True
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.1)
    return False


def test_error_keeps_its_class_and_words(child):
    with pytest.raises(InputRefused, match=r"^mesh: no triangles\. \[mesh\.empty\]$"):
        child("refuse")


@pytest.mark.parametrize(("name", "what"), [("broken", "ZeroDivision"), ("objects", "ValueError")])
def test_bug_in_a_child_is_a_bug(child, name, what):
    with pytest.raises(UsdBrdfError, match=rf"failed: {what}.+\[child\.failed\]$") as caught:
        child(name)
    assert type(caught.value) is UsdBrdfError
    assert "Traceback" in str(caught.value.__cause__)


@pytest.mark.fault("R4")
def test_memory_limit(child):
    with pytest.raises(EnvironmentFailure, match=r"out of memory"):
        child("hungry", memory_limit_bytes=8 << 30)


def test_a_memory_limit_above_that_of_the_shell_is_no_fault(child):
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (64 << 30, before[1]))
    try:
        assert child("double", {"x": np.ones(2)}, memory_limit_bytes=1 << 40, factor=2)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_blas_keeps_to_one_thread_in_a_child(child, monkeypatch):
    """Each takes addresses, of which there may be few on machines with many cores."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    assert child("threads", memory_limit_bytes=3 << 30)["threads"].tolist() == [1]


def test_a_child_imports_nothing_but_what_its_function_needs():
    """What the package itself imports is left out here: a bare module stands for it."""
    package = Path(__file__).parents[2] / "usdbrdf"
    probe = (
        "import sys, types\n"
        "sys.modules['usdbrdf'] = types.ModuleType('usdbrdf')\n"
        f"sys.modules['usdbrdf'].__path__ = [{str(package)!r}]\n"
        "import usdbrdf.job.child\n"
        "heavy = ('numba', 'pxr', 'mitsuba', 'trimesh', 'OpenImageIO', 'scipy')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert said.stdout == "[]\n"


@pytest.mark.fault("S7")
def test_pickled_arrays_do_not_leave(child):
    with pytest.raises(ValueError, match="Object arrays"):
        child("double", {"x": np.array([object()])}, factor=1)


@pytest.mark.fault("R14")
def test_children_of_a_threaded_program_are_not_forked_from_it(child, monkeypatch):
    """A fork copies locks that other threads hold and leaves nobody to open them."""

    def forking(*_):
        raise AssertionError("forked")

    monkeypatch.setattr(os, "fork", forking)
    done, lock = threading.Event(), threading.Lock()

    def busy():
        while not done.is_set():
            with lock:
                sum(range(1000))

    threads = [threading.Thread(target=busy) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda i: child("double", {"x": np.ones(2)}, factor=i), range(6)))
    finally:
        done.set()
        for thread in threads:
            thread.join()
    assert [each["x"].tolist() for each in found] == [[i, i] for i in range(6)]
