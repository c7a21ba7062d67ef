"""Run a function in a process of its own, because it may crash or hang on a bad mesh or file.

A fresh interpreter is started, not forked: our threads and locks stay here, and a caller's script
needs no ``__main__`` guard. It imports nothing of the package but what the function needs. Arrays
travel as files without pickles, in a folder for the time of the call; those that a killed run left
behind go at the next one. The child dies with us.
"""

from __future__ import annotations

import ctypes
import errno
import json
import math
import mmap
import os
import resource
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from usdbrdf import errors
from usdbrdf.errors import CrashedChild, EnvironmentFailure, LateChild, UsdBrdfError
from usdbrdf.files.atomic import environment_failures
from usdbrdf.files.documents import json_text, load_arrays, save_arrays
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.model.arrays import Array

# Not "-m": runpy warns of modules that are imported already, and those would be last words.
_START = "from usdbrdf.job.child import main; main()"
# BLAS's threads would only wait for each other, and each takes addresses, which may be limited.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
# Exit statuses of a child that left an error.json, and of one for which its disk had no room.
_ERROR_TOLD, _ERROR_UNTOLD = 97, 98
# What a disk says on which nothing can be written.
_NO_PLACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES)
_GRACE_SECONDS = 10  # the child's own alarm, should we die before we can end it
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_ERROR_CLASSES = {
    name: value
    for name, value in vars(errors).items()
    if isinstance(value, type) and issubclass(value, UsdBrdfError)
}


def run_child(
    function: str,
    arrays: Mapping[str, Array],
    parameters: Mapping[str, Any],
    timeout_s: float,
    label: str,
    *,
    memory_limit_bytes: int | None = None,
) -> dict[str, Array]:
    """What a ``child`` returns that works alone."""
    with child(
        function, arrays, parameters, timeout_s, label, memory_limit_bytes=memory_limit_bytes
    ) as result:
        return result()


@contextmanager
def child(
    function: str,
    arrays: Mapping[str, Array],
    parameters: Mapping[str, Any],
    timeout_s: float,
    label: str,
    *,
    memory_limit_bytes: int | None = None,
    cpu_limit_s: int | None = None,
) -> Iterator[Callable[[], dict[str, Array]]]:
    """A child process at work on ``function`` ("package.module:name"), called as f(arrays,
    parameters); parameters must be JSON. What the block is given waits for it to end and gives the
    arrays that it returns; at the end of the block it is killed.

    timeout_s            wall time that is waited for it
    label                what it does, for messages: "unwrap of <chair>"
    memory_limit_bytes   of address space (RLIMIT_AS), unlimited if None
    cpu_limit_s          of computing (RLIMIT_CPU), which says more of the input and less of who
                         else is at work on the machine; unlimited if None

    A UsdBrdfError raised there is raised by the waiting, with its class. Death by a signal is a
    CrashedChild, an InputRefused, and so is computing for longer than ``cpu_limit_s``; running out
    of wall time a LateChild, an EnvironmentFailure as running out of memory, or of what the shell
    lets a program compute, SIGKILL and what cannot be imported there are.
    """
    with scratch_folder() as folder:
        with environment_failures(label):
            save_arrays(folder / "arrays.npz", arrays)
            task = {
                "function": function,
                "parameters": dict(parameters),
                "label": label,
                "parent": os.getpid(),
                "alarm_s": math.ceil(timeout_s) + _GRACE_SECONDS,
                "memory_limit_bytes": memory_limit_bytes,
                "cpu_limit_s": cpu_limit_s,
            }
            (folder / "task.json").write_text(json_text(task), "utf-8")
        with _started(folder, label) as process:
            yield partial(_result, process, folder, timeout_s, label)


@contextmanager
def _started(folder: Path, label: str) -> Iterator[subprocess.Popen[bytes]]:
    # The child imports what we can import. It runs in the scratch folder, so that "-c" does not
    # put the caller's working folder, and whatever lies there, first on its path.
    search = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    with environment_failures(label), (folder / "said").open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-c", _START, str(folder)],
            cwd=folder,
            # What a crash leaves in the folder of temporary files goes with ours.
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": search, "TMPDIR": str(folder)},
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
    try:
        yield process
    finally:  # also on Ctrl-C: nothing of it may outlive us, nor what it started itself
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _result(
    process: subprocess.Popen[bytes], folder: Path, timeout_s: float, label: str
) -> dict[str, Array]:
    try:
        status = process.wait(timeout_s)
    except subprocess.TimeoutExpired as error:
        raise LateChild(
            f"{label} did not end within {timeout_s:g} s and was stopped. Run the same command "
            "again when the machine is less busy, or simplify the input. [child.timeout]"
        ) from error
    if status == _ERROR_TOLD:
        told = json.loads((folder / "error.json").read_text("utf-8"))
        if told["class"] in _ERROR_CLASSES:
            raise _ERROR_CLASSES[told["class"]](told["message"])
        raise UsdBrdfError(
            f"{label} failed: {told['class']}: {told['message']}. [child.failed]"
        ) from RuntimeError(told["traceback"])
    if status != 0:
        raise _crash(status, folder, label)
    return load_arrays(folder / "result.npz")


