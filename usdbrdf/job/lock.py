"""One run at a time in an asset folder, by a lock that the kernel frees on any death."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path

from usdbrdf.errors import FolderBusy
from usdbrdf.files.atomic import environment_failures
from usdbrdf.job.progress import say

_POLL_SECONDS = 0.2

# POSIX record locks belong to the process: a second one from another thread would just succeed,
# and closing any descriptor of the file would free the first.
_held_here: set[Path] = set()

_guard = threading.Lock()


@contextmanager
def folder_lock(state_folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Hold ``state_folder/lock``; FolderBusy, naming the holder, if it is taken after ``wait_s``.

    ``fcntl.lockf`` and not ``flock``: a forked child would keep the latter alive. The file stays
    and means nothing by itself; nobody ever has to delete it.
    """
    path = state_folder.resolve() / "lock"
    deadline = time.monotonic() + wait_s
    while not _reserved(path):
        _wait_or_refuse(path, deadline, f"another thread of this process (pid {os.getpid()})")
    try:
        with environment_failures(str(path)):
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            while not _taken(descriptor, path):
                _wait_or_refuse(path, deadline, _holder(descriptor))
            with environment_failures(str(path)):
                _sign(descriptor)
            try:
                yield
            finally:
                os.ftruncate(descriptor, 0)
        finally:
            os.close(descriptor)
    finally:
        _held_here.discard(path)


def _reserved(path: Path) -> bool:
    with _guard:
        if path in _held_here:
            return False
        _held_here.add(path)
        return True


def _taken(descriptor: int, path: Path) -> bool:
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            say(f"{path}: this file system has no locks. See that nothing else writes here.")
            return True
        raise
    return True


def _sign(descriptor: int) -> None:
    holder = {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "since": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, json.dumps(holder).encode(), 0)


def _wait_or_refuse(path: Path, deadline: float, holder: str) -> None:
    left = deadline - time.monotonic()
    if left <= 0:
        raise FolderBusy(
            f"{path.parent.parent}: in use by {holder}. Wait for it to end (--wait SECONDS), or "
            "stop it. [lock.busy]"
        )
    time.sleep(min(_POLL_SECONDS, left))


def _holder(descriptor: int) -> str:
    try:
        record = json.loads(os.pread(descriptor, 4096, 0))
        return f"pid {record['pid']} on {record['host']} since {record['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another run that has not signed yet"
