"""One process that reads damaged files, one after another, and notes what goes wrong.

An input is named by numbers, "17" or "17.203": the first chooses a seed and damages it, each other
damages it further. Inputs that reach new lines of a reader are the start of others.

What runs in children in the product runs here in the process itself, which is thrown away; the one
that started it sees when it crashes or hangs.
"""

from __future__ import annotations

import json
import os
import re
import resource
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

from tests.fuzzing.mutation import mutated
from tests.fuzzing.readers import OF_THE_FORM, Reader
from tests.fuzzing.seeds import Seed
from usdbrdf.errors import UsageError, UsdBrdfError
from usdbrdf.files.atomic import environment_failures
from usdbrdf.files.scratch import PREFIX
from usdbrdf.job.progress import set_quiet
from usdbrdf.untrusted import bounds

MEMORY_BYTES = 1 << 30  # that reading one input may take
# Of inputs that begin with one that reached new lines, and of those that are traced for lines.
_CONTINUED, _TRACED_ALL, _TRACED_EVERY = 0.5, 3000, 10
_SENTENCE = re.compile(r"[^\n\r\0]+: [^\n\r\0]+ \[[a-z0-9_]+\.[a-z0-9_]+\]")


# --- Inputs --------------------------------------------------------------------------------------


class Inputs:
    """The damaged files of one reader, in place of the sound ones of its seeds."""

    def __init__(self, reader: Reader, folder: Path) -> None:
        self.reader, self.seeds = reader, reader.seeds(folder)
        targets = {path for seed in self.seeds for path in seed.targets}
        self.sound = {path: path.read_bytes() for path in targets}
        self._changed: dict[Path, bytes] = {}

    def place(self, chain: Sequence[int]) -> Seed:
        """The files of an input, on disk; what the one before changed is sound again."""
        for path in self._changed:
            path.write_bytes(self.sound[path])
        self._changed = {}
        rng = self._rng(chain[0])
        seed = self.seeds[int(rng.integers(len(self.seeds)))]
        for i, number in enumerate(chain):
            rng = rng if i == 0 else self._rng(number)
            path = seed.targets[int(rng.integers(len(seed.targets)))]
            others = [c for p, c in self.sound.items() if p.suffix == path.suffix]
            content = self._changed.get(path, self.sound[path])
            self._changed[path] = mutated(path.name, content, rng, others)
        for path, content in self._changed.items():
            path.write_bytes(content)
        return seed

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.default_rng([zlib.crc32(self.reader.name.encode()), number])


# --- What is watched -----------------------------------------------------------------------------


class Watch:
    """What a process does to files, processes and the network while it reads."""

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] | None = None  # None: nobody looks. A hook stays for ever.
        self.seen: list[str] = []
        self._scratch = os.path.join(tempfile.gettempdir(), PREFIX)
        self._programs = tuple(
            {os.path.realpath(p) for p in (sys.prefix, sys.base_prefix, "/usr", "/proc", "/sys",
             "/etc/ld.so.cache", "/dev/null", Path(__file__).parents[2], *sys.path) if p}
        )  # fmt: skip
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.allowed is None:
            return
        if event == "open":
            path, _, flags = arguments
            if not isinstance(path, str | bytes | os.PathLike):
                return
            name = os.path.realpath(os.fsdecode(path))
            writes = bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC))
            mine = name.startswith((*self.allowed, self._scratch))
            if not mine and (writes or not name.startswith(self._programs)):
                self.seen.append(f"{'writes' if writes else 'opens'} {name!r}")
        elif event.startswith(("socket.", "subprocess.", "os.exec", "os.system", "os.fork",
                               "os.posix_spawn", "pickle.find_class")):  # fmt: skip
            self.seen.append(f"{event}{arguments!r}"[:200])
        elif event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link"):
            for name in arguments[:2]:
                # What is relative to an open folder is relative to one of ours.
                named = isinstance(name, str) and os.path.isabs(name)
                allowed = (*self.allowed, self._scratch)
                if named and not os.path.realpath(name).startswith(allowed):
                    self.seen.append(f"{event} {name!r}")

    @contextmanager
    def within(self, folder: Path) -> Iterator[list[str]]:
        """Whatever else than what lies in ``folder`` is touched meanwhile."""
        self.seen, self.allowed = [], (os.path.realpath(folder),)
        try:
            yield self.seen
        finally:
            self.allowed = None


