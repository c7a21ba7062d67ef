"""Whose files are these? An output folder is ours only if we made it; edits by hand are noticed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path

from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict
from usdbrdf.files.atomic import TEMPORARY_PREFIX, environment_failures, sha256_of
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.job.stamp import known_hashes

STATE_FOLDER = ".usdbrdf"

JOB_SCHEMA = 1


def prepare_asset_folder(asset: Path) -> Path:
    """Make or accept the output folder; returns its state folder ``.usdbrdf``.

    A folder with files in it and no ``.usdbrdf/job.json`` is somebody else's: OwnershipConflict.
    Where nothing can be written: EnvironmentFailure. Nothing is created if it is refused.
    """
    state = asset / STATE_FOLDER
    with environment_failures(str(asset)):
        _refuse_unwritable(asset)
        if asset.exists() and not _is_ours(asset):
            raise OwnershipConflict(
                f"{asset}: the folder is not empty and was not made by usdbrdf. Name a new or "
                "empty folder. [ownership.foreign]"
            )
        asset.mkdir(exist_ok=True)
        for folder in (state, state / "stamps", state / "work"):
            folder.mkdir(exist_ok=True)
        _write_job_record(state / "job.json")
    return state


def make_parents(asset: Path) -> list[Path]:
    """Make the folders above the output folder; returns those that were not there, deepest first,
    beginning with the output folder's ``.usdbrdf`` (empty if that exists)."""
    all_folders = (asset / STATE_FOLDER, asset, *asset.parents)
    new = list(takewhile(lambda folder: not os.path.lexists(folder), all_folders))
    with environment_failures(str(asset)):
        asset.parent.mkdir(parents=True, exist_ok=True)
    return new


@contextmanager
def removed_if_unused(new: Sequence[Path]) -> Iterator[None]:
    """Around the work in an output folder: where it fails before anything is published, the
    folders that ``make_parents`` found missing are removed again."""
    try:
        yield
    except BaseException:
        if new and [entry.name for entry in new[0].parent.iterdir()] == [STATE_FOLDER]:
            shutil.rmtree(new[0], ignore_errors=True)
            for parent in new[1:]:
                with suppress(OSError):  # somebody else's by now
                    parent.rmdir()
        raise


def edited_files(asset: Path) -> list[str]:
    """Asset-relative paths of published files whose bytes are not those that a stage recorded.

    A publish that was interrupted half-way leaves old and new files of ours; its journal says so,
    and none of them counts as edited. Missing files are not edited, their stage will run again.
    """
    edited = []
    for relative, hashes in known_hashes(asset / STATE_FOLDER).items():
        file = asset / relative
        if file.is_file() and sha256_of(file) not in hashes:
            edited.append(relative)
    return sorted(edited)


def _refuse_unwritable(asset: Path) -> None:
    if asset.exists() and not asset.is_dir():
        raise EnvironmentFailure(
            f"{asset}: the output is to be a folder and this is a file. Name another one. "
            "[environment.output]"
        )
    place = asset if asset.exists() else asset.parent
    if not place.is_dir():
        raise EnvironmentFailure(
            f"{asset}: the folder {place} does not exist. Create it first. [environment.output]"
        )
    if not os.access(place, os.W_OK | os.X_OK):
        raise EnvironmentFailure(
            f"{asset}: {place} is not writable. Change its permission or name another folder. "
            "[environment.output]"
        )


def _is_ours(asset: Path) -> bool:
    entries = {entry.name for entry in asset.iterdir()}
    if not entries or (asset / STATE_FOLDER / "job.json").is_file():
        return True
    # Killed between the first mkdir and job.json: nothing of anybody's can be in there yet.
    state = asset / STATE_FOLDER
    return entries == {STATE_FOLDER} and all(
        entry.name in ("stamps", "work", "lock") or entry.name.startswith(TEMPORARY_PREFIX)
        for entry in state.iterdir()
    )


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
