"""Whose files are these? An output folder is ours only if we made it; edits by hand are noticed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict
from usdbrdf.files.atomic import TEMPORARY_PREFIX, environment_failures, sha256_of
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.files.paths import inside
from usdbrdf.job.lock import folder_lock
from usdbrdf.job.stamp import STATE_FOLDER, known_hashes

JOB_SCHEMA = 1


@contextmanager
def owned_folder(asset: Path, *, wait_s: float = 0.0, without_lock: bool = False) -> Iterator[Path]:
    """Make or accept an output folder and hold its lock; gives its state folder ``.usdbrdf``.

    A folder with files in it and no ``.usdbrdf/job.json`` is somebody else's: OwnershipConflict.
    Where nothing can be written: EnvironmentFailure. For FolderBusy and the options see
    ``folder_lock``. Where the work fails before anything is published, the folders that this call
    made are removed again, and nothing of another run.
    """
    made: list[Path] = []
    with ExitStack() as held:
        with environment_failures(str(asset)):
            state = _accepted(asset, made)
            while True:
                with suppress(FileNotFoundError):  # a run that failed took its folder away
                    held.enter_context(folder_lock(state, wait_s, without_lock=without_lock))
                    break
                state = _accepted(asset, made)
            held.enter_context(_removed_if_unused(asset, made))
            _write_job_record(state / "job.json")
            for folder in (state, state / "stamps", state / "work"):
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
        raise EnvironmentFailure(
            f"{asset}: {place} is not writable. Change its permission or name another folder. "
            "[environment.output]"
        )
    if place == asset and not _is_ours(asset):
        raise OwnershipConflict(
            f"{asset}: the folder is not empty and was not made by usdbrdf. Name a new or empty "
            "folder. [ownership.foreign]"
        )
    state = inside(asset, asset / STATE_FOLDER)
    inside(asset, state / "lock")
    for folder in (*reversed(asset.parents), asset, state):
        if not os.path.lexists(folder):
            with suppress(FileExistsError):  # another run makes it too
                folder.mkdir()
                made.insert(0, folder)
    return state


def _is_ours(asset: Path) -> bool:
    entries = {entry.name for entry in asset.iterdir()}
    state = asset / STATE_FOLDER
    if not entries or (state / "job.json").is_file():
        return True
    # Killed between the first mkdir and job.json: nothing of anybody's can be in there yet.
    return entries == {STATE_FOLDER} and all(
        entry.name in ("stamps", "work", "lock") or entry.name.startswith(TEMPORARY_PREFIX)
        for entry in state.iterdir()
    )


@contextmanager
def _removed_if_unused(asset: Path, made: Sequence[Path]) -> Iterator[None]:
    try:
        yield
    except BaseException:
        state = asset / STATE_FOLDER
        with suppress(OSError):
            if state in made and [entry.name for entry in asset.iterdir()] == [STATE_FOLDER]:
                shutil.rmtree(state / "stamps", ignore_errors=True)
                shutil.rmtree(state / "work", ignore_errors=True)
                # The lock goes last: from then on another run may be in here.
                for file in sorted(state.iterdir(), key=lambda file: file.name == "lock"):
                    file.unlink()
                for folder in made:
                    folder.rmdir()
        raise


def _write_job_record(path: Path) -> None:
    try:
        record = read_json(path)
    except InputRefused:  # absent or damaged: it only says whose folder this is
        write_json(path, {"schema": JOB_SCHEMA, "tool": "usdbrdf"})
        return
    schema = record.get("schema") if isinstance(record, dict) else None
    if isinstance(schema, int) and schema > JOB_SCHEMA:
        raise OwnershipConflict(
            f"{path}: written by a newer usdbrdf (schema {schema}, this one knows {JOB_SCHEMA}). "
            "Install that version or name another folder. [ownership.newer]"
        )
