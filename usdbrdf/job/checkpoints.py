"""Finished pieces of an unfinished task, each a file that carries its own hash in its name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote, unquote

from usdbrdf.errors import InputRefused
from usdbrdf.files.arrays import load_arrays, save_arrays
from usdbrdf.files.atomic import publish, sha256_of, temporary_beside
from usdbrdf.model.arrays import Array

_NAME = re.compile(r"(?P<key>[^@]*)(?:@(?P<index>\d{9}))?\.(?P<sha256>[0-9a-f]{64})\.npz")


class Checkpoints:
    """Named sets of arrays in one folder; a damaged one is as good as none.

    ``index`` numbers the states of one running computation, of which only the newest is kept.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._files: dict[tuple[str, int | None], Path] = {}
        for path in folder.iterdir():
            match = _NAME.fullmatch(path.name)
            if match is None:
                path.unlink()  # what a killed process was writing
                continue
            index = match["index"]
            self._files[unquote(match["key"]), int(index) if index else None] = path

    def load(self, key: str, index: int | None = None) -> dict[str, Array] | None:
        """The arrays stored under ``key``, bit for bit, or None."""
        path = self._files.get((key, index))
        if path is None:
            return None
        try:
            if sha256_of(path) == path.name.split(".")[-2]:
                return load_arrays(path)
        except (OSError, InputRefused):
            pass
        self.drop(key, index)
        return None

    def save(self, key: str, arrays: Mapping[str, Array], index: int | None = None) -> None:
        """Store arrays; the file is there under its final name only once it is complete."""
        stem = quote(key, safe="") + (f"@{index:09d}" if index is not None else "")
        with temporary_beside(self._folder / "arrays.npz") as staged:
            save_arrays(staged, arrays)
            path = self._folder / f"{stem}.{sha256_of(staged)}.npz"
            publish(staged, path)
        if self._files.get((key, index), path) != path:
            self.drop(key, index)
        self._files[key, index] = path

    def drop(self, key: str, index: int | None = None) -> None:
        """Forget a checkpoint and delete its file."""
        self._files.pop((key, index)).unlink(missing_ok=True)

    def indices(self, key: str) -> list[int]:
        """The numbered states of ``key``, newest first."""
        return sorted((i for k, i in self._files if k == key and i is not None), reverse=True)
