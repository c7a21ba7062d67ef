"""Whose folder is this? One run at a time in it, or any number that only read, by a lock that the
kernel frees on any death; ours only if we made it; and edits by hand are noticed."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from usdbrdf.errors import EnvironmentFailure, FolderBusy, InputRefused, NoLocks, OwnershipConflict
from usdbrdf.files.atomic import TEMPORARY_PREFIX, environment_failures, flush_folder, sha256_of
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.files.paths import files_below, inside, misplaced, refuse_misplaced
from usdbrdf.job.stamp import STATE_FOLDER, known_hashes, read_stamp

_POLL_SECONDS = 0.2
_UNSIGNED = "another run, which reads it or has not signed yet"
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
P = ParamSpec("P")
R = TypeVar("R")


@dataclass
class _Reading:
    """The open lock file of those threads of this process that read an asset, and their number."""

    descriptor: int
    readers: int = 1


# Which thread of this process has which lock file, and which are read. POSIX record locks belong to
# the process: a second one from another thread would just succeed, and closing any descriptor of
# the file would free the first. A forked child has none of them.
_holders: dict[str, int] = {}
_read: dict[str, _Reading] = {}
_turn = threading.Lock()


def _forget_in_child() -> None:
    global _turn
    _turn = threading.Lock()
    _holders.clear()
    _read.clear()


os.register_at_fork(after_in_child=_forget_in_child)


@contextmanager
def folder_lock(
    state_folder: Path, wait_s: float = 0.0, *, without_lock: bool = False
) -> Iterator[None]:
    """Hold ``state_folder/lock``; for the thread that holds it already, nothing happens.

    wait_s        how long to wait for another holder before FolderBusy, which names it
    without_lock  go on where the file system has no locks, which is FolderBusy otherwise

    The file stays and means nothing by itself; nobody ever has to delete it. FileNotFoundError: the
    folder is not there, or was removed by the holder that this call waited for. OwnershipConflict:
    something else has the file's name. InputRefused: a newer version made the asset, maybe while
    this call waited for it.
    """
    # The library filelock gives none of this on all Pythons that we run on: its locks (flock)
    # outlive us in forked children, its earlier versions empty the file of the one who waits for
    # it, and where a file system has no locks it leaves a file that no death removes.
    path = state_folder.resolve() / "lock"
    key, own = str(path), threading.get_ident()
    if _holders.get(key) == own:
        yield
        return
    refuse_misplaced(path.parent, [path])
    if os.path.lexists(path) and not _is_regular(path):
        raise misplaced(path, "a link, a pipe or a device")
    deadline = time.monotonic() + wait_s
    while not _claimed(key, own):
        _wait_or_refuse(path, deadline, f"another thread of this process (pid {os.getpid()})")
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            while not _taken(descriptor, path, without_lock):
                signed = os.pread(descriptor, 4096, 0).decode("utf-8", "replace")
                _wait_or_refuse(path, deadline, signed or _UNSIGNED)
            if not os.path.samestat(os.fstat(descriptor), path.stat()):
                raise FileNotFoundError(errno.ENOENT, "the lock was removed", str(path))
            _refuse_newer_state(path.parent)
            since = datetime.now(timezone.utc).isoformat(timespec="seconds")
            signature = f"pid {os.getpid()} on {socket.gethostname()} since {since}"
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, signature.encode("utf-8", "replace"), 0)
            try:
                yield
            finally:
                # It only tells who works here; where the disk is gone, that is what is to be said.
                with suppress(OSError):
                    os.ftruncate(descriptor, 0)
        finally:
            os.close(descriptor)
    finally:
        _holders.pop(key, None)


def is_held(state_folder: Path) -> bool:
    """Whether this thread holds ``state_folder/lock``."""
    return _holders.get(str(state_folder.resolve() / "lock")) == threading.get_ident()


@contextmanager
def reading(*places: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Assets, by their folders or root layers, that no run changes meanwhile; any number may read
    one at once, and a run in it is refused or waits until they have ended.

    wait_s  how long to wait for a run before FolderBusy

    Nothing happens for the thread that works in the folder itself, and in a folder without state: a
    published version never changes. A user who may not write reads the lock file only. Where there
    are no working locks, FolderBusy comes at the end, if a step has changed something meanwhile.
    InputRefused: a run was stopped while it put its files in place, and they are of two runs; or a
    newer version made the asset.
    """
    with ExitStack() as held:
        for place in places:
            held.enter_context(_reading(place, wait_s))
        yield


