"""Folders for the time of a piece of work, among other temporary ones; those that a killed process
left behind go at the next one.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path

from usdbrdf.errors import UsdBrdfError

PREFIX = "usdbrdf-scratch-"
# Between its making and its locking a folder seems to have no owner.
_MIN_AGE_SECONDS = 60


@contextmanager
def told_as(temporary: Path, final: Path) -> Iterator[None]:
    """What is refused in here names ``final`` for what is temporary, which is gone when somebody
    reads that; libraries put endings of their own behind its name."""
    try:
        yield
    except UsdBrdfError as error:
        name = rf"{re.escape(str(temporary))}(\.[\w.]*\w)?(?![\w-])"
        error.args = (re.sub(name, lambda _: str(final), str(error)),)
        raise


@contextmanager
def scratch_folder(output: Path | None = None) -> Iterator[Path]:
    """A new folder beside other temporary ones, of this user alone, gone at the end of the block.

    output  what is made of it, which refusals are to name

    It is locked as long as this process lives, so that it can be told from what nobody owns.
    """
    _sweep(tempfile.gettempdir())
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        descriptor = os.open(name, os.O_RDONLY)
        try:
            with suppress(OSError):  # a file system without locks: it then has to be swept by hand
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with told_as(Path(name), output) if output else nullcontext():
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
