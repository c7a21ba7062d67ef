"""Run a function in a process of its own, because it may crash or hang on a bad mesh or file.

A fresh interpreter is started, not forked: our threads and locks stay here, and a caller's script
needs no ``__main__`` guard. Arrays travel as files without pickles.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from usdbrdf import errors
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.files.arrays import load_arrays, save_arrays
from usdbrdf.files.atomic import environment_failures
from usdbrdf.files.documents import json_text
from usdbrdf.model.arrays import Array

_ERROR_TOLD = 97  # exit status of a child that left an error.json

_GRACE_SECONDS = 10  # the child's own alarm, should we die before we can end it

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
    """Call ``function`` ("package.module:name") as f(arrays, parameters) in a child process.

    arrays, parameters   what it gets; parameters must be JSON
    timeout_s            wall time after which it is killed
    label                what it does, for messages: "unwrap of <chair>"
    memory_limit_bytes   of address space (RLIMIT_AS), unlimited if None
    returns              the dictionary of arrays that it returned

    A UsdBrdfError raised there is raised here with its class; death by a signal and running out
    of time become InputRefused, running out of memory EnvironmentFailure.
    """
    with tempfile.TemporaryDirectory(prefix="usdbrdf-") as name:
        folder = Path(name)
        with environment_failures(label):
            save_arrays(folder / "arrays.npz", arrays)
            task = {
                "function": function,
                "parameters": dict(parameters),
                "alarm_s": math.ceil(timeout_s) + _GRACE_SECONDS,
                "memory_limit_bytes": memory_limit_bytes,
            }
            (folder / "task.json").write_text(json_text(task), "utf-8")
        status = _run(folder, timeout_s, label)
        if status == _ERROR_TOLD:
            raise _told_error(folder, label)
        if status != 0:
            raise _crash(status, folder, label)
        return load_arrays(folder / "result.npz")


def _run(folder: Path, timeout_s: float, label: str) -> int:
    # The child imports what we can import. It runs in the temporary folder, so that "-m" does not
    # put the caller's working folder, and whatever lies there, first on its path.
    search = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    with environment_failures(label), (folder / "said").open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "usdbrdf.job.child", str(folder)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": search},
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired as error:
        raise InputRefused(
            f"{label} did not end within {timeout_s:g} s and was stopped. Simplify or repair the "
            "input. [child.timeout]"
        ) from error
    finally:  # also on Ctrl-C: nothing of it may outlive us, nor what it started itself
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _told_error(folder: Path, label: str) -> UsdBrdfError:
    told = json.loads((folder / "error.json").read_text("utf-8"))
    known = _ERROR_CLASSES.get(told["class"])
    if known is not None:
        return known(told["message"])
    error = UsdBrdfError(f"{label} failed: {told['class']}: {told['message']}. [child.failed]")
    error.__cause__ = RuntimeError(told["traceback"])
    return error


def _crash(status: int, folder: Path, label: str) -> UsdBrdfError:
    last = (folder / "said").read_text("utf-8", errors="replace").strip().splitlines()[-1:]
    said = f" Its last words: {last[0][:200]!r}." if last else ""
    if status == -signal.SIGKILL:
        return EnvironmentFailure(
            f"{label} was killed from outside, most likely out of memory.{said} Use a machine "
            "with more, or a smaller input. [child.killed]"
        )
    how = signal.Signals(-status).name if status < 0 else f"exit status {status}"
    return InputRefused(f"{label} crashed ({how}).{said} Repair the input. [child.crashed]")


def _main(folder: Path) -> int:
    """The child's side: read the task, call the function, leave its result or its error."""
    task = json.loads((folder / "task.json").read_text("utf-8"))
    signal.alarm(task["alarm_s"])
    if task["memory_limit_bytes"] is not None:
        resource.setrlimit(resource.RLIMIT_AS, (task["memory_limit_bytes"],) * 2)
    try:
        module, _, name = task["function"].partition(":")
        with environment_failures(task["function"]):
            arrays = load_arrays(folder / "arrays.npz")
            result = getattr(import_module(module), name)(arrays, task["parameters"])
            save_arrays(folder / "result.npz", result)
    except Exception as error:
        told = {
            "class": type(error).__name__,
            "message": str(error),
            "traceback": traceback.format_exc(),
        }
        (folder / "error.json").write_text(json.dumps(told), "utf-8")
        return _ERROR_TOLD
    return 0


if __name__ == "__main__":
    raise SystemExit(_main(Path(sys.argv[1])))
