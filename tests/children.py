"""Children of the product, and programs of tests, that are forked from a process which has imported
what they need.

Each is what ``usdbrdf.job.child`` starts otherwise: a process and a session of its own, with its
folder, environment, path, limits and last words, that dies with who asked for it. It saves the
second of imports that a fresh interpreter takes for each of thousands of small meshes and files.
Tests that are about the start itself get the real one, and ``USDBRDF_FRESH_CHILDREN=1`` all of them
(.ci/nightly). The same holds for the two seconds of each program that runs a step of the product to
be killed there: see ``started_program``.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module, invalidate_caches
from pathlib import Path
from typing import Any, NoReturn

import usdbrdf.job.child as product
from usdbrdf.files.atomic import environment_failures

# With less address space what a child has imported already counts; in less time, that it has.
_LEAST_MEMORY, _LEAST_SECONDS = 4 << 30, 1
_IMPORTED = (
    "numpy", "pxr.Usd", "pxr.UsdGeom", "pxr.UsdShade", "trimesh", "xatlas", "flip_evaluator",
    "usdbrdf.geometry.unwrap", "usdbrdf.untrusted.bounds", "usdbrdf.untrusted.mesh_files",
)  # fmt: skip
_OF_PROGRAMS = (
    "tests.fault_injection", "usdbrdf.capture.adapters", "usdbrdf.cli", "usdbrdf.commands",
    "usdbrdf.pipeline", "usdbrdf.tasks.fit", "usdbrdf.tasks.ingest", "usdbrdf.tasks.shade",
    "usdbrdf.tasks.texture", "tests.first_kernel",
)  # fmt: skip
# What has threads cannot be forked; USD would say that it has none.
_NO_THREADS = {
    "OPENBLAS_NUM_THREADS": "1", "PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0",
}  # fmt: skip
_NUMBER, _NONE = struct.Struct("q"), 0
_STREAMS = ("out", "err")


class ForkedChild:
    """As much of ``subprocess.Popen`` as the product asks of a child."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._status: int | None = None
        self.pid = self._told(None)
        if self.pid == _NONE:
            end.close()

    def wait(self, timeout: float | None = None) -> int:
        if self._status is None:
            try:
                self._status = self._told(timeout)
            except TimeoutError as error:
                raise subprocess.TimeoutExpired("a child", timeout or 0) from error
            self._end.close()
        return self._status

    def _told(self, timeout: float | None) -> int:
        self._end.settimeout(timeout)
        told = self._end.recv(_NUMBER.size, socket.MSG_WAITALL)
        assert len(told) == _NUMBER.size, "the process that forks children has ended"
        number: int = _NUMBER.unpack(told)[0]
        return number


class Children:
    """Starts children in the place of ``usdbrdf.job.child``."""

    def __init__(self, imported: Sequence[str] = _IMPORTED) -> None:
        self._imported = imported
        self._fresh = product._started
        self._control: socket.socket | None = None
        self._server: subprocess.Popen[bytes] | None = None

    @contextmanager
    def started(self, folder: Path, label: str) -> Iterator[Any]:
        """In the place of ``usdbrdf.job.child._started``."""
        task, child = json.loads((folder / "task.json").read_text("utf-8")), None
        hurried = task["alarm_s"] - product._GRACE_SECONDS <= _LEAST_SECONDS
        if (task["memory_limit_bytes"] or _LEAST_MEMORY) >= _LEAST_MEMORY and not hurried:
            with environment_failures(label):
                child = self._forked(folder, task)
        if child is None or child.pid == _NONE:
            with self._fresh(folder, label) as process:
                yield process
            return
        try:
            yield child
        finally:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()

    def _forked(self, folder: Path, task: dict[str, Any]) -> ForkedChild:
        return self.asked({
            "folder": str(folder), "parent": task["parent"],
            "environment": {**os.environ, **product._ONE_THREAD, "TMPDIR": str(folder),
                            "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
            "path": ["", *map(os.path.abspath, sys.path)],
            "modules": [task["function"].partition(":")[0],
                        str(task["parameters"].get("reader", "")).partition(":")[0]],
        })  # fmt: skip

    def asked(self, request: dict[str, Any]) -> ForkedChild:
        """One that does what ``serve`` knows."""
        if self._control is None:
            self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._server = subprocess.Popen(
                    [sys.executable, "-c", "from tests.children import serve; serve()",
                     str(theirs.fileno()), *self._imported],
                    pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL, cwd=Path(__file__).parents[1],
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **_NO_THREADS},
                )  # fmt: skip
        ours, theirs = socket.socketpair()
        with theirs:
            socket.send_fds(self._control, [json.dumps(request).encode()], [theirs.fileno()])
        return ForkedChild(ours)

    def end(self) -> None:
        """The server ends with its socket."""
        if self._control is not None and self._server is not None:
            self._control.close()
            self._server.wait()


