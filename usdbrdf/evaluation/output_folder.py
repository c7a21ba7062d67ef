"""A folder of results that changes as a whole: made beside, then moved file by file."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.atomic import TEMPORARY_PREFIX, environment_failures, publish
from usdbrdf.files.documents import read_json

FILES = "files"


@contextmanager
def output_folder(folder: Path, document: str, assets: tuple[Path, ...]) -> Iterator[Path]:
    """A new folder to write into; at the end its files are in ``folder``, ``document`` last.

    The document (JSON) lists under ``files`` what lies beside it; of an earlier run those that are
    not made again are deleted, nothing else. After an error ``folder`` is as it was.
    Raises UsageError for a folder inside one of ``assets``, OwnershipConflict for one that holds
    files but no such document.
    """
    folder = Path(os.path.abspath(folder))
    for asset in assets:
        if folder.resolve().is_relative_to(asset.resolve()):
            raise UsageError(
                f"{folder}: lies inside the asset {asset}, which stays as it is. Name another "
                "folder with -o. [evaluate.output]"
            )
    earlier = _earlier_files(folder, document)
    with environment_failures(str(folder)):
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=TEMPORARY_PREFIX, dir=folder.parent))
    try:
        yield work
        with environment_failures(str(folder)):
            _move(work, folder, document, earlier)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def files_of(work: Path) -> list[str]:
    """What was written so far, relative, for the document's list."""
    return sorted(p.relative_to(work).as_posix() for p in work.rglob("*") if p.is_file())


def _earlier_files(folder: Path, document: str) -> list[str]:
    if folder.exists() and not folder.is_dir():
        raise OwnershipConflict(f"{folder}: not a folder. Name another with -o. [evaluate.output]")
    if not folder.is_dir() or not any(folder.iterdir()):
        return []
    known: object = None
    if (folder / document).is_file():
        try:
            known = read_json(folder / document).get(FILES)
        except (InputRefused, AttributeError):
            known = None
    if not isinstance(known, list) or not all(isinstance(name, str) for name in known):
        raise OwnershipConflict(
            f"{folder}: holds files but no {document} of ours. Name an empty or a new folder with "
            "-o. [evaluate.output]"
        )
    return known


def _move(work: Path, folder: Path, document: str, earlier: list[str]) -> None:
    made = files_of(work)
    for relative in sorted(made, key=lambda name: name == document):
        (folder / relative).parent.mkdir(parents=True, exist_ok=True)
        publish(work / relative, folder / relative)
    for relative in set(earlier) - set(made):
        stale = (folder / relative).resolve()
        if stale.is_relative_to(folder.resolve()) and stale.is_file():
            stale.unlink()
