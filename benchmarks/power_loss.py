"""What a disk may hold after the power failed: what was flushed, and of the rest any part.

Names and contents are kept apart, as POSIX does. Flushing a file (fsync) keeps its bytes and says
nothing of its name; flushing a folder keeps every change of names in it until then. Each change is
there whole or not at all, as journals of file systems make it; changes that were not flushed come
in any choice, and unflushed bytes as they were, as they are, cut, or as zeros.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from system_calls import Call

# Which unflushed changes of names are there, and whether unflushed bytes are.
Loss = Literal["all that was not flushed", "bytes", "some"]
LOSSES: tuple[Loss, ...] = ("all that was not flushed", "bytes", "some")
WATCHED = ("write", "sync", "rename", "unlink", "mkdir", "open")

Names = dict[str, int]  # of a folder: name -> number of what has it


@dataclass
class _Change:
    """The file or folder ``thing`` leaves ``source`` and comes to ``place``; each is a folder and
    a name, or None."""

    thing: int
    source: tuple[int, str] | None
    place: tuple[int, str] | None
    flushed: bool = False


class Disk:
    """The files below a folder, which are safe to begin with, as calls change and flush them."""

    def __init__(self, root: Path) -> None:
        self._root = Path(os.path.realpath(root))
        self._numbers = itertools.count(1)
        self._folders: dict[int, Names] = {0: {}}
        self._safe: dict[int, bytes] = {}
        self._changes: list[_Change] = []
        for folder, inner, files in os.walk(self._root):
            names = self._folders[self._number(Path(folder))]
            for name in (*inner, *files):
                names[name] = next(self._numbers)
                if name in inner:
                    self._folders[names[name]] = {}
                else:
                    self._safe[names[name]] = (Path(folder) / name).read_bytes()
        self._first = {number: dict(names) for number, names in self._folders.items()}

    def see(self, call: Call) -> None:
        """A call that is about to happen; one that will fail changes nothing."""
        if call.kind == "sync":
            self._flush(call)
        elif call.kind in ("create", "mkdir") and _can_be_made(call.path):
            number = next(self._numbers)
            if call.kind == "mkdir":
                self._folders[number], self._first[number] = {}, {}
            self._change(number, None, self._place(call.path))
        elif call.kind == "unlink" and os.path.lexists(call.path):
            self._change(self._number(call.path), self._place(call.path), None)
        elif call.kind == "rename" and os.path.lexists(call.path) and call.target:
            number = self._number(call.path)
            self._change(number, self._place(call.path), self._place(call.target))

    def after(self, place: Path, loss: Loss, rng: np.random.Generator) -> None:
        """Write what may be there if the power fails now, into a new folder."""
        names = {number: dict(held) for number, held in self._first.items()}
        for change in self._changes:
            if change.flushed or loss == "bytes" or (loss == "some" and rng.random() < 0.5):
                _apply(change, names)
        now = {self._number(path): path for path in self._files()}
        pending = [(0, place)]
        while pending:
            folder, path = pending.pop()
            path.mkdir()
            for name, number in names[folder].items():
                if number in names:
                    pending.append((number, path / name))
                else:
                    (path / name).write_bytes(self._bytes(number, now.get(number), loss, rng))

    def _bytes(self, number: int, path: Path | None, loss: Loss, rng: np.random.Generator) -> bytes:
        safe = self._safe.get(number, b"")
        present = path.read_bytes() if path else safe
        if present == safe or loss != "some":
            return safe
        cut = present[: rng.integers(len(present) + 1)]
        return (safe, present, cut, bytes(len(present)))[rng.integers(4)]

    def _flush(self, call: Call) -> None:
        number = self._number(call.path)
        if number not in self._folders:
            self._safe[number] = Path(f"/proc/{call.thread}/fd/{call.descriptor}").read_bytes()
            return
        for change in self._changes:
            if number in {end[0] for end in (change.source, change.place) if end}:
                change.flushed = True

    def _change(
        self, number: int, source: tuple[int, str] | None, place: tuple[int, str] | None
    ) -> None:
        change = _Change(number, source, place)
        self._changes.append(change)
        _apply(change, self._folders)

    def _place(self, path: Path) -> tuple[int, str]:
        return self._number(path.parent), path.name

    def _number(self, path: Path) -> int:
        number = 0
        for name in Path(os.path.realpath(path.parent), path.name).relative_to(self._root).parts:
            number = self._folders[number][name]
        return number

    def _files(self) -> Iterator[Path]:
        return (path for path in self._root.rglob("*") if path.is_file())


def _can_be_made(path: Path) -> bool:
    return path.parent.is_dir() and not os.path.lexists(path)


def _apply(change: _Change, folders: dict[int, Names]) -> None:
    if change.source is not None:
        folder, name = change.source
        if folders[folder].get(name) == change.thing:
            del folders[folder][name]
    if change.place is not None:
        folder, name = change.place
        folders[folder][name] = change.thing