class Lines:
    """Which lines of a reader's functions have run."""

    def __init__(self, parts: Iterable[str]) -> None:
        self.all: set[tuple[str, int]] = set()
        self.seen: set[tuple[str, int]] = set()
        for part in parts:
            module, _, names = part.partition(":")
            spec = find_spec(module)
            assert spec is not None
            assert spec.origin is not None
            code = compile(Path(spec.origin).read_text("utf-8"), spec.origin, "exec")
            for function in _functions(code):
                if not names or function.co_name in names.split(","):
                    self.all |= set(_lines_of(function))
        self._files = frozenset(file for file, _ in self.all)

    @contextmanager
    def traced(self) -> Iterator[None]:
        sys.settrace(self._calls)
        threading.settrace(self._calls)
        try:
            yield
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]

    def _calls(self, frame: FrameType, event: str, argument: object) -> Any:
        return self._steps if frame.f_code.co_filename in self._files else None

    def _steps(self, frame: FrameType, event: str, argument: object) -> Any:
        line = (frame.f_code.co_filename, frame.f_lineno)
        if line in self.all:
            self.seen.add(line)
        return self._steps


def _functions(code: CodeType) -> Iterator[CodeType]:
    """The functions of a module and of its classes; those inside of functions belong to them."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            if constant.co_flags & 0x0002:  # has locals of its own: a function, no class
                yield constant
            else:
                yield from _functions(constant)


def _lines_of(function: CodeType) -> Iterator[tuple[str, int]]:
    yield from (
        (function.co_filename, line)
        for _, _, line in function.co_lines()
        if line is not None and line != function.co_firstlineno
    )
    for constant in function.co_consts:
        if isinstance(constant, CodeType):
            yield from _lines_of(constant)


# --- What is wrong -------------------------------------------------------------------------------


def problem_of_error(error: BaseException) -> str:
    """Why an error is none that a user should meet, "" where it is a sentence of ours."""
    if not isinstance(error, UsdBrdfError) or type(error) is UsdBrdfError:
        return f"traceback: {type(error).__name__}: {error}"[:300]
    if "[environment.memory]" in str(error):
        return f"memory: {error}"[:300]
    if isinstance(error, UsageError) or error.exit_code != 3:
        return f"exit {error.exit_code}: {error}"[:300]
    if not _SENTENCE.fullmatch(str(error)):
        return f"no sentence: {str(error)!r}"[:600]
    return ""


def problem_of_value(value: object, unknown: frozenset[str], name: str = "") -> str:
    """Where a result holds NaN without a word, "" where it does not."""
    if name in unknown:
        return ""
    if isinstance(value, np.ndarray | float):
        found = np.asarray(value)
        holds = found.dtype.kind == "f" and bool(np.isnan(found).any())
        return f"NaN in {name or 'the result'}" if holds else ""
    parts: Iterable[tuple[str, object]] = ()
    if is_dataclass(value):
        parts = ((item.name, getattr(value, item.name)) for item in fields(value))
    elif isinstance(value, Mapping):
        parts = ((str(key), part) for key, part in value.items())
    elif isinstance(value, tuple | list):
        parts = ((name, part) for part in value)
    return next(filter(None, (problem_of_value(v, unknown, n) for n, v in parts)), "")


def run_in_this_process(
    function: str, arrays: Any, parameters: Any, timeout_s: float, label: str, **limits: Any
) -> dict[str, Any]:
    """In the place of ``run_child``, with the same translation of errors."""
    module, _, name = function.partition(":")
    with environment_failures(label):
        found: dict[str, Any] = getattr(import_module(module), name)(arrays, parameters)
    return found


@cache
def _watch() -> Watch:
    return Watch()


class Process:
    """Reads inputs of one reader: ``read`` gives what was wrong with one, "" if nothing was."""

    def __init__(self, reader: Reader, folder: Path) -> None:
        set_quiet(True)
        warnings.simplefilter("ignore")
        bounds.run_child = run_in_this_process
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        folder.mkdir(parents=True, exist_ok=True)
        self.reader, self.inputs = reader, Inputs(reader, folder / "seeds")
        self._home = folder
        self.watch, self.lines = _watch(), Lines(reader.lines)
        self.past_the_form = self.accepted = 0
        for seed in self.inputs.seeds:  # loads libraries, compiles kernels
            with self.lines.traced():
                problem = self._called(seed)
            assert not problem, f"{reader.name}: a sound file: {problem}"
        assert self.accepted == len(self.inputs.seeds), f"{reader.name}: a sound file is refused"
        self.past_the_form = self.accepted = 0
        own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (own + MEMORY_BYTES, most))

    def read(self, chain: Sequence[int], *, traced: bool = False) -> str:
        seed = self.inputs.place(chain)
        before = set(os.listdir(seed.entry if seed.entry.is_dir() else seed.entry.parent))
        with self.watch.within(self._home / "seeds") as touched:
            if traced:
                with self.lines.traced():
                    problem = self._called(seed)
            else:
                problem = self._called(seed)
        left = set(os.listdir(seed.entry if seed.entry.is_dir() else seed.entry.parent)) - before
        return problem or "; ".join(touched) or (f"left behind: {left}" if left else "")

    def _called(self, seed: Seed) -> str:
        try:
            with environment_failures("the reader"):
                value = self.reader.read(seed.entry)
        except BaseException as error:
            rule = str(error).rpartition("[")[2].rstrip("]")
            self.past_the_form += rule not in OF_THE_FORM and isinstance(error, UsdBrdfError)
            return problem_of_error(error)
        self.past_the_form += 1
        self.accepted += 1
        return problem_of_value(value, self.reader.unknown)


def campaign(
    reader: Reader, folder: Path, state: Path, first: int, last: int, seconds: float
) -> None:
    """Inputs ``first`` to ``last``, within a time; findings and chains that reached new lines are
    added to files in ``state``, and the chain at hand stands in ``state/now``."""
    (state / "now").write_text("")
    process = Process(reader, folder)
    pool: list[tuple[int, ...]] = [()]
    if (state / "pool").is_file():
        pool += [tuple(map(int, row.split("."))) for row in (state / "pool").read_text().split()]
        for chain in pool[1:]:
            _note(state, chain)
            process.read(chain, traced=True)
        process.past_the_form = process.accepted = 0
    rng = np.random.default_rng(first)
    done, slowest, until = 0, 0.0, time.monotonic() + seconds
    with (state / "found").open("a") as found, (state / "pool").open("a") as pooled:
        for number in range(first, last):
            if time.monotonic() > until:
                break
            parent = pool[int(rng.integers(len(pool)))] if rng.random() < _CONTINUED else ()
            chain = (*parent[:3], number)
            _note(state, chain)
            known, start = len(process.lines.seen), time.perf_counter()
            traced = done < _TRACED_ALL or number % _TRACED_EVERY == 0
            problem = process.read(chain, traced=traced)
            slowest = max(slowest, time.perf_counter() - start)
            done += 1
            name = ".".join(map(str, chain))
            if problem:
                found.write(json.dumps({"chain": name, "problem": problem}) + "\n")
                found.flush()
            if len(process.lines.seen) > known:
                pool.append(chain)
                pooled.write(name + "\n")
                pooled.flush()
            if done % 50 == 0:
                _store(state, process, done, slowest)
    _store(state, process, done, slowest)
    (state / "now").write_text("end")


def _note(state: Path, chain: Sequence[int]) -> None:
    """Into the file as it is: making a new one takes longer than reading many an input."""
    descriptor = os.open(state / "now", os.O_WRONLY)
    os.pwrite(descriptor, ".".join(map(str, chain)).ljust(80).encode(), 0)
    os.close(descriptor)


def _store(state: Path, process: Process, done: int, slowest: float) -> None:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    missed = sorted(f"{Path(f).name}:{n}" for f, n in process.lines.all - process.lines.seen)
    figures = {
        "inputs": done, "past": process.past_the_form, "accepted": process.accepted,
        "lines": len(process.lines.all), "missed": missed, "slowest": slowest, "peak": peak,
    }  # fmt: skip
    temporary = state / f"figures-{os.getpid()}.tmp"
    temporary.write_text(json.dumps(figures))
    temporary.rename(state / f"figures-{os.getpid()}.json")
