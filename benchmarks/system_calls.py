"""A process whose calls of the file system are seen one by one, and answered otherwise than by the
kernel where that is asked for: to kill it at the n-th write, to fill its disk, to lose its locks.

The kernel itself stops each call and asks us (seccomp's user notifications, Linux 5.19 and later,
x86-64): nothing of the program is changed, no library between it and the kernel is passed over, and
processes that it starts are watched with it. No rights are needed.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import platform
import select
import socket
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

# What a call does to files, and its numbers (asm/unistd_64.h).
KINDS: dict[str, dict[str, int]] = {
    "read": {"read": 0, "pread64": 17, "readv": 19, "preadv": 295},
    "write": {
        "write": 1, "pwrite64": 18, "writev": 20, "pwritev": 296, "truncate": 76, "ftruncate": 77,
        "fallocate": 285, "sendfile": 40, "copy_file_range": 326,
    },
    "sync": {"fsync": 74, "fdatasync": 75},
    "rename": {"rename": 82, "renameat": 264, "renameat2": 316},
    "unlink": {"unlink": 87, "rmdir": 84, "unlinkat": 263},
    "mkdir": {"mkdir": 83, "mkdirat": 258},
    "open": {"open": 2, "openat": 257, "creat": 85},  # one that makes a file is a "create"
    "lock": {"flock": 73, "fcntl": 72},
}  # fmt: skip
_NUMBERS = {number: name for calls in KINDS.values() for name, number in calls.items()}
_KIND = {name: kind for kind, calls in KINDS.items() for name in calls}
_AT = {"openat", "mkdirat", "unlinkat", "renameat", "renameat2"}  # a folder, then a path in it
_BY_PATH = {*_AT, "open", "creat", "mkdir", "rmdir", "unlink", "rename", "truncate"}
_TARGET = {"sendfile": 0, "copy_file_range": 2}  # which argument is the file that is written

_SECCOMP, _SET_FILTER, _NEW_LISTENER, _WAIT_KILLABLE = 317, 1, 1 << 3, 1 << 5
_NO_NEW_PRIVILEGES, _ARCHITECTURE = 38, 0xC000003E
_RECEIVE, _SEND, _CONTINUE = 0xC0502100, 0xC0182101, 1
_ALLOW, _ASK = 0x7FFF0000, 0x7FC00000
_NOTICE = struct.Struct("=QII iIQ 6Q")  # struct seccomp_notif
_HERE = -100 & 0xFFFFFFFF  # AT_FDCWD
_LOCKING = {fcntl.F_SETLK, fcntl.F_SETLKW, 37, 38}  # the last two: of open file descriptions


@dataclass(frozen=True)
class Call:
    """One call, before it happens.

    kind     one of ``KINDS``, or "create"
    path     what it is about; of a rename, what is renamed
    target   the other path of a rename
    thread   who calls; ``descriptor`` is its file there, -1 where it names a path
    process  the one that is watched, which started the caller or is it
    """

    kind: str
    path: Path
    target: Path | None
    thread: int
    descriptor: int
    process: int


# What happens to a call: None lets it happen, a number is the error (errno) that it gets instead.
Answer = Callable[[Call], int | None]


def can_watch() -> bool:
    """Whether this machine can do it."""
    release = tuple(int(part) for part in platform.release().split("-")[0].split(".")[:2])
    return platform.machine() == "x86_64" and platform.system() == "Linux" and release >= (5, 19)


def run_watched(work: Callable[[], int], kinds: Iterable[str], root: Path, answer: Answer) -> int:
    """Run ``work`` in a forked process; its exit status, or minus the signal that ended it.

    kinds   of calls that are looked at: "open" is both opening and creating
    root    calls on what lies outside of this folder just happen
    answer  is asked for each of the others, and may end the process

    The caller should have no threads but the first.
    """
    names = [name for kind in kinds for name in KINDS[kind]]
    ours, theirs = socket.socketpair()
    process = os.fork()
    if process == 0:
        status = 1
        try:
            ours.close()
            listener = _listener(names)
            socket.send_fds(theirs, [b"."], [listener])
            os.close(listener)
            theirs.close()
            status = work()
        finally:
            os._exit(status)
    theirs.close()
    with ours:
        listener = socket.recv_fds(ours, 1, 1)[1][0]
    try:
        return _served(process, listener, os.path.realpath(root), answer)
    finally:
        os.close(listener)


def _listener(names: Iterable[str]) -> int:
    """Have the calls of this process, and of those that it starts, asked for; where to answer."""
    numbers = [_NUMBER_OF[name] for name in names]
    program = [(0x20, 0, 0, 4), (0x15, 0, len(numbers) + 1, _ARCHITECTURE), (0x20, 0, 0, 0)]
    for i, number in enumerate(numbers):
        program.append((0x15, len(numbers) - i, 0, number))
    program += [(0x06, 0, 0, _ALLOW), (0x06, 0, 0, _ASK)]
    filled = b"".join(struct.pack("=HBBI", *line) for line in program)
    kept = ctypes.create_string_buffer(filled)
    block = ctypes.create_string_buffer(struct.pack("=H6xQ", len(program), ctypes.addressof(kept)))
    library = ctypes.CDLL(None, use_errno=True)
    library.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    found: int = library.syscall(_SECCOMP, _SET_FILTER, _NEW_LISTENER | _WAIT_KILLABLE, block)
    if found < 0:
        raise OSError(ctypes.get_errno(), "seccomp: " + os.strerror(ctypes.get_errno()))
    return found


_NUMBER_OF = {name: number for number, name in _NUMBERS.items()}


def _served(process: int, listener: int, root: str, answer: Answer) -> int:
    ended = os.pidfd_open(process)
    waiting = select.poll()
    waiting.register(listener, select.POLLIN)
    waiting.register(ended, select.POLLIN)
    notice = bytearray(_NOTICE.size)
    try:
        while True:
            ready = [file for file, _ in waiting.poll()]
            if ended in ready:
                return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
            notice[:] = bytes(len(notice))
            with suppress(OSError):  # who asked has died
                fcntl.ioctl(listener, _RECEIVE, notice)
                identity, thread, _, number, _, _, *arguments = _NOTICE.unpack(notice)
                call = _call(process, thread, _NUMBERS[number], arguments)
                error = None
                if call is not None and _concerns(call, root):
                    error = answer(call)
                reply = struct.pack("=QqiI", identity, 0, -(error or 0), 0 if error else _CONTINUE)
                fcntl.ioctl(listener, _SEND, reply)
    finally:
        os.close(ended)


def _concerns(call: Call, root: str) -> bool:
    return any(str(path).startswith(root) for path in (call.path, call.target) if path)


def _call(process: int, thread: int, name: str, arguments: list[int]) -> Call | None:
    """What is asked for; None where that is nothing of ours, or the thread is gone."""
    kind, descriptor, target = _KIND[name], -1, None
    try:
        if name in _BY_PATH:
            first = 1 if name in _AT else 0
            path = _path(thread, arguments[0] if name in _AT else _HERE, arguments[first])
            if kind == "rename":
                place = arguments[2] if name in _AT else _HERE
                target = _path(thread, place, arguments[3 if name in _AT else 1])
            flags = os.O_CREAT if name == "creat" else arguments[first + 1]
            if kind == "open" and flags & os.O_CREAT and not os.path.lexists(path):
                kind = "create"
        else:
            descriptor = ctypes.c_int(arguments[_TARGET.get(name, 0)]).value
            path = Path(os.readlink(f"/proc/{thread}/fd/{descriptor}"))
            if name == "fcntl" and arguments[1] not in _LOCKING:
                return None
    except OSError:
        return None
    return Call(kind, path, target, thread, descriptor, process)


def _path(thread: int, folder: int, address: int) -> Path:
    with open(f"/proc/{thread}/mem", "rb", 0) as memory:
        memory.seek(address)
        said = b""
        while b"\0" not in said and len(said) < os.pathconf("/", "PC_PATH_MAX"):
            # Up to the end of a page: the next one may not be there.
            said += memory.read(4096 - (address + len(said)) % 4096)
    name = os.fsdecode(said.partition(b"\0")[0])
    if os.path.isabs(name):
        return Path(name)
    place = "cwd" if folder & 0xFFFFFFFF == _HERE else f"fd/{ctypes.c_int(folder).value}"
    return Path(os.readlink(f"/proc/{thread}/{place}")) / name
