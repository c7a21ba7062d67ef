"""Files appear whole or not at all: write beside, flush, rename, and only then believe it.

A killed process leaves at most files and folders whose names start with ``TEMPORARY_PREFIX``, which
the next one that writes beside them removes; a full disk leaves the previous file as it was.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.scratch import PREFIX as SCRATCH_PREFIX
from usdbrdf.files.scratch import told_as

TEMPORARY_PREFIX = ".tmp-"
_BLOCK = 1 << 20  # bytes hashed at a time
# Names of ours tell machine and process; what a library names so on the way ends otherwise.
_MACHINE = hashlib.sha256(socket.gethostname().encode("utf-8", "replace")).hexdigest()[:8]
_TEMPORARY = re.compile(
    rf"(?P<name>{re.escape(TEMPORARY_PREFIX)}{_MACHINE}-(?P<process>[1-9]\d*)-[0-9a-f]{{8}})(\..*)?"
)
_TEMPORARY_PLACE = re.compile(
    rf"{re.escape(TEMPORARY_PREFIX)}{_MACHINE}-|{re.escape(SCRATCH_PREFIX)}"
)
# Of these calls may fail that ask for nothing but what is right.
_OF_THE_MACHINE = {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE,
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOMEM, errno.ETIMEDOUT, errno.EAGAIN,
}  # fmt: skip
# What Python says where the system gives it no thread: it has no errno, and no type of its own.
_NO_THREAD = "can't start new thread"
_MORE_PROCESSES = (
    "Raise the limits on processes (ulimit -u, or the container's) and on address space (ulimit -v)"
)
# What helps; where there is no number, or another one, nobody knows more than the last of these.
_PERMISSION, _DISK = "Correct the permission", "Check the disk, or the network that it is on"
_CURES = {
    errno.EACCES: _PERMISSION,
    errno.EPERM: _PERMISSION,
    errno.EROFS: "Make the file system writable, or name another place",
    errno.ENOSPC: "Free disk space",
    errno.EDQUOT: "Free disk space of your quota",
    errno.EIO: _DISK,
    errno.ESTALE: _DISK,
    errno.ETIMEDOUT: _DISK,
    errno.EAGAIN: _MORE_PROCESSES,
    errno.EFBIG: "Raise this shell's limit on the size of files (ulimit -f), or name another disk",
    errno.EMFILE: "Raise this shell's limit on open files (ulimit -n)",
    errno.ENFILE: "Close other programs, which hold all files that this machine can open",
}
_OF_PATHS = {
    errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ELOOP,
    errno.ENAMETOOLONG,
}  # fmt: skip
_UNKNOWN = "Free disk space or correct the permission"
# Of a copy, these are about what it was to become.
_OF_THE_COPY = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
# Of a rename, these are about what was to be replaced, and what it was to be replaced by is ours.
_OF_THE_TARGET = {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.EBUSY,
    errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENOTEMPTY,
}  # fmt: skip
_own: set[str] = set()  # names in use by this process, its threads, and those it was forked from
_swept: set[Path] = set()  # once in a process is enough


def publish(staged: Path, final: Path) -> None:
    """Move a finished file to its final name, durably; both must be in one file system.

    The staged bytes reach the disk before the name does, so that a power cut cannot leave the
    final name on an empty file. Readers that hold the previous file keep it.
    """
    move(staged, final)
    flush_folder(final.parent)


def move(staged: Path, final: Path) -> None:
    """``publish`` of one of many files: the folder is still to be flushed."""
    flush_file(staged)
    os.replace(staged, final)


def flush_file(file: Path) -> None:
    """A file's bytes reach the disk; its name may not yet."""
    with naming(file), file.open("rb") as written:
        os.fsync(written.fileno())


def flush_folder(folder: Path) -> None:
    """The names in a folder reach the disk."""
    with naming(folder):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError as error:  # network file systems that cannot flush a folder say EINVAL
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                raise
        finally:
            os.close(descriptor)