def _crash(status: int, folder: Path, label: str) -> UsdBrdfError:
    text = (folder / "said").read_text("utf-8", errors="replace").strip()
    last = text.splitlines()[-1:]
    said = f" Its last words: {last[0][:200]!r}." if last else ""
    if status == -signal.SIGKILL or "bad_alloc" in text:
        return EnvironmentFailure(
            f"{label} was killed from outside or out of memory.{said} Use a machine with more, or "
            "a smaller input. [child.killed]"
        )
    if status == _ERROR_UNTOLD:
        return EnvironmentFailure(
            f"{label}: nothing can be written into {folder.parent}, the folder of temporary "
            "files. Free disk space there, or name another folder (TMPDIR), then run the same "
            "command again; finished work is kept. [environment.io]"
        )
    if status > 0:  # the child tells every error of its function: it did not come as far
        return EnvironmentFailure(
            f"{label} could not be started (exit status {status}).{said} Check the installation "
            "and the limits of this shell (ulimit -a). [child.start]"
        )
    how = signal.Signals(-status).name
    if -status == signal.SIGXCPU:
        most = json.loads((folder / "task.json").read_text("utf-8"))["cpu_limit_s"]
        shell, _ = resource.getrlimit(resource.RLIMIT_CPU)
        if shell != resource.RLIM_INFINITY and (most is None or shell < most):
            return EnvironmentFailure(
                f"{label} computed for longer than this shell allows ({shell} s) and was stopped. "
                "Raise its limit (ulimit -t) and run the same command again. [child.limit]"
            )
        return CrashedChild(
            f"{label} computed for longer than it may and was stopped. Simplify the input. "
            "[child.endless]"
        )
    return CrashedChild(f"{label} crashed ({how}).{said} Repair the input. [child.crashed]")


def main() -> None:
    """The child's side: read the task, call the function, leave its result or its error."""
    folder = Path(sys.argv[1])
    task = json.loads((folder / "task.json").read_text("utf-8"))
    _die_with(task["parent"])
    signal.alarm(task["alarm_s"])
    _limit(resource.RLIMIT_AS, task["memory_limit_bytes"])
    _limit(resource.RLIMIT_CPU, task["cpu_limit_s"])
    try:
        with environment_failures(task["label"]):
            arrays = load_arrays(folder / "arrays.npz")
            module, _, name = task["function"].partition(":")
            result = getattr(import_module(module), name)(arrays, task["parameters"])
            save_arrays(folder / "result.npz", result)
    except Exception as error:
        name, message = type(error).__name__, str(error)
        if isinstance(error, ImportError):  # a library is missing, or memory is too small for it
            name = EnvironmentFailure.__name__
            message = (
                f"{task['label']}: {error}. Check the installation and the limits of this shell "
                "(ulimit -a). [child.start]"
            )
        told = {"class": name, "message": message, "traceback": traceback.format_exc()}
        try:
            (folder / "error.json").write_text(json.dumps(told), "utf-8")
        except OSError as failure:
            if failure.errno not in _NO_PLACE:
                raise
            _leave(_ERROR_UNTOLD)
        _leave(_ERROR_TOLD)
    _leave(0)


def in_a_copy(work: Callable[[], None]) -> None:
    """Have a copy of this process, a child without threads, do a piece of its work: it leaves
    without the destructors of what it made, and with its memory and its threads. What it finds, it
    writes into ``shared_zeros``. This process ends as the copy does, if that is otherwise than
    well; the limits that are left here hold there, and so does what ``main`` does of errors.
    """
    parent, (alarm_s, _) = os.getpid(), signal.getitimer(signal.ITIMER_REAL)
    computing_s = _computing_left()
    if computing_s == 0:
        os.kill(os.getpid(), signal.SIGXCPU)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # nobody waits for children where it is ignored
    copy = os.fork()
    if copy == 0:
        _die_with(parent)
        signal.setitimer(signal.ITIMER_REAL, alarm_s)
        _limit(resource.RLIMIT_CPU, computing_s)
        work()
        _leave(0)
    status = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
    if status < 0:
        os.kill(os.getpid(), -status)
    if status:
        _leave(status)


def shared_zeros(shape: tuple[int, ...], kind: type[np.generic]) -> Array:
    """An array in memory that this process shares with copies of it."""
    count = math.prod(shape)
    memory = mmap.mmap(-1, max(1, count) * np.dtype(kind).itemsize)
    return np.frombuffer(memory, kind, count).reshape(shape)


def _die_with(parent: int) -> None:
    """The kernel kills this process when its parent dies, which may have happened already."""
    with suppress(OSError, AttributeError):  # another system than Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def _limit(resource_number: int, most: int | None) -> None:
    """Lower a limit of this process to so much, unless the shell's is lower. The hard one stays:
    who reaches that of computing is killed without a word."""
    if most is not None:
        soft, hard = resource.getrlimit(resource_number)
        limit = min(limit for limit in (most, soft, hard) if limit != resource.RLIM_INFINITY)
        resource.setrlimit(resource_number, (limit, hard))


def _computing_left() -> int | None:
    """Whole seconds that this process and its copies may still compute."""
    soft, _ = resource.getrlimit(resource.RLIMIT_CPU)
    if soft == resource.RLIM_INFINITY:
        return None
    return max(0, math.floor(soft - sum(os.times()[:4])))


def _leave(status: int) -> NoReturn:
    """End without the destructors of compiled libraries: now and then one aborts a process whose
    work is done, over a thread that nobody joined."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)
