"""Compiled functions: numba's decorators with the project's settings and with types kept; where
their code is kept between processes, and when it is valid.

Never ``fastmath``: under it ``np.isnan`` is False, and sums depend on the machine.

A kernel's file lies in a folder named after its module and the identity of its code, so that an
edit of anything the kernel was compiled from leads to another folder. Its content is sealed by a
hash. A cache never fails a run: what cannot be read is compiled, what cannot be written is not
kept."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import inspect
import itertools
import logging
import os
import pickle
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Concatenate, ParamSpec, TypeVar

import llvmlite
import numba
from numba.core.caching import Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from usdbrdf.identity import PACKAGE, kernels_identity

# So many states of a module's code keep their kernels: several checkouts, some edits of each.
_STATES_KEPT = 16
_SEAL = hashlib.sha256().digest_size
# Seconds for which a kernel that another process compiles is waited for.
_LONGEST_WAIT = 60.0


class KernelCache(Cache):  # type: ignore[misc]
    """numba's cache of one function, with the package's own places and seals. numba gives the key
    of a specialisation (types, processor, bytecode, closure), the reduced code and its way back."""

    def __init__(self, function: Any) -> None:
        self._py_func = function
        self._source = Path(inspect.getfile(function)).resolve()
        # Read now, while the module is imported: an edit made while the program runs is not in it.
        self._identity = kernels_identity(self._source)
        self._turn: BinaryIO | None = None
        self.enable()

    @property
    def cache_path(self) -> str | None:
        folder = _folder(self._source, self._identity)
        return str(folder) if folder else None

    def flush(self) -> None:
        """Nothing is stale that could be found: another state of the code has another folder."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled specialisation, or None where it has to be compiled."""
        target_context.refresh()
        key = self._index_key(sig, target_context.codegen())
        file = self._file(key) if self._enabled else None
        found = _unsealed(file) if file else None
        if file and found is None:
            self._end_turn()
            if _told is not None:
                _told()
            self._turn = _turn_to_compile(file)
            found = _unsealed(file)  # another process may have compiled it meanwhile
        if found is None or found[0] != key:
            return None
        self._end_turn()
        return CompileResult._rebuild(target_context, *found[1])

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a specialisation for other processes, if there is a place."""
        key = self._index_key(sig, data.codegen)
        file = self._file(key) if self._enabled else None
        if file is None:
            return
        if data.lifted or data.library.has_dynamic_globals:
            raise TypeError(f"{self._py_func.__qualname__} freezes what no other process can use.")
        content = dumps((key, data._reduce()))
        temporary = file.with_suffix(f".{os.getpid()}")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(hashlib.sha256(content).digest() + content)
            temporary.replace(file)
        except OSError as error:
            _say_once(f"compiled kernels are not kept ({error}), each run compiles them anew")
            with contextlib.suppress(OSError):
                temporary.unlink()
        finally:
            self._end_turn()

    def _file(self, key: tuple[Any, ...]) -> Path | None:
        folder = _folder(self._source, self._identity)
        digest = hashlib.sha256(str(key).encode()).hexdigest()[:16]
        return folder / f"{self._py_func.__qualname__}-{digest}.nbc" if folder else None

    def _end_turn(self) -> None:
        if self._turn is not None:
            with contextlib.suppress(OSError):
                Path(self._turn.name).unlink()
            self._turn.close()
            self._turn = None


def _unsealed(file: Path) -> Any:
    """A file's key and reduced code, or None where it is not there or not whole."""
    try:
        sealed = file.read_bytes()
    except OSError:
        return None
    seal, content = sealed[:_SEAL], sealed[_SEAL:]
    return pickle.loads(content) if hashlib.sha256(content).digest() == seal else None