def make_folders(folder: Path) -> None:
    """A folder and those above it, durably: what is flushed in one whose own name is not would be
    lost with it."""
    for new in reversed([each for each in (folder, *folder.parents) if not each.exists()]):
        new.mkdir(exist_ok=True)
        flush_folder(new.parent)


@contextmanager
def folders_above(file: Path) -> Iterator[None]:
    """Make the folders above a file; those that hold nothing at the end go again."""
    made = [folder for folder in file.parents if not folder.exists()]
    try:
        make_folders(file.parent)
        yield
    finally:
        for folder in made:  # the innermost first
            with suppress(OSError):  # it is not empty, or was never made
                folder.rmdir()


def refuse_unwritable(file: Path) -> None:
    """EnvironmentFailure, before the work for it, where no file of this name could be written. No
    folder is made for that: it would have to go again, maybe under the feet of another command."""
    above = next(folder for folder in file.parents if folder.exists())
    with (
        environment_failures(str(file)),
        temporary_beside(above / file.name) as staged,
        naming(file),
    ):
        staged.touch()


def is_bare(folder: Path) -> bool:
    """Whether a folder holds nothing, or what a killed process of ours left of itself."""
    return all(entry.name.startswith(TEMPORARY_PREFIX) for entry in folder.iterdir())


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with naming(path), path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def write_text_atomic(path: Path, text: str) -> None:
    """Write UTF-8 text; ``path`` holds either its previous content or all of the new one."""
    with temporary_beside(path) as staged:
        with naming(path):
            staged.write_bytes(text.encode("utf-8"))
        publish(staged, path)


@contextmanager
def temporary_beside(path: Path) -> Iterator[Path]:
    """A fresh name in the folder of ``path``, with its suffix; gone at the end unless published."""
    with _new_name() as name, _at_work_in(path.parent):
        staged = path.with_name(f"{name}{path.suffix}")
        try:
            with told_as(path.with_name(name), path):
                yield staged
        finally:
            with suppress(OSError):
                staged.unlink()


@contextmanager
def temporary_folder(final: Path) -> Iterator[Path]:
    """A fresh folder beside ``final``, which may be "."; gone at the end unless published."""
    final = final.resolve()
    make_folders(final.parent)
    with _new_name() as name, _at_work_in(final.parent):
        staged = final.with_name(name)
        staged.mkdir()
        try:
            with told_as(staged, final):
                yield staged
        finally:
            shutil.rmtree(staged, ignore_errors=True)


@contextmanager
def _new_name() -> Iterator[str]:
    name = f"{TEMPORARY_PREFIX}{_MACHINE}-{os.getpid()}-{secrets.token_hex(4)}"
    _own.add(name)
    try:
        yield name
    finally:
        _own.discard(name)


@contextmanager
def _at_work_in(folder: Path) -> Iterator[None]:
    """Hold a lock on a folder, with all others who have something temporary in it; who comes when
    nobody does removes what killed ones left.

    Where a file system has no such locks nobody removes anything; where it has them for each
    machine apart, none removes what another made.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:  # who is about to write there will say so
        yield
        return
    try:
        # Never waited for: what is there belongs to somebody, or to the one who is sweeping, who
        # spares what a living process has.
        with suppress(OSError):
            if folder not in _swept:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _swept.add(folder)
                _sweep(folder)
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _sweep(folder: Path) -> None:
    """Remove temporary files and folders of this user and machine whose processes are no more."""
    for place in folder.iterdir():
        named = _TEMPORARY.fullmatch(place.name)
        if named is None or place.lstat().st_uid != os.geteuid() or _is_in_use(**named.groupdict()):
            continue
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place, ignore_errors=True)
        else:
            place.unlink(missing_ok=True)


def _is_in_use(name: str, process: str) -> bool:
    """Whether the process that made a name lives. One with our number that we did not make is an
    earlier one's: in a container every command has the same number, often 1."""
    if int(process) == os.getpid():
        return name in _own
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def publish_folder(staged: Path, final: Path) -> None:
    """Give a finished folder its final name, durably; what is there must be an empty folder."""
    for place in staged.rglob("*"):
        if place.is_file():
            flush_file(place)
        else:
            flush_folder(place)
    flush_folder(staged)
    os.replace(staged, final)
    flush_folder(final.parent)


@contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """A fresh folder that becomes ``final``, new or empty, at the end; gone if the work fails."""
    with temporary_folder(final) as staged:
        yield staged
        publish_folder(staged, final.resolve())


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the system name the file that was in work: of one that is open, at its reading,
    writing, flushing and closing, it tells none."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


@contextmanager
def environment_failures(subject: str) -> Iterator[None]:
    """Translate what the machine lacks (disk, memory, permission) into EnvironmentFailure.

    Every OSError counts, whatever its errno: numpy raises one without when a disk is full. Short
    memory comes as a MemoryError or as the ENOMEM of a call that opens, maps or forks.
    """
    try:
        yield
    except BrokenPipeError:
        raise  # whoever read our output has gone: no fault of this machine
    except (MemoryError, OSError) as error:
        raise _failure(subject, error) from error


def _failure(subject: str, error: MemoryError | OSError) -> EnvironmentFailure:
    if isinstance(error, MemoryError) or error.errno == errno.ENOMEM:
        return EnvironmentFailure(
            f"{subject}: out of memory. Free some or use a larger machine, then run the same "
            "command again; finished work is kept. [environment.memory]"
        )
    place = _place_of(error)
    where = f" ({place!r})" if place and str(place) != subject else ""
    return EnvironmentFailure(
        f"{subject}: {error.strerror or error}{where}. {_cure_of(error)}, then run the same "
        "command again; finished work is kept. [environment.io]"
    )


def _cure_of(error: OSError) -> str:
    if error.errno in _OF_PATHS:
        return "Check the path, and see that nothing else changes it meanwhile"
    return _CURES.get(error.errno or 0, _UNKNOWN)


def cure_of_writing(staged: Path) -> str:
    """What helps where a library could not write a temporary file and tells no number: what the
    system says of more bytes at its end, for what they are worth, for the file is given up."""
    try:
        with staged.open("ab") as file:
            file.write(bytes(_BLOCK))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return _cure_of(error)
    return _UNKNOWN


def failure_of_machine(error: Exception) -> EnvironmentFailure | None:
    """What an error comes to that nobody expected where it came from: of permission, disk, open
    files or threads it is the machine's whoever asks, say whether there is a file; else None, a
    defect."""
    if isinstance(error, RuntimeError) and str(error).startswith(_NO_THREAD):
        return EnvironmentFailure(
            f"this machine starts no more threads. {_MORE_PROCESSES}, then run the same command "
            "again; finished work is kept. [environment.processes]"
        )
    if not isinstance(error, OSError) or error.errno not in _OF_THE_MACHINE:
        return None
    return _failure(str(_place_of(error) or "this machine"), error)


def raise_shortage(error: BaseException | None) -> None:
    """Raise ``failure_of_machine`` where no file that was being read can be to blame, whatever
    reader stumbled: threads, open files, memory, a disk that fails. Permission is the file's.

    Libraries answer an error with one of their own, zipfile a failing read with "not a zip file",
    so that those before it are looked at too, unless it says that they do not matter."""
    seen = set[int]()  # an error that was raised from itself is its own cause
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, Exception) and not isinstance(error, PermissionError):
            failure = failure_of_machine(error)
            if failure is not None:
                raise failure from error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _place_of(error: OSError) -> object:
    """Which file an error is about; of one that is temporary, and gone when the message is read,
    what it was to become, or else the folder that it was in."""
    named = [error.filename, error.filename2]
    if error.errno in _OF_THE_COPY:
        named = [error.filename2 or error.filename]
    elif error.errno in _OF_THE_TARGET:
        named.reverse()
    places = [str(place) for place in named if isinstance(place, str | os.PathLike)]
    for place in places:
        if not _TEMPORARY_PLACE.search(place):
            return place
    if not places:
        return error.filename
    return _TEMPORARY_PLACE.split(places[0])[0].rstrip(os.sep) or os.curdir
