"""How many small mistakes do the tests of a room find? Some lines of it are changed, one at a time.

    python benchmarks/mutation_score.py [--mutations 200] [--seed 0] [--rooms files job ...]
        [--minutes 60] [--work DIR] [--json FILE] [--only NAME ...]

Mutations are drawn at random, all places in all rooms alike: another operator or comparison, a
number that is not the same, a condition turned round, a statement left out. Each is put into a copy
of the repository, where the tests of its own room run until one fails: first those of a file named
as the module, then those that name it, then the rest. One that no test notices survives; what
hangs or does not import any more does not; where the tests could not be run, or the machine ended
them, nothing was found out. Before the first mutation of a room its tests have to pass as it is.
With `--json` a run that was stopped goes on where it was; what it tried beside what is drawn now
does not count.

Why not mutmut or cosmic-ray: mutmut puts all versions of a function behind a switch that numba
cannot compile; cosmic-ray works in place, for one command. Kernels lie in a cache of their own,
under the hash of the sources that they are made of (`usdbrdf/kernel.py`), so that no mutant finds
those of another, and only what a mutation reaches is compiled.
"""

from __future__ import annotations

import argparse
import ast
import copy
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
# Room -> folders of its tests.
ROOMS = {
    "transport": ("tests/transport", "tests/physics"),
    "texturing": ("tests/texturing",),
    "shading": ("tests/shading",),
    "material": ("tests/material",),
    "files": ("tests/files",),
    "job": ("tests/job",),
}
# Exit codes of pytest: all passed; a test failed; a module's import did. Others say that there were
# no tests, that pytest could not run them, or that a signal ended it.
SURVIVED, FOUND = 0, (1, 2, "hangs")
# Of a mutant's tests: those that take longer of the processor, in one process, hang; those that do
# of the clock, which runs on where others need the machine, tell nothing and do not count.
PROCESSOR_SECONDS, CLOCK_SECONDS = 600, 7200

_BINARY: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Add,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
}  # fmt: skip
_COMPARE: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_CALLED = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "sin": "cos",
    "cos": "sin", "any": "all", "all": "any", "ceil": "floor", "floor": "ceil",
}  # fmt: skip


@dataclass(frozen=True)
class Mutation:
    """A place in a file of the package and what stands there instead: ``before`` becomes ``after``
    at ``start``, in characters."""

    file: str
    line: int
    column: int
    kind: str
    start: int
    before: str
    after: str

    @property
    def name(self) -> str:
        return f"{self.file}:{self.line}:{self.column}+{len(self.before)}:{self.kind}"

    @property
    def room(self) -> str:
        return Path(self.file).parts[1]

    def applied(self, source: str) -> str:
        end = self.start + len(self.before)
        assert source[self.start : end] == self.before, self.name
        return source[: self.start] + self.after + source[end:]


def mutations_of(file: str, source: str) -> Iterator[Mutation]:
    """All mutations of a module. Words are left alone: docstrings, messages, annotations,
    decorators and imports."""
    tree = ast.parse(source)
    lines = [0]
    for line in source.splitlines(keepends=True):
        lines.append(lines[-1] + len(line))

    def place(line: int, column: int) -> int:
        text = source[lines[line - 1] : lines[line] if line < len(lines) else None]
        return lines[line - 1] + len(text.encode()[:column].decode())

    def instead(node: ast.expr | ast.stmt, kind: str, after: str) -> Mutation:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = place(node.lineno, node.col_offset)
        before = source[start : place(node.end_lineno, node.end_col_offset)]
        return Mutation(file, node.lineno, node.col_offset, kind, start, before, after)

    for node in _told(tree):
        for kind, changed in _changes(node):
            text = ast.unparse(ast.fix_missing_locations(changed))
            after = text if isinstance(changed, ast.stmt) else f"({text})"
            assert isinstance(node, ast.expr | ast.stmt)
            yield instead(node, kind, after)