@contextmanager
def writing_alone(folder: Path) -> Iterator[None]:
    """Hold what all processes that call this of a folder hold in turn, for moments: between reading
    and writing a file that a run leaves alone. Where the file system has no such locks nothing is
    held. Nothing is left in the folder, which may be of people alone. EnvironmentFailure where it
    is not there any more."""
    with environment_failures(str(folder)):
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECTORY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def reads_asset(*names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function that reads the assets in its arguments of these names; see ``reading``."""

    def of_function(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def read(*given: P.args, **named: P.kwargs) -> R:
            arguments = signature(function).bind(*given, **named).arguments
            with reading(*(Path(arguments[name]) for name in names)):
                return function(*given, **named)

        return read

    return of_function


@contextmanager
def _reading(place: Path, wait_s: float) -> Iterator[None]:
    state = (place.parent if place.is_file() else place).resolve() / STATE_FOLDER
    if is_held(state) or not state.is_dir():
        yield
        return
    with _shared(state / "lock", wait_s) as locked:
        _refuse_newer_state(state)
        if any(state.glob("publishing-*.json")):
            raise InputRefused(
                f"{state.parent}: a run was stopped while it put its files in place. Run `usdbrdf "
                "convert` again, which ends it. [asset.unfinished]"
            )
        before = None if locked else _steps_in(state)
        yield
        if not locked and _steps_in(state) != before:
            raise FolderBusy(
                f"{state.parent}: a run changed it while it was read, and what was made of it may "
                "be a mixture. Run the same command again when that has ended. [lock.changed]"
            )


@contextmanager
def _shared(path: Path, wait_s: float) -> Iterator[bool]:
    """Hold a lock file with all others who read; whether there is one that works."""
    key, deadline = str(path), time.monotonic() + wait_s
    try:
        while (holder := _joined(key)) is not None:
            _wait_or_refuse(path, deadline, holder)
    except OSError as error:
        # Not there, no file, or not to be opened by this user.
        if error.errno not in (*_NO_LOCKS, errno.ENOENT, errno.EACCES, errno.ELOOP):
            raise
        yield False
        return
    try:
        yield True
    finally:
        with _turn:
            _read[key].readers -= 1
            if not _read[key].readers:
                os.close(_read.pop(key).descriptor)


def _joined(key: str) -> str | None:
    """Have this process read what a lock is for, or say who works there."""
    with _turn:
        if key in _holders:
            return f"another thread of this process (pid {os.getpid()})"
        if key in _read:
            _read[key].readers += 1
            return None
        if not _is_regular(Path(key)):  # a pipe would be waited for
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), key)
        descriptor = os.open(key, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            _read[key] = _Reading(descriptor)
            return None
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                raise
            return os.pread(descriptor, 4096, 0).decode("utf-8", "replace") or _UNSIGNED
        finally:
            if key not in _read:
                os.close(descriptor)


def _is_regular(path: Path) -> bool:
    return stat.S_ISREG(path.lstat().st_mode)


def _claimed(key: str, own: int) -> bool:
    with _turn:
        return key not in _read and _holders.setdefault(key, own) == own


def _steps_in(state: Path) -> dict[str, set[str]]:
    """What changes with every step that puts files in place."""
    started = {journal.name: set[str]() for journal in state.glob("publishing-*.json")}
    return known_hashes(state) | started


def _taken(descriptor: int, path: Path, without_lock: bool) -> bool:
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        if error.errno not in _NO_LOCKS:
            raise
        if not without_lock:
            raise NoLocks(
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


JOB_SCHEMA = 1
_RECORD = "job.json"
# Folders of an asset in which steps put files that they may replace.
_WRITTEN = ("layers", "textures")


def _refuse_newer_state(state: Path) -> None:
    """InputRefused where a newer version made the asset of this state folder: what it means by
    what lies there this one cannot know."""
    document = _record_in(state)
    schema = document.get("schema") if isinstance(document, dict) else None
    if isinstance(schema, int) and schema > JOB_SCHEMA:
        raise InputRefused(
            f"{state / _RECORD}: written by a newer usdbrdf (schema {schema}, this one knows "
            f"{JOB_SCHEMA}). Install that version, or convert the capture into a new folder. "
            "[asset.newer]"
        )


def _record_in(state: Path) -> Any:
    """What tells whose folder it is, and no more; None where it is not there or damaged."""
    with suppress(InputRefused):
        return read_json(state / _RECORD)
    return None


@contextmanager
def owned_folder(asset: Path, *, wait_s: float = 0.0, without_lock: bool = False) -> Iterator[Path]:
    """Make or accept an output folder and hold its lock; gives its state folder ``.usdbrdf``.

    A folder with files in it, no ``.usdbrdf/job.json`` and no records of steps that left all of its
    layers and textures is somebody else's: OwnershipConflict; one of a newer version: InputRefused.
    Where nothing can be written: EnvironmentFailure. For FolderBusy and the options see
    ``folder_lock``. Where the work fails before anything is published, the folders that this call
    made are removed again, and nothing of another run.
    """
    made: list[Path] = []
    with ExitStack() as held:
        with environment_failures(str(asset)):
            while True:
                state = _accepted(asset, made)
                try:
                    held.enter_context(folder_lock(state, wait_s, without_lock=without_lock))
                    break
                except FileNotFoundError:
                    continue  # a run that failed took its folder away
                except NoLocks:
                    if state in made:
                        _remove_empty(state, made)
                    raise
            held.enter_context(_removed_if_unused(asset, made))
            record, folders = state / _RECORD, ("stamps", "work", "cache")
            refuse_misplaced(asset, [record], [state / name for name in folders])
            if _record_in(state) is None:
                write_json(record, {"schema": JOB_SCHEMA, "tool": "usdbrdf"})
                # Files of ours that a power cut spares would be nobody's without it.
                for folder in (state, *made):
                    flush_folder(folder.parent)
            for folder in (state, *(state / name for name in folders)):
                inside(asset, folder).mkdir(exist_ok=True)
                for litter in folder.glob(f"{TEMPORARY_PREFIX}*"):
                    litter.unlink(missing_ok=True)  # what killed processes left half
        yield state


def edited_files(asset: Path) -> list[str]:
    """Asset-relative paths of published files whose bytes are not those that a task recorded.

    A publish that was interrupted half-way leaves old and new files of ours; its journal says so,
    and none of them counts as edited. Missing files are not edited, their task will run again.
    """
    return sorted(
        relative
        for relative, hashes in known_hashes(asset / STATE_FOLDER).items()
        if (asset / relative).is_file() and sha256_of(asset / relative) not in hashes
    )


def _accepted(asset: Path, made: list[Path]) -> Path:
    """The state folder, it and all above made where absent; what was made comes first in ``made``,
    the innermost first."""
    place = next(folder for folder in (asset, *asset.parents) if folder.exists())
    if not place.is_dir():
        raise EnvironmentFailure(
            f"{asset}: the output is to be a folder, and {place} is a file. Name another one. "
            "[environment.output]"
        )
    if not os.access(place, os.W_OK | os.X_OK):
        where = "" if place == asset else f"{place} is "
        raise EnvironmentFailure(
            f"{asset}: {where}not writable. Change its permission or name another folder. "
            "[environment.output]"
        )
    for link in (folder for folder in (asset, *asset.parents) if folder.is_symlink()):
        if not link.exists():
            raise EnvironmentFailure(
                f"{asset}: {link} is a link to {os.readlink(link)}, which is not there. Make that "
                "folder or name another. [environment.output]"
            )
    state = asset / STATE_FOLDER
    entries = {entry.name for entry in asset.iterdir()} if place == asset else set()
    # Killed between the first mkdir and job.json: nothing of anybody's can be in there yet.
    begun = entries == {STATE_FOLDER} and all(
        entry.name in ("stamps", "work", "cache", "lock") or entry.name.startswith(TEMPORARY_PREFIX)
        for entry in state.iterdir()
    )
    ours = begun or (state / "job.json").is_file()
    # Records that steps of ours left tell as much, if they are of what lies here.
    if entries and not ours and any(map(read_stamp, state.glob("stamps/*.json"))):
        _refuse_what_no_step_left(asset)
    elif entries and not ours:
        raise OwnershipConflict(
            f"{asset}: the folder is not empty and was not made by usdbrdf, or came without its "
            f"hidden folder {STATE_FOLDER}, which tells so. Bring that from where it was copied, "
            "or name a new or empty folder. [ownership.foreign]"
        )
    inside(asset, state)
    inside(asset, state / "lock")
    for folder in (*reversed(asset.parents), asset, state):
        if not os.path.lexists(folder):
            with suppress(FileExistsError):  # another run makes it too
                folder.mkdir()
                made.insert(0, folder)
    return state


def _refuse_what_no_step_left(asset: Path) -> None:
    """OwnershipConflict where a folder that only stamps call ours holds a layer or a texture that
    is not as a step left it: it may be somebody else's, beside stamps that came by a copy."""
    state = asset / STATE_FOLDER
    known = known_hashes(state)
    places = (folder for name in _WRITTEN if (folder := asset / name).is_dir())
    for file in (file for folder in places for file in files_below(folder, without=state)):
        relative = file.relative_to(asset).as_posix()
        is_litter = file.name.startswith(TEMPORARY_PREFIX)
        if not is_litter and sha256_of(file) not in known.get(relative, ()):
            raise OwnershipConflict(
                f"{asset}: {relative} is not as usdbrdf left it, and {STATE_FOLDER}/job.json is "
                "missing, which tells whose folder this is. Bring that from where it was copied, "
                "move the file away, or name a new or empty folder. [ownership.foreign]"
            )


@contextmanager
def _removed_if_unused(asset: Path, made: Sequence[Path]) -> Iterator[None]:
    try:
        yield
    except BaseException as error:
        state = asset / STATE_FOLDER
        with suppress(OSError):
            unused = [entry.name for entry in asset.iterdir()] == [STATE_FOLDER]
            # What an interrupted first step has finished is what the same command goes on from.
            unused &= isinstance(error, InputRefused) or not any(state.glob("work/*/*/kept/*"))
            if unused and state in made:
                for name in ("stamps", "work", "cache"):
                    shutil.rmtree(state / name, ignore_errors=True)
                _remove_empty(state, made)
        raise


def _remove_empty(state: Path, made: Sequence[Path]) -> None:
    """Remove the files of the state folder and the folders ``made``, as far as they are empty."""
    with suppress(OSError):
        # The lock goes last: from then on another run may be in here.
        for file in sorted(state.iterdir(), key=lambda file: file.name == "lock"):
            file.unlink()
        for folder in made:
            folder.rmdir()
