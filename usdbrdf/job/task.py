"""Run a task so that it can be killed at any moment and started again by the same command.

Work happens in ``.usdbrdf/work/<task>-<fingerprint>``: checkpoints of finished pieces, and the
outputs under their final names. Only complete, verified outputs are published; a journal written
before the first replacement lets the next run finish a publish that was interrupted half-way.
The stamp comes last. Hold ``folder_lock`` around it: nothing here expects company.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from usdbrdf.errors import UsdBrdfError
from usdbrdf.files.atomic import environment_failures, flush_folder, move, sha256_of
from usdbrdf.files.documents import json_text
from usdbrdf.files.paths import inside
from usdbrdf.job.checkpoints import Checkpoints
from usdbrdf.job.memory import give_back_freed
from usdbrdf.job.stamp import (
    STATE_FOLDER,
    Stamp,
    check_relative,
    hashes_in,
    journal_path,
    read_stamp,
    stamp_of,
    stamp_path,
    why_rerun,
    write_stamp,
)

# What a layer points at is there before the layer: textures, binary layers, text layers.
_RANK = {".usdc": 1, ".usd": 1, ".usda": 2}


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """summary: what the work returned, now or when it was done; reason: why it (re)ran or not."""

    summary: dict[str, Any]
    reran: bool
    reason: str


class TaskRun(Checkpoints):
    """What the work of a task gets: places for its outputs, and checkpoints."""

    def __init__(self, asset: Path, name: str, folder: Path) -> None:
        super().__init__(folder / "checkpoints")
        self.asset = asset
        self.name = name
        self.staged = folder / "staged"
        self.outputs: list[str] = []
        self.once: list[str] = []
        shutil.rmtree(self.staged, ignore_errors=True)
        self.staged.mkdir(parents=True)

    def output(self, relative: str) -> Path:
        """Where to write the file that will be published as ASSET/``relative``."""
        return self._place(relative, self.outputs)

    def output_once(self, relative: str) -> Path:
        """The same for a file that is the artist's once it exists: it is never replaced."""
        return self._place(relative, self.once)

    def _place(self, relative: str, register: list[str]) -> Path:
        relative = check_relative(relative)
        if relative not in register:
            register.append(relative)
        path = self.staged / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def run_task(
    asset: Path,
    name: str,
    *,
    order: int,
    parameters: Mapping[str, Any],
    inputs: Mapping[str, str],
    work: Callable[[TaskRun], dict[str, Any]],
) -> TaskResult:
    """Bring what one task makes of an asset up to date.

    order        its place in the chain, part of the stamp's name
    parameters   all options that its outputs depend on (JSON)
    inputs       label -> SHA-256 of all that it reads
    work         writes to ``TaskRun.output`` places and returns a summary (JSON)

    A run that was interrupted and resumed gives the same bytes as one that was not, provided that
    ``work`` depends on nothing but parameters, inputs and checkpoints.

    Raises OwnershipConflict where a link leads out of the asset, EnvironmentFailure for what the
    machine lacks, and whatever ``work`` raises; what was published before stays valid.
    """
    wanted = stamp_of(name, parameters, inputs)
    work_folder = asset / STATE_FOLDER / "work"
    folder = work_folder / f"{name}-{wanted.fingerprint}"
    stamp, journal = stamp_path(asset, order, name), journal_path(asset, name)
    with environment_failures(name):
        for place in (stamp.parent, folder / "staged", folder / "checkpoints"):
            inside(asset, place)
        for place in (stamp.parent, work_folder):
            place.mkdir(parents=True, exist_ok=True)
        reason = why_rerun(asset, order, wanted)
        noted = read_stamp(journal)
        interrupted = noted is not None and noted.fingerprint == wanted.fingerprint
        for path in work_folder.iterdir():  # this task's work for other parameters
            if re.fullmatch(rf"{re.escape(name)}-[0-9a-f]{{12}}", path.name) and path != folder:
                shutil.rmtree(path, ignore_errors=True)
        if reason is None:
            if interrupted:
                journal.unlink()
            shutil.rmtree(folder, ignore_errors=True)
            done = read_stamp(stamp)
            return TaskResult(summary=done.summary if done else {}, reran=False, reason="done")
        if noted and interrupted and _can_publish(asset, folder / "staged", noted):
            _publish(asset, folder, noted, order)
            return TaskResult(summary=noted.summary, reran=True, reason="publish interrupted")
        run = TaskRun(asset, name, folder)
        summary = json.loads(json_text(work(run)))
        outputs = _hashes_of_staged(run)
        # The hashes of this task's files as they may lie there now, and of what is about to be
        # replaced, such as an empty layer that another task put there.
        earlier = hashes_in([read_stamp(stamp), noted])
        for relative in outputs:
            if (asset / relative).is_file():
                earlier.setdefault(relative, set()).add(sha256_of(asset / relative))
        finished = replace(
            wanted,
            outputs=outputs,
            once=sorted(run.once),
            summary=summary,
            earlier={relative: sorted(hashes) for relative, hashes in earlier.items()},
        )
        write_stamp(journal, finished)
        _publish(asset, folder, finished, order)
        give_back_freed()
        return TaskResult(summary=summary, reran=True, reason=reason)


def _hashes_of_staged(run: TaskRun) -> dict[str, str]:
    for relative in (*run.outputs, *run.once):
        if not (run.staged / relative).is_file():
            raise UsdBrdfError(f"the task {run.name} did not write {relative}. [task.output]")
    return {relative: sha256_of(run.staged / relative) for relative in run.outputs}


def _can_publish(asset: Path, staged: Path, journal: Stamp) -> bool:
    """Whether every output of an interrupted publish is in the asset or still waits, intact."""
    return all(
        any(f.is_file() and sha256_of(f) == sha256 for f in (asset / relative, staged / relative))
        for relative, sha256 in journal.outputs.items()
    ) and all(
        (asset / relative).is_file() or (staged / relative).is_file() for relative in journal.once
    )


def _publish(asset: Path, folder: Path, journal: Stamp, order: int) -> None:
    """Replace the outputs, delete those that are no longer made, write the stamp, clean up; every
    step can be repeated."""
    staged = folder / "staged"
    for _, outputs in groupby(sorted(sorted(journal.outputs), key=_rank), key=_rank):
        # The asset itself, too: its folders may be new.
        for changed in {asset, *(_moved_into(asset, staged, relative) for relative in outputs)}:
            flush_folder(changed)
    for relative in journal.once:
        if not (asset / relative).exists():
            flush_folder(_moved_into(asset, staged, relative))
    _retire(asset, journal)
    write_stamp(stamp_path(asset, order, journal.stage), replace(journal, earlier={}))
    journal_path(asset, journal.stage).unlink()
    shutil.rmtree(folder, ignore_errors=True)


def _moved_into(asset: Path, staged: Path, relative: str) -> Path:
    """The folder of an output that has been moved there, or had been already."""
    folder = inside(asset, (asset / relative).parent)
    if (staged / relative).is_file():
        folder.mkdir(parents=True, exist_ok=True)
        move(staged / relative, asset / relative)
    return folder


def _retire(asset: Path, journal: Stamp) -> None:
    """Delete what earlier runs made and this one did not, unless somebody edited it."""
    for relative, hashes in journal.earlier.items():
        path = asset / relative
        if relative not in journal.outputs and path.is_file() and sha256_of(path) in hashes:
            inside(asset, path.parent)
            path.unlink()


def _rank(relative: str) -> int:
    return _RANK.get(Path(relative).suffix, 0)