def _told(tree: ast.AST) -> Iterator[ast.AST]:
    """Every node but those that nothing is computed by."""
    pending = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Raise):
            continue
        yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            parts = value if isinstance(value, list) else [value]
            pending += [part for part in parts if isinstance(part, ast.AST)]


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.expr | ast.stmt]]:
    """What may stand in the place of a node, each with a word for it."""
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _BINARY:
        yield "operator", _with(node, op=_BINARY[type(node.op)]())
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in _COMPARE:
        yield "comparison", _with(node, ops=[_COMPARE[type(node.ops[0])](), *node.ops[1:]])
        if isinstance(node.ops[0], ast.Lt | ast.LtE | ast.Gt | ast.GtE) and len(node.ops) == 1:
            yield "turned", ast.UnaryOp(ast.Not(), node)
    elif isinstance(node, ast.BoolOp):
        other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield "logic", _with(node, op=other)
    elif isinstance(node, ast.UnaryOp):
        yield "unary", node.operand
    elif isinstance(node, ast.Constant):
        value = node.value
        if isinstance(value, bool):
            yield "constant", _with(node, value=not value)
        elif isinstance(value, int):
            yield "constant", _with(node, value=value + 1)
        elif isinstance(value, float):
            yield "constant", _with(node, value=2 * value if value else 1.0)
    elif isinstance(node, ast.Call):
        called = node.func
        if isinstance(called, ast.Name) and called.id in _CALLED:
            yield "function", _with(node, func=ast.Name(_CALLED[called.id], ast.Load()))
        elif isinstance(called, ast.Attribute) and called.attr in _CALLED:
            yield "function", _with(node, func=_with(called, attr=_CALLED[called.attr]))
    elif isinstance(node, ast.Break | ast.Continue) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    ):
        yield "left out", ast.Pass()


def _with(node: ast.AST, **changed: object) -> ast.expr:
    made = copy.copy(node)
    for name, value in changed.items():
        setattr(made, name, value)
    return made  # type: ignore[return-value]


def all_mutations(root: Path, rooms: Sequence[str]) -> list[Mutation]:
    found: list[Mutation] = []
    for room in rooms:
        for path in sorted((root / "usdbrdf" / room).rglob("*.py")):
            source = path.read_text("utf-8")
            found += mutations_of(path.relative_to(root).as_posix(), source)
    return found


def tests_for(root: Path, mutation: Mutation) -> list[str]:
    """Files of tests of the mutation's room, those first that are about its module."""
    module = Path(mutation.file).stem
    files = [
        f for folder in ROOMS[mutation.room] for f in sorted((root / folder).glob("test_*.py"))
    ]

    def distance(file: Path) -> int:
        if file.stem == f"test_{module}":
            return 0
        return 1 if module in file.read_text("utf-8") else 2

    return [file.relative_to(root).as_posix() for file in sorted(files, key=distance)]


