"""One run at a time in an asset folder, by a lock that the kernel frees on any death."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path

from usdbrdf.errors import FolderBusy

_POLL_SECONDS = 0.2
# Which thread of this process has which lock file. POSIX record locks belong to the process: a
# second one from another thread would just succeed, and closing any descriptor of the file would
# free the first. A forked child has none of them.
_holders: dict[str, int] = {}

os.register_at_fork(after_in_child=_holders.clear)


@contextmanager
def folder_lock(
    state_folder: Path, wait_s: float = 0.0, *, without_lock: bool = False
) -> Iterator[None]:
    """Hold ``state_folder/lock``; for the thread that holds it already, nothing happens.

    wait_s        how long to wait for another holder before FolderBusy, which names it
    without_lock  go on where the file system has no locks, which is FolderBusy otherwise

    The file stays and means nothing by itself; nobody ever has to delete it. FileNotFoundError: the
    folder is not there, or was removed by the holder that this call waited for.
    """
    # The library filelock gives none of this on all Pythons that we run on: its locks (flock)
    # outlive us in forked children, its earlier versions empty the file of the one who waits for
    # it, and where a file system has no locks it leaves a file that no death removes.
    path = state_folder.resolve() / "lock"
    key, own = str(path), threading.get_ident()
    if _holders.get(key) == own:
        yield
        return
    deadline = time.monotonic() + wait_s
    while _holders.setdefault(key, own) != own:
        _wait_or_refuse(path, deadline, f"another thread of this process (pid {os.getpid()})")
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            while not _taken(descriptor, path, without_lock):
                signed = os.pread(descriptor, 4096, 0).decode("utf-8", "replace")
                _wait_or_refuse(path, deadline, signed or "another run that has not signed yet")
            if not os.path.samestat(os.fstat(descriptor), path.stat()):
                raise FileNotFoundError(errno.ENOENT, "the lock was removed", str(path))
            since = datetime.now(timezone.utc).isoformat(timespec="seconds")
            signature = f"pid {os.getpid()} on {socket.gethostname()} since {since}"
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, signature.encode("utf-8", "replace"), 0)
            try:
                yield
            finally:
                os.ftruncate(descriptor, 0)
        finally:
            os.close(descriptor)
    finally:
        _holders.pop(key, None)


def is_held(state_folder: Path) -> bool:
    """Whether this thread holds ``state_folder/lock``."""
    return _holders.get(str(state_folder.resolve() / "lock")) == threading.get_ident()


def _taken(descriptor: int, path: Path, without_lock: bool) -> bool:
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        if not without_lock:
            raise FolderBusy(
                f"{path.parent.parent}: this file system has no working locks ({error.strerror}), "
                "so two runs could write here at once. See that nothing else does and run with "
                "--without-lock, or name a folder on another disk. [lock.none]"
            ) from error
    return True


def _wait_or_refuse(path: Path, deadline: float, holder: str) -> None:
    left = deadline - time.monotonic()
    if left <= 0:
        raise FolderBusy(
            f"{path.parent.parent}: in use by {holder}. Wait for it to end (--wait SECONDS), or "
            "stop it. [lock.busy]"
        )
    time.sleep(min(_POLL_SECONDS, left))
