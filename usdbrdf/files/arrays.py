"""Named arrays in one file: an uncompressed .npz without pickles and with fixed bytes."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Array


def save_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays; object arrays raise ValueError. (np.savez would not take the key "file".)"""
    with path.open("wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for key, array in arrays.items():
            member = zipfile.ZipInfo(f"{key}.npy")  # its date is 1980, so equal arrays, equal bytes
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def load_arrays(path: Path) -> dict[str, Array]:
    """Read all arrays of a file; a damaged one or one that holds pickles is refused."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise InputRefused(
            f"{path}: not a readable array file ({error}); pickled data is refused. Write it "
            "again. [arrays.damaged]"
        ) from error