class Program:
    """As much of ``subprocess.Popen`` as tests ask of a program: streams are read at its end."""

    def __init__(self, child: ForkedChild, folder: tempfile.TemporaryDirectory[str]) -> None:
        self._child, self._folder = child, folder
        self.returncode: int | None = None

    def communicate(self, timeout: float | None = None) -> tuple[bytes, bytes]:
        self.returncode = self._child.wait(timeout)
        with self._folder as folder:
            out, err = (Path(folder, name).read_bytes() for name in _STREAMS)
        return out, err

    def terminate(self) -> None:
        os.kill(self._child.pid, signal.SIGTERM)


def started_program(
    code: str, arguments: Sequence[str], environment: dict[str, str]
) -> Program | subprocess.Popen[bytes]:
    """As ``python -c CODE ARGUMENTS`` starts it, with more of the environment, its output kept."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    if sys.platform == "linux" and not os.environ.get("USDBRDF_FRESH_CHILDREN"):
        folder = tempfile.TemporaryDirectory(prefix="usdbrdf-program-")
        child = _programs().asked({
            "program": code, "arguments": list(arguments), "environment": environment,
            "folder": os.getcwd(), "streams": folder.name, "path": sys.path, "modules": [],
        })  # fmt: skip
        if child.pid != _NONE:
            return Program(child, folder)
        folder.cleanup()
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


@cache
def _programs() -> Children:
    children = Children(_OF_PROGRAMS)
    atexit.register(children.end)
    return children


def serve() -> None:
    """Fork a child for each request, until nobody is left to ask."""
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that watch
    _import(sys.argv[2:])
    while True:
        said, ends, _, _ = socket.recv_fds(control, 1 << 20, 1)
        if not said:
            os._exit(0)  # what is frozen would be called leaked
        request = json.loads(said)
        _import([name for name in request["modules"] if name.startswith("usdbrdf.")])
        if len(os.listdir("/proc/self/task")) > 1:
            os.write(ends[0], _NUMBER.pack(_NONE))
        elif os.fork() == 0:
            control.close()
            _watch(request, ends[0])
        os.close(ends[0])


def _import(names: Any) -> None:
    for name in names:
        with suppress(ImportError):  # the child will say so
            import_module(name)
    gc.freeze()


def _watch(request: dict[str, Any], end: int) -> NoReturn:
    """Become a child's parent, tell how it ended, and end it with who asked for it."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    child = os.fork()
    if child == 0:
        (_run if "program" in request else _work)(request, end)
    ended, poll = os.pidfd_open(child), select.poll()
    poll.register(ended, select.POLLIN)
    poll.register(end, 0)  # that the other end is closed is always told
    if not any(number == ended for number, _ in poll.poll()):
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with suppress(OSError):
        os.write(end, _NUMBER.pack(status))
    os._exit(0)


def _work(request: dict[str, Any], end: int) -> NoReturn:
    """What ``usdbrdf.job.child`` gives a fresh interpreter, and its main function."""
    try:
        said = Path(request["folder"], "said")
        _become(request, ["-c", request["folder"]], said, said)
        child, others = os.getpid(), os.getppid
        os.getppid = lambda: int(request["parent"]) if os.getpid() == child else others()
        os.write(end, _NUMBER.pack(os.getpid()))
        os.close(end)
        product.main()
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(1)


def _run(request: dict[str, Any], end: int) -> NoReturn:
    """What ``python -c`` does with a program."""
    status = 1
    try:
        streams = [Path(request["streams"], name) for name in _STREAMS]
        _become(request, ["-c", *request["arguments"]], *streams)
        os.write(end, _NUMBER.pack(os.getpid()))
        os.close(end)
        exec(compile(request["program"], "<string>", "exec"), {"__name__": "__main__"})
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _become(request: dict[str, Any], arguments: list[str], *streams: Path) -> None:
    """A process with a session, folder, environment, path and streams of its own."""
    os.setsid()
    os.chdir(request["folder"])
    opened = {path: os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666) for path in streams}
    for number, path in enumerate(streams, start=1):
        os.dup2(opened[path], number)
    for said in opened.values():
        os.close(said)
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[:], sys.argv = request["path"], arguments
    invalidate_caches()
    tempfile.tempdir = None
