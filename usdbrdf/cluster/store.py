"""Where units of work and their workers find each other's arrays: files named by their SHA-256, in
a folder that all of them see."""

from __future__ import annotations

import hashlib
import io
import json
import secrets
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.atomic import sha256_of, temporary_beside
from usdbrdf.files.documents import load_arrays, save_arrays
from usdbrdf.model.arrays import Array

# Of a SHA-256, with which every name begins.
_DIGITS = 64


class Store:
    """A folder of files whose names tell what is in them: whoever reads one checks that."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def keep(self, array: Array) -> str:
        """Store one array as an .npy of its own, and give its name."""
        array = np.asarray(array)
        if not (array.flags.c_contiguous or array.flags.f_contiguous):
            array = np.ascontiguousarray(array)
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, np.lib.format.header_data_from_array_1_0(array)
        )
        # In the order of memory, which the header tells.
        in_order = array if array.flags.c_contiguous else array.T
        memory = in_order.reshape(-1).view(np.uint8).data
        return self._kept(".npy", header.getvalue(), memory)

    def keep_document(self, document: Any) -> str:
        """Store JSON, and give its name."""
        text = json.dumps(document, separators=(",", ":"), allow_nan=False)
        return self._kept(".json", text.encode())

    def _kept(self, ending: str, *parts: bytes | memoryview) -> str:
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part)
        path = self.folder / f"{digest.hexdigest()}{ending}"
        if not (path.is_file() and sha256_of(path) == digest.hexdigest()):
            self.folder.mkdir(parents=True, exist_ok=True)
            with temporary_beside(path) as staged:
                with staged.open("wb") as file:
                    for part in parts:
                        file.write(part)
                staged.replace(path)
        return path.name

    def array(self, name: str) -> Array:
        """An array, mapped into memory, which machines share among their workers."""
        path = self._checked(name)
        # Writing, which nobody does, would not reach the file: kernels know arrays that may be
        # written to by another type than those that may not, and are compiled for the former.
        return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))

    def document(self, name: str) -> Any:
        return json.loads(self._checked(name).read_bytes())

    def keep_result(self, arrays: dict[str, Array]) -> str:
        """Store what a unit found, and give its name."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with temporary_beside(self.folder / "result.npz") as staged:
            save_arrays(staged, arrays)
            # A name of its own: whoever reads it deletes it, and others may have found the same.
            name = f"{sha256_of(staged)}-{secrets.token_hex(8)}.npz"
            staged.replace(self.folder / name)
        return name

    def result(self, name: str) -> dict[str, Array]:
        """What ``keep_result`` stored."""
        return load_arrays(self._checked(name))

    def _checked(self, name: str) -> Path:
        """The file of that name; EnvironmentFailure where it is not there or holds something else,
        which a network's file system may show for a while."""
        path = self.folder / name
        try:
            found = sha256_of(path)
        except OSError as error:
            raise EnvironmentFailure(
                f"{path}: cannot be read here ({error.strerror}). Give a folder that all workers "
                "see, under the same name, as --shared-folder. [cluster.folder]"
            ) from error
        if found != name[:_DIGITS]:
            raise EnvironmentFailure(
                f"{path}: is not what its name tells. See whether its disk is full or damaged. "
                "[cluster.folder]"
            )
        return path
