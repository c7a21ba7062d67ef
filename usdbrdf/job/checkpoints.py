"""Finished pieces of an unfinished task, each a file that carries its own hash in its name."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from urllib.parse import quote, unquote

from usdbrdf.errors import InputRefused
from usdbrdf.files.arrays import load_arrays, save_arrays
from usdbrdf.files.atomic import publish, sha256_of, temporary_beside
from usdbrdf.model.arrays import Array

_NAME = re.compile(r"(?P<key>[^@]*)(?:@(?P<index>\d{9}))?\.(?P<sha256>[0-9a-f]{64})\.npz")
# Seconds between saved states of a running computation, and how many times as long as saving one
# takes: what a kill can cost, and what saving may.
_SAVE_AFTER, _SAVE_SELDOM = 2.0, 30


class Checkpoints:
    """Named sets of arrays in one folder, for a later run of the same task; a damaged one is as
    good as none. Of the numbered states of one running computation only the newest is kept."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._files: dict[tuple[str, int | None], Path] = {}
        # When a running computation's state was saved last, and how long that took: the first is
        # saved at once, which tells.
        self._saved = -math.inf, 0.0
        for path in folder.iterdir():
            match = _NAME.fullmatch(path.name)
            if match is None:
                path.unlink()  # what a killed process was writing
                continue
            index = match["index"]
            self._files[unquote(match["key"]), int(index) if index else None] = path

    def checkpoint(self, key: str, compute: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
        """The arrays of ``compute``, from an earlier run of the same task if it got that far."""
        stored = self.checkpoint_if(key)
        if stored is not None:
            return stored
        arrays = dict(compute())
        self.save(key, arrays)
        return arrays

    def checkpoint_if(self, key: str, index: int | None = None) -> dict[str, Array] | None:
        """The arrays saved under ``key`` by this or an interrupted run, bit for bit, or None."""
        path = self._files.get((key, index))
        if path is None:
            return None
        try:
            if sha256_of(path) == path.name.split(".")[-2]:
                return load_arrays(path)
        except (OSError, InputRefused):
            pass
        self._drop(key, index)
        return None

    def save(self, key: str, arrays: Mapping[str, Array], index: int | None = None) -> None:
        """Store arrays; the file is there under its final name only once it is complete."""
        stem = quote(key, safe="") + (f"@{index:09d}" if index is not None else "")
        with temporary_beside(self._folder / "arrays.npz") as staged:
            save_arrays(staged, arrays)
            path = self._folder / f"{stem}.{sha256_of(staged)}.npz"
            publish(staged, path)
        if self._files.get((key, index), path) != path:
            self._drop(key, index)
        self._files[key, index] = path

    def latest(self, prefix: str) -> tuple[int, dict[str, Array]] | None:
        """Index and arrays of the newest intact state that ``save_latest`` stored, or None."""
        for index in self._indices(prefix):
            arrays = self.checkpoint_if(prefix, index)
            if arrays is not None:
                return index, arrays
        return None

    def save_latest(self, prefix: str, index: int, arrays: Mapping[str, Array]) -> None:
        """Store the state of a running computation after step ``index``; older ones are deleted."""
        self.save(prefix, arrays, index)
        for other in self._indices(prefix):
            if other != index:
                self._drop(prefix, other)

    def save_latest_in_time(
        self, prefix: str, index: int, arrays: Callable[[], Mapping[str, Array]]
    ) -> None:
        """``save_latest``, but not so often that it costs more than a few per cent of the time."""
        last, took = self._saved
        start = time.monotonic()
        if start - last >= max(_SAVE_AFTER, _SAVE_SELDOM * took):
            self.save_latest(prefix, index, arrays())
            end = time.monotonic()
            self._saved = end, end - start

    def _drop(self, key: str, index: int | None) -> None:
        self._files.pop((key, index)).unlink(missing_ok=True)

    def _indices(self, key: str) -> list[int]:
        """The numbered states of ``key``, newest first."""
        return sorted((i for k, i in self._files if k == key and i is not None), reverse=True)