class Copy:
    """The repository, where mutations are tried one after another, and its kernels."""

    def __init__(self, folder: Path) -> None:
        self.root, self.kernels = folder / "repository", folder / "kernels"
        kept = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True
        ).stdout.split(b"\0")  # fmt: skip
        for name in filter(None, map(os.fsdecode, kept)):
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, self.root / name)
        self.kernels.mkdir()

    def tested(self, files: Sequence[str]) -> tuple[int | str, str]:
        """How the tests in these files end, one file after the other, and what the first that
        fails says last."""
        environment = {
            **os.environ, "PYTHONPATH": str(self.root), "NUMBA_CACHE_DIR": str(self.kernels),
            "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "--no-header", "--tb=no",
             "-p", "no:cacheprovider", *files],
            cwd=self.root, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True,
            preexec_fn=_limit,
        )  # fmt: skip
        try:
            said, _ = process.communicate(timeout=CLOCK_SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return "undecided", ""
        if process.returncode == -signal.SIGXCPU:
            return "hangs", ""
        failed = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return process.returncode, (failed or said.splitlines() or [""])[-1][:200]

    def refuse_failing(self, room: str) -> None:
        """As its tests fail already, every mutation of the room would be found."""
        files = sorted(f for folder in ROOMS[room] for f in (self.root / folder).glob("test_*.py"))
        status, said = self.tested([file.relative_to(self.root).as_posix() for file in files])
        if status != SURVIVED:
            raise SystemExit(f"{room}: without any mutation its tests end with {status}: {said}")

    def tried(self, mutation: Mutation) -> dict[str, object]:
        path = self.root / mutation.file
        source, known = path.read_text("utf-8"), set(self.kernels.rglob("*"))
        began = time.monotonic()
        path.write_text(mutation.applied(source), "utf-8")
        try:
            status, said = self.tested(tests_for(self.root, mutation))
        finally:
            path.write_text(source, "utf-8")
        for made in sorted(set(self.kernels.rglob("*")) - known, reverse=True):
            if made.is_file():
                made.unlink()
        return {
            "mutation": mutation.name, "before": mutation.before, "after": mutation.after,
            "found": status in FOUND, "status": status, "said": said,
            "seconds": round(time.monotonic() - began, 1),
        }  # fmt: skip


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_SECONDS, PROCESSOR_SECONDS + 10))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--mutations", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("--minutes", type=float, default=1e9, help="no new one after these")
    parser.add_argument("--only", nargs="+", help="these alone, by their names")
    parser.add_argument("--work", type=Path, help="folder for the copy; default: a temporary one")
    parser.add_argument("--json", type=Path, help="add each result to this file, one a line")
    chosen = parser.parse_args(arguments)
    every = all_mutations(ROOT, chosen.rooms)
    order = np.random.default_rng(chosen.seed).permutation(len(every))
    drawn = [every[i] for i in order[: chosen.mutations]]
    if chosen.only:
        drawn = [one for one in every if one.name in chosen.only]
    results = []
    if chosen.json and chosen.json.is_file() and not chosen.only:
        results = counted(chosen.json.read_text(), drawn)
    done, passing = {result["mutation"] for result in results}, set[str]()
    end = time.monotonic() + 60 * chosen.minutes
    with tempfile.TemporaryDirectory(prefix="mutations-", dir=chosen.work) as folder:
        place = Copy(Path(folder))
        for mutation in drawn:
            if mutation.name in done or time.monotonic() > end:
                continue
            if mutation.room not in passing:
                place.refuse_failing(mutation.room)
                passing.add(mutation.room)
            result = place.tried(mutation)
            if not is_decided(result):
                print(f"undecided, {result['status']}: {mutation.name}: {result['said']}")
                continue
            results.append(result)
            word = "found" if result["found"] else "SURVIVED"
            change = f"{mutation.before!r} -> {mutation.after!r}"
            said = result["said"] if result["found"] else ""
            print(f"{word} in {result['seconds']} s: {mutation.name}: {change} {said}", flush=True)
            if chosen.json:
                with chosen.json.open("a") as file:
                    file.write(json.dumps(result) + "\n")
    return told(results, len(every))


def counted(lines: str, drawn: Sequence[Mutation]) -> list[dict[str, object]]:
    """What an earlier run found out, of what is drawn now."""
    names = {mutation.name for mutation in drawn}
    results = map(json.loads, lines.splitlines())
    return [each for each in results if each["mutation"] in names and is_decided(each)]


def is_decided(result: Mapping[str, object]) -> bool:
    return result["status"] == SURVIVED or result["status"] in FOUND


def told(results: Sequence[dict[str, object]], places: int) -> int:
    print(f"{places} mutations are possible")
    tried, found = Counter[str](), Counter[str]()
    for result in results:
        room = Path(str(result["mutation"])).parts[1]
        for key in (room, "all"):
            tried[key] += 1
            found[key] += bool(result["found"])
    for key in tried:
        print(f"{key:<10} {found[key]:>4} of {tried[key]:>4} found, {found[key] / tried[key]:.0%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
