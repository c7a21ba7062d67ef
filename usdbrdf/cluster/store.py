"""Where units of work and their workers find each other's arrays: files named by their SHA-256, in
a folder that all of them see, or in an object store."""

from __future__ import annotations

import hashlib
import io
import json
import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.atomic import naming, sha256_of, temporary_beside
from usdbrdf.files.documents import load_arrays, save_arrays
from usdbrdf.model.arrays import Array

# Of a SHA-256, with which every name begins.
DIGITS = 64


class Wanted(EnvironmentFailure):
    """A file that workers were told of is not in the store yet (see ``Files.give_told``)."""


class Files(ABC):
    """Where the files of a store are, and how workers find other files of this process.

    address  by which another process finds them
    folder   of this machine, where they are, or copies of those that were asked for
    """

    address: str
    folder: Path

    @abstractmethod
    def put(self, name: str, size: int | None, write: Callable[[Path], object]) -> None:
        """Have what ``write`` writes under that name: at once, or, where its size in bytes is told,
        by the end of ``settle``, and one that is there already will do."""

    @abstractmethod
    def settle(self) -> None:
        """Wait until all is there that was put; raises what went wrong with it."""

    @abstractmethod
    def found(self, name: str) -> Path:
        """The file of that name, or a copy; EnvironmentFailure where it is not there, or holds
        something else than its name tells."""

    @abstractmethod
    def drop(self, name: str) -> None:
        """Delete it."""

    @abstractmethod
    def path_told(self, path: Path) -> dict[str, Any]:
        """JSON of a path, by which another process finds that file, or a copy."""

    @abstractmethod
    def path_found(self, told: dict[str, Any]) -> Path:
        """The inverse. Whoever opens it may get Wanted."""

    @abstractmethod
    def give_told(self) -> None:
        """Have those of ``path_told`` in the store."""

    @abstractmethod
    def sentence_told(self, text: str) -> str:
        """A sentence of a worker about its copies, for ``sentence_found`` of who told it of them,
        which has our files in their places."""

    @abstractmethod
    def sentence_found(self, text: str) -> str:
        """The inverse."""

    @abstractmethod
    def drop_copies(self) -> None:
        """Delete this machine's copies."""


class Folder(Files):
    """A folder that all workers see under the same name, as they do all other files."""

    def __init__(self, folder: Path) -> None:
        self.address, self.folder = str(folder), folder

    def put(self, name: str, size: int | None, write: Callable[[Path], object]) -> None:
        path = self.folder / name
        if size is None or not (path.is_file() and sha256_of(path) == name[:DIGITS]):
            self.folder.mkdir(parents=True, exist_ok=True)
            with temporary_beside(path) as staged:
                write(staged)
                staged.replace(path)

    def settle(self) -> None:
        """All is there."""

    def found(self, name: str) -> Path:
        """A network's file system may show that of another moment for a while."""
        path = self.folder / name
        try:
            found = sha256_of(path)
        except OSError as error:
            raise EnvironmentFailure(
                f"{path}: cannot be read here ({error.strerror}). Give a folder that all workers "
                "see, under the same name, as --shared-folder. [cluster.folder]"
            ) from error
        if found != name[:DIGITS]:
            raise EnvironmentFailure(
                f"{path}: is not what its name tells. See whether its disk is full or damaged. "
                "[cluster.folder]"
            )
        return path

    def drop(self, name: str) -> None:
        (self.folder / name).unlink(missing_ok=True)

    def path_told(self, path: Path) -> dict[str, Any]:
        return {"path": str(path)}

    def path_found(self, told: dict[str, Any]) -> Path:
        return Path(told["path"])

    def give_told(self) -> None:
        """Workers see them where they are."""

    def sentence_told(self, text: str) -> str:
        return text

    def sentence_found(self, text: str) -> str:
        return text

    def drop_copies(self) -> None:
        """There are none."""


class Store:
    """Arrays and documents as files whose names tell what is in them: whoever reads one checks
    that."""

    def __init__(self, files: Files) -> None:
        self.files = files

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

        def write(path: Path) -> None:
            with naming(path), path.open("wb") as file:
                for part in parts:
                    file.write(part)

        name = f"{digest.hexdigest()}{ending}"
        self.files.put(name, sum(map(len, parts)), write)
        return name

    def array(self, name: str) -> Array:
        """An array, mapped into memory, which machines share among their workers."""
        path = self.files.found(name)
        # Writing, which nobody does, would not reach the file: kernels know arrays that may be
        # written to by another type than those that may not, and are compiled for the former.
        return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))

    def document(self, name: str) -> Any:
        return json.loads(self.files.found(name).read_bytes())

    def keep_result(self, arrays: dict[str, Array]) -> str:
        """Store what a unit found, and give its name."""
        self.files.folder.mkdir(parents=True, exist_ok=True)
        with temporary_beside(self.files.folder / "result.npz") as staged:
            save_arrays(staged, arrays)
            # A name of its own: whoever reads it deletes it, and others may have found the same.
            name = f"{sha256_of(staged)}-{secrets.token_hex(8)}.npz"
            self.files.put(name, None, staged.replace)
        return name

    def result(self, name: str) -> dict[str, Array]:
        """What ``keep_result`` stored."""
        return load_arrays(self.files.found(name))
