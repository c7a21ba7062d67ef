"""Folders for the time of a piece of work, among other temporary ones; those that a killed process
left behind go at the next one.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

PREFIX = "usdbrdf-scratch-"
# Between its making and its locking a folder seems to have no owner.
_MIN_AGE_SECONDS = 60


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A new folder beside other temporary ones, of this user alone, gone at the end of the block.

    It is locked as long as this process lives, so that it can be told from what nobody owns.
    """
    _sweep(tempfile.gettempdir())
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        descriptor = os.open(name, os.O_RDONLY)
        try:
            with suppress(OSError):  # a file system without locks: it then has to be swept by hand
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield Path(name)
        finally:
            os.close(descriptor)


@cache  # once in a process is enough
def _sweep(parent: str) -> None:
    with suppress(OSError), os.scandir(parent) as entries:
        for entry in (entry for entry in entries if entry.name.startswith(PREFIX)):
            with suppress(OSError):  # gone meanwhile, or locked: it has an owner
                status = entry.stat(follow_symlinks=False)
                old = time.time() - status.st_mtime > _MIN_AGE_SECONDS
                ours = entry.is_dir(follow_symlinks=False) and status.st_uid == os.geteuid()
                if not (ours and old):
                    continue
                descriptor = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                finally:
                    os.close(descriptor)
                shutil.rmtree(entry.path, ignore_errors=True)
