"""Arrays that a task leaves in its asset for its own next run: derived, and lost without harm.

A file carries the hash of its bytes in its name, so that a damaged one is as good as none."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import publish, sha256_of, temporary_beside
from usdbrdf.files.documents import json_text, load_arrays, save_arrays
from usdbrdf.files.paths import inside
from usdbrdf.job.stamp import STATE_FOLDER
from usdbrdf.model.arrays import Array

_RECORD = "record"


def keep(asset: Path, name: str, record: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Put arrays and what tells whether they are of use in the place of those of the same name;
    a disk that does not take them is no reason to stop."""
    folder = asset / STATE_FOLDER / "cache"
    inside(asset, folder)
    text = np.frombuffer(json_text(dict(record)).encode(), np.uint8)
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with temporary_beside(folder / "arrays.npz") as staged:
            save_arrays(staged, {**arrays, _RECORD: text})
            path = folder / f"{name}.{sha256_of(staged)}.npz"
            publish(staged, path)
        for other in folder.glob(f"{name}.*.npz"):
            if other != path:
                other.unlink()


def kept(asset: Path, name: str) -> tuple[dict[str, Any], dict[str, Array]] | None:
    """Record and arrays as they were kept; None where there are none, or none intact."""
    for path in sorted((asset / STATE_FOLDER / "cache").glob(f"{name}.*.npz")):
        with suppress(OSError, InputRefused, KeyError, TypeError, ValueError):
            if sha256_of(path) == path.name.split(".")[-2]:
                arrays = load_arrays(path)
                return dict(json.loads(arrays.pop(_RECORD).tobytes())), arrays
    return None


def forget(asset: Path, prefix: str) -> None:
    """Delete all whose name begins so."""
    for path in (asset / STATE_FOLDER / "cache").glob(f"{prefix}*.npz"):
        with suppress(OSError):
            path.unlink()
