"""Which sources the code is made of: their hashes tell what has gone stale.

Two things outlive a process and depend on the code: compiled kernels and finished tasks. A kernel
freezes what its module imports, so its identity covers exactly the modules that are reached from
its own by import statements. Tasks also reach code by name (adapters, child processes), so theirs
covers the whole package but for the rooms that only read finished assets. Data beside a module
under the module's name, such as ``calibration.json``, is part of that module.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
_DATA = (".json", ".toml")
# What these say or do never enters a layer or texture of an asset.
_OUTSIDE_TASKS = {
    *("advice", "delivery", "evaluation", "farm", "page", "paper", "relighting", "validation"),
    *("cli.py", "farm_commands.py", "__main__.py"),
}
# Not the package's own code, but what a wheel carries along.
_CARRIED = {"plugins", "schemas"}
_IMPORTS = re.compile(
    rb"^[ \t]*(?:from[ \t]+(usdbrdf[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)"
    rb"|import[ \t]+(usdbrdf[^\n]*))",
    re.MULTILINE,
)


@cache
def tasks_identity() -> str:
    """16 hexadecimal digits that change with any source or datum that a task may depend on."""
    return _digest(
        name
        for name, file in _sources().items()
        if file.relative_to(PACKAGE).parts[0] not in _OUTSIDE_TASKS
    )


@cache
def kernels_identity(source: Path) -> str:
    """The same for the compiled kernels of one file: they change with it and with all that it
    imports, directly or not. A file outside of the package (a benchmark, a plug-in) counts with
    the files beside it and the whole package, since what it imports is not followed."""
    module = _module_name(source) if source.is_relative_to(PACKAGE) else None
    if module in _sources():
        reached, waiting = {module}, [module]
        while waiting:
            new = _imported(waiting.pop()) - reached
            reached |= new
            waiting.extend(new)
        return _digest(reached)
    beside = b"".join(file.read_bytes() for file in sorted(source.parent.glob("*.py")))
    return hashlib.sha256(beside + _digest(_sources()).encode()).hexdigest()[:16]


@cache
def _sources() -> dict[str, Path]:
    """Dotted names of all modules -> their files."""
    files = sorted(PACKAGE.rglob("*.py"))
    ours = (file for file in files if file.relative_to(PACKAGE).parts[0] not in _CARRIED)
    return {_module_name(file): file for file in ours}


def _module_name(file: Path) -> str:
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def _content(name: str) -> bytes:
    return _sources()[name].read_bytes()


def _digest(names: Iterable[str]) -> str:
    whole = hashlib.sha256()
    for name in sorted(names):
        file = _sources()[name]
        data = [file.with_suffix(ending) for ending in _DATA]
        for content in (_content(name), *(d.read_bytes() for d in data if d.is_file())):
            whole.update(f"{name} {len(content)}\n".encode())
            whole.update(content)
    return whole.hexdigest()[:16]


@cache
def _imported(module: str) -> frozenset[str]:
    """The package's modules that a module's import statements name, with the ``__init__`` files on
    the way there; the package's own ``__init__``, its public face, defines nothing."""
    named: set[str] = set()
    for parent, names, plain in _IMPORTS.findall(_content(module)):
        named.update(re.findall(r"usdbrdf[\w.]*", plain.decode()))
        if parent:
            named.add(parent.decode())
            named.update(f"{parent.decode()}.{n}" for n in re.findall(r"\w+", names.decode()))
    above = {name.rsplit(".", depth)[0] for name in named for depth in range(1, name.count("."))}
    return frozenset((named | above) & _sources().keys() - {"usdbrdf"})