def _turn_to_compile(file: Path) -> BinaryIO | None:
    """A lock on what a file is to hold: two processes that start together share the work. Whoever
    waits for too long, or has no locks, compiles it too."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        lock = file.with_suffix(".lock").open("wb")
    except OSError:
        return None
    end = time.monotonic() + _LONGEST_WAIT
    while time.monotonic() < end and not file.exists():
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return lock
        except BlockingIOError:
            time.sleep(0.02)
        except OSError:
            break
    with contextlib.suppress(OSError):
        Path(lock.name).unlink()
    lock.close()
    return None


_told: Callable[[], object] | None = None


@contextlib.contextmanager
def when_compiling(told: Callable[[], object]) -> Iterator[None]:
    """In here ``told`` is called whenever a kernel has to be compiled that could have been kept."""
    global _told
    before, _told = _told, told
    try:
        yield
    finally:
        _told = before


def mark_of_compiled(identity: str) -> Path | None:
    """The file that is there once all that the pipeline needs was compiled from one state of the
    sources; None where nothing is kept."""
    folder = None if numba.config.DISABLE_JIT else _folder(PACKAGE / "warm_up.py", identity)
    return folder / "done" if folder else None


@cache
def _folder(source: Path, identity: str) -> Path | None:
    """The folder for the kernels of one state of a source file, marked as in use."""
    root = _root()
    if root is None:
        return None
    place = source.relative_to(PACKAGE) if source.is_relative_to(PACKAGE) else Path(source.name)
    module = ".".join(place.with_suffix("").parts)
    python = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"
    made_by = f"{python} {numba.__version__} {llvmlite.__version__} {identity}"
    folder = root / f"{module}-{hashlib.sha256(made_by.encode()).hexdigest()[:16]}"
    with contextlib.suppress(OSError):
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            states = [p for p in root.glob(f"{module}-*") if p.name.rpartition("-")[0] == module]
            for path in sorted(states, key=lambda path: path.stat().st_mtime)[:-_STATES_KEPT]:
                shutil.rmtree(path, ignore_errors=True)
        os.utime(folder)
    return folder


@cache
def _root() -> Path | None:
    """Where kernels are kept: ``NUMBA_CACHE_DIR``, the user's cache, or a temporary folder. Code is
    run from there, so it must be ours and nobody else's, unless the user named the place."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen) / "usdbrdf"
    with contextlib.suppress(OSError, RuntimeError):  # no home at all is a RuntimeError
        usual = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
        cache_folder = Path(usual) if usual else Path.home() / ".cache"
        if _is_private(root := cache_folder / "usdbrdf" / "kernels"):
            return root
    with contextlib.suppress(OSError):
        user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
        if _is_private(root := Path(tempfile.gettempdir()) / f"usdbrdf-kernels-{user}"):
            _say_once(
                f"compiled kernels are kept in {root}, since the user's cache cannot be written; "
                "NUMBA_CACHE_DIR names another place"
            )
            return root
    _say_once(
        "compiled kernels are not kept, since neither the user's cache nor a temporary folder can "
        "be written; NUMBA_CACHE_DIR names another place"
    )
    return None


def _is_private(folder: Path) -> bool:
    """Make the folder, if need be; True if it is ours, writable, and for nobody else to write."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.lstat()
    ours = not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o022 and not folder.is_symlink()
    )
    return ours and os.access(folder, os.W_OK | os.X_OK)


@cache
def _say_once(sentence: str) -> None:
    logging.getLogger("usdbrdf").warning("usdbrdf: %s", sentence)


P = ParamSpec("P")
F = TypeVar("F", bound=Callable[..., Any])
# Each thread gets so many parts, in turn: some take longer than others.
_PARTS_PER_THREAD = 4


def kernel(function: F) -> F:
    """Compile for one thread; may be called from other kernels."""
    return _compiled(function)


def parallel_kernel(
    function: Callable[Concatenate[int, int, P], None],
) -> Callable[Concatenate[int, P], None]:
    """Compile as ``loop`` does what works on the rows ``first`` to ``last`` - 1, its first two
    arguments; it is called with the number of all rows, of which threads take parts. Every row
    writes to places of its own, so that the result does not depend on the number of threads.

    numba's own ``parallel`` compiles several times as long, and its pool of threads, where it is
    the only one on a machine, ends the process when two threads of Python call it."""
    compiled: Any = loop(function)

    @functools.wraps(function)
    def in_parts(count: int, /, *arguments: P.args, **named: P.kwargs) -> None:
        parts = min(count, _PARTS_PER_THREAD * num_threads())
        turns = itertools.count()

        def work() -> None:
            while (part := next(turns)) < parts:
                first, last = part * count // parts, (part + 1) * count // parts
                compiled(first, last, *arguments, **named)

        # Whoever calls works too: to wake one thread less is what small kernels feel.
        others = [_pool().submit(work) for _ in range(min(parts, num_threads()) - 1)]
        try:
            work()
        finally:
            # Those that have not begun find nothing left; none may go on writing after this.
            wait([other for other in others if not other.cancel()])
        for other in others:
            if not other.cancelled():
                other.result()

    return in_parts


def num_threads() -> int:
    """Of those that kernels run in: the processor's cores, or ``NUMBA_NUM_THREADS``."""
    return int(numba.config.NUMBA_NUM_THREADS)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads(), thread_name_prefix="kernels")


def loop(function: F) -> F:
    """Compile for one thread, without Python's lock. Divisions by 0 give infinities instead of
    exceptions: the test for them would keep a loop from using vector instructions."""
    return _compiled(function, nogil=True, error_model="numpy")


def _compiled(function: F, **options: Any) -> F:
    # No kernel is called through a pointer from C, and each such entry is code to compile.
    compiled: Any = numba.njit(no_cfunc_wrapper=True, **options)(function)
    if not numba.config.DISABLE_JIT:
        compiled._cache = KernelCache(function)
    result: F = compiled
    return result
