"""Run a task so that it can be killed at any moment and started again by the same command.

Work happens in ``.usdbrdf/work/<task>-<fingerprint>``: checkpoints of finished pieces, each a file
that carries its own hash in its name, and the outputs under their final names. Each kind of machine
has pieces of its own there: those of two differ in their last bits, and no run is to give a mixture
(see ``job.arithmetic``). Only complete, verified outputs are published; a journal written before
the first replacement lets the next run, wherever that is, finish a publish that was interrupted
half-way. The stamp comes last. Hold ``folder_lock`` around it: nothing here expects company.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from glob import escape as glob_escape
from itertools import groupby
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from threadpoolctl import threadpool_limits

from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import (
    environment_failures,
    flush_file,
    flush_folder,
    move,
    publish,
    sha256_of,
    temporary_beside,
)
from usdbrdf.files.documents import json_text, load_arrays, save_arrays
from usdbrdf.files.paths import inside, refuse_misplaced
from usdbrdf.job.arithmetic import name_of_arithmetic
from usdbrdf.job.memory import give_back_freed
from usdbrdf.job.progress import progress
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
from usdbrdf.job.units import HERE, Unit, Workers
from usdbrdf.model.arrays import Array

# A checkpoint's name: key, index of a running computation's state, hash of its bytes.
_NAME = re.compile(r"(?P<key>[^@]*)(?:@(?P<index>\d{9}))?\.(?P<sha256>[0-9a-f]{64})\.npz")
# Seconds between saved states of a running computation, and how many times as long as saving one
# takes: what a kill can cost, and what saving may.
_SAVE_AFTER, _SAVE_SELDOM = 2.0, 30
# Of a task's folder, what its workers are to read.
_FOR_WORKERS = "shared"
# What a layer points at is there before the layer: textures, binary layers, text layers.
_RANK = {".usdc": 1, ".usd": 1, ".usda": 2}


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """summary: what the work returned, now or when it was done; reason: why it (re)ran or not."""

    summary: dict[str, Any]
    reran: bool
    reason: str


class TaskRun:
    """What the work of a task gets: places for its outputs, and checkpoints.

    A checkpoint is a named set of arrays for a later run of the same task; a damaged one is as good
    as none. Of the numbered states of one running computation only the newest is kept.
    """

    def __init__(self, asset: Path, name: str, folder: Path, workers: Workers = HERE) -> None:
        self.asset = asset
        self.name = name
        self._workers = workers
        self._for_workers = folder / _FOR_WORKERS
        self.staged = folder / "staged"
        self.outputs: list[str] = []
        self.once: list[str] = []
        shutil.rmtree(self.staged, ignore_errors=True)
        self.staged.mkdir(parents=True)
        self.kept: dict[str, Path] = {}
        own = _own(folder)
        self._kept = own / "kept"
        self._kept.mkdir(parents=True, exist_ok=True)
        self._checkpoints = own / "checkpoints"
        self._checkpoints.mkdir(exist_ok=True)
        self._files: dict[tuple[str, int | None], Path] = {}
        # When a running computation's state was saved last, and how long that took: the first is
        # saved at once, which tells.
        self._saved = -math.inf, 0.0
        self._part = ""
        for path in self._checkpoints.iterdir():
            match = _NAME.fullmatch(path.name)
            if match is None:
                path.unlink()  # what a killed process was writing
                continue
            index = match["index"]
            self._files[unquote(match["key"]), int(index) if index else None] = path

    def part(self, name: str) -> TaskRun:
        """The same run, whose checkpoints are named apart: for work that is done several times
        over. "" is the run itself."""
        own = copy(self)
        own._part = f"{name}:" if name else ""
        return own

    def output(self, relative: str) -> Path:
        """Where to write the file that will be published as ASSET/``relative``."""
        return self._place(relative, self.outputs)

    def output_kept(self, relative: str, write: Callable[[Path], None]) -> None:
        """The same, written by ``write``, unless an interrupted run of the task got so far: for
        outputs each of which takes long."""
        relative = check_relative(relative)
        stem = _stem_of_kept(relative)
        for path in self._kept.glob(f"{glob_escape(stem)}*"):
            if sha256_of(path) == path.name.removeprefix(stem):
                self.kept[relative] = path
        if relative not in self.kept:
            with temporary_beside(self._kept / Path(relative).name) as staged:
                write(staged)
                self.kept[relative] = self._kept / f"{stem}{sha256_of(staged)}"
                publish(staged, self.kept[relative])
        if relative not in self.outputs:
            self.outputs.append(relative)

    def output_once(self, relative: str) -> Path:
        """The same for a file that is the artist's once it exists: it is never replaced."""
        return self._place(relative, self.once)

    def hashes(self) -> dict[str, str]:
        """The SHA-256 of every output; UsdBrdfError where one was not written."""
        places = {relative: self.staged / relative for relative in (*self.outputs, *self.once)}
        places |= self.kept
        for relative, place in places.items():
            if not place.is_file():
                raise UsdBrdfError(f"the task {self.name} did not write {relative}. [task.output]")
        return {relative: sha256_of(places[relative]) for relative in self.outputs}

    def _place(self, relative: str, register: list[str]) -> Path:
        relative = check_relative(relative)
        if relative not in register:
            register.append(relative)
        path = self.staged / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def checkpoint(self, key: str, compute: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
        """The arrays of ``compute``, from an earlier run of the same task if it got that far."""
        stored = self.checkpoint_if(key)
        if stored is not None:
            return stored
        arrays = dict(compute())
        self.save(key, arrays)
        return arrays

    def elsewhere(self) -> int:
        """How many units of work others than this process can do at once; 0 where it does all."""
        return self._workers.elsewhere()

    def units(
        self,
        unit: Unit,
        shared: Any,
        pieces: Mapping[str, Any],
        *,
        label: str,
        noun: str,
        at_a_time: int = 1,
    ) -> list[dict[str, Array]]:
        """What ``unit`` returns for each of the ``pieces``, which their keys name as checkpoints;
        those that are missing are done by this run's workers (see ``job.units``)."""
        stored = {key: self.checkpoint_if(key) for key in pieces}
        found = {key: arrays for key, arrays in stored.items() if arrays is not None}
        rest = {key: piece for key, piece in pieces.items() if key not in found}
        if rest:
            results = self._workers.results(unit, shared, rest, self._for_workers, at_a_time)
            for key, arrays in progress(results, total=len(rest), label=label, unit=noun):
                self.save(key, arrays)
                found[key] = dict(arrays)
        return [found[key] for key in pieces]

    def checkpoint_if(self, key: str, index: int | None = None) -> dict[str, Array] | None:
        """The arrays saved under ``key`` by this or an interrupted run, bit for bit, or None."""
        key = self._part + key
        path = self._files.get((key, index))
        if path is None:
            return None
        with suppress(OSError, InputRefused):
            if sha256_of(path) == path.name.split(".")[-2]:
                return load_arrays(path)
        self._files.pop((key, index)).unlink(missing_ok=True)
        return None

    def save(self, key: str, arrays: Mapping[str, Array], index: int | None = None) -> None:
        """Store arrays; the file is there under its final name only once it is complete."""
        key = self._part + key
        stem = quote(key, safe="") + (f"@{index:09d}" if index is not None else "")
        with temporary_beside(self._checkpoints / "arrays.npz") as staged:
            save_arrays(staged, arrays)
            path = self._checkpoints / f"{stem}.{sha256_of(staged)}.npz"
            publish(staged, path)
        earlier = self._files.get((key, index), path)
        self._files[key, index] = path
        if earlier != path:
            earlier.unlink(missing_ok=True)

    def latest(self, key: str) -> tuple[int, dict[str, Array]] | None:
        """Index and arrays of the newest intact state that ``save_latest`` stored, or None."""
        for index in sorted(
            (i for k, i in self._files if k == self._part + key and i is not None), reverse=True
        ):
            arrays = self.checkpoint_if(key, index)
            if arrays is not None:
                return index, arrays
        return None

    def save_latest(self, key: str, index: int, arrays: Mapping[str, Array]) -> None:
        """Store the state of a running computation after step ``index``; older ones are deleted."""
        self.save(key, arrays, index)
        for known in list(self._files):
            if known[0] == self._part + key and known[1] not in (None, index):
                self._files.pop(known).unlink(missing_ok=True)

    def save_latest_in_time(
        self, key: str, index: int, arrays: Callable[[], Mapping[str, Array]]
    ) -> None:
        """``save_latest``, but not so often that it costs more than a few per cent of the time."""
        last, took = self._saved
        start = time.monotonic()
        if start - last >= max(_SAVE_AFTER, _SAVE_SELDOM * took):
            self.save_latest(key, index, arrays())
            end = time.monotonic()
            self._saved = end, end - start


def run_task(
    asset: Path,
    name: str,
    *,
    order: int,
    parameters: Mapping[str, Any],
    inputs: Mapping[str, str],
    work: Callable[[TaskRun], dict[str, Any]],
    workers: Workers = HERE,
) -> TaskResult:
    """Bring what one task makes of an asset up to date.

    order        its place in the chain, part of the stamp's name
    parameters   all options that its outputs depend on (JSON)
    inputs       label -> SHA-256 of all that it reads
    work         writes to ``TaskRun.output`` places and returns a summary (JSON)
    workers      who does its units of work; no output depends on that

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
        places = folder / "staged", *(_own(folder) / part for part in ("checkpoints", "kept"))
        for place in (stamp.parent, *places):
            inside(asset, place)
        for place in (stamp.parent, work_folder):
            place.mkdir(parents=True, exist_ok=True)
        reason = why_rerun(asset, order, wanted)
        noted, done = read_stamp(journal), read_stamp(stamp)
        before = {path for each in (noted, done) if each for path in (*each.outputs, *each.once)}
        refuse_misplaced(asset, [stamp, journal, *(asset / path for path in sorted(before))])
        interrupted = noted is not None and noted.fingerprint == wanted.fingerprint
        for path in work_folder.iterdir():  # this task's work for other parameters
            if re.fullmatch(rf"{re.escape(name)}-[0-9a-f]{{12}}", path.name) and path != folder:
                workers.forget(path / _FOR_WORKERS)
                shutil.rmtree(path, ignore_errors=True)
        if reason is None:
            if noted and done and not interrupted:
                _undo(asset, noted, done)
            journal.unlink(missing_ok=True)
            workers.forget(folder / _FOR_WORKERS)
            shutil.rmtree(folder, ignore_errors=True)
            return TaskResult(summary=done.summary if done else {}, reran=False, reason="done")
        if noted and interrupted and _can_publish(asset, folder, noted):
            _publish(asset, folder, noted, order)
            return TaskResult(summary=noted.summary, reran=True, reason="publish interrupted")
        run = TaskRun(asset, name, folder, workers)
        # Many small matrices: BLAS's threads would only wait for each other, and on a busy machine
        # for long.
        with threadpool_limits(limits=1, user_api="blas"):
            summary = json.loads(json_text(work(run)))
        workers.forget(folder / _FOR_WORKERS)
        outputs = run.hashes()
        if noted and done:  # of two stopped publishes the second journal does not tell of the first
            _undo(asset, noted, done)
        # The hashes of this task's files as they may lie there now, and of what is about to be
        # replaced, such as an empty layer that another task put there.
        earlier = hashes_in([done, noted])
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
        # Nobody could tell later whether these are whole: no hash of theirs is kept.
        for relative in run.once:
            flush_file(run.staged / relative)
        refuse_misplaced(asset, [asset / path for path in (*outputs, *finished.once)])
        write_stamp(journal, finished)
        _publish(asset, folder, finished, order)
        give_back_freed()
        return TaskResult(summary=summary, reran=True, reason=reason)


def _own(folder: Path) -> Path:
    """Of a task's folder, what is of this kind of machine."""
    return folder / name_of_arithmetic()


def _stem_of_kept(relative: str) -> str:
    """How the name of a kept output begins; its SHA-256 follows."""
    return f"{quote(relative, safe='')}."


def _waiting(folder: Path, journal: Stamp, relative: str) -> Path:
    """Where an output is from its writing until it is moved into the asset. Nothing moves before
    the journal is there: a run that is killed then still finds what was kept."""
    name = f"{_stem_of_kept(relative)}{journal.outputs.get(relative)}"
    return next(folder.glob(f"*/kept/{name}"), folder / "staged" / relative)


def _can_publish(asset: Path, folder: Path, journal: Stamp) -> bool:
    """Whether every output of an interrupted publish is in the asset or still waits, intact. What
    waits and is not goes: the asset may have the same from an earlier run."""

    def intact(file: Path, sha256: str) -> bool:
        return file.is_file() and sha256_of(file) == sha256

    for relative, sha256 in journal.outputs.items():
        waiting = _waiting(folder, journal, relative)
        if not intact(waiting, sha256):
            waiting.unlink(missing_ok=True)
            if not intact(asset / relative, sha256):
                return False
    return all(
        (asset / relative).is_file() or _waiting(folder, journal, relative).is_file()
        for relative in journal.once
    )


def _publish(asset: Path, folder: Path, journal: Stamp, order: int) -> None:
    """Replace the outputs, delete those that are no longer made, write the stamp, clean up; every
    step can be repeated."""

    def moved(relative: str) -> Path:
        """The folder of an output that has been moved there, or had been already."""
        waiting, final = _waiting(folder, journal, relative), asset / relative
        inside(asset, final.parent)
        if waiting.is_file():
            final.parent.mkdir(parents=True, exist_ok=True)
            move(waiting, final)
        return final.parent

    def rank(relative: str) -> int:
        return _RANK.get(Path(relative).suffix, 0)

    for _, outputs in groupby(sorted(sorted(journal.outputs), key=rank), key=rank):
        # The folders above them up to the asset, too: they may be new.
        ends = {*map(moved, outputs)}
        for changed in {asset, *(folder for end in ends for folder in (end, *end.parents))}:
            if changed.is_relative_to(asset):
                flush_folder(changed)
    for relative in journal.once:
        if not (asset / relative).exists():
            flush_folder(moved(relative))
    for changed in _retire(asset, journal):
        flush_folder(changed)
    write_stamp(stamp_path(asset, order, journal.stage), replace(journal, earlier={}))
    noted = journal_path(asset, journal.stage)
    noted.unlink()
    flush_folder(noted.parent)
    shutil.rmtree(folder, ignore_errors=True)


def _undo(asset: Path, journal: Stamp, done: Stamp) -> None:
    """Delete what a publish for other parameters put beside the outputs of the finished task before
    it was stopped. What it had replaced of these stays, for the next publish to replace."""
    moved = {relative: [sha256] for relative, sha256 in journal.outputs.items()}
    for changed in _retire(asset, replace(done, earlier=moved)):
        flush_folder(changed)


def _retire(asset: Path, journal: Stamp) -> set[Path]:
    """Delete what earlier runs made and this one did not, unless somebody edited it, and folders in
    which nothing is left; the folders where such files, or folders, are or were."""
    folders = set()
    for relative, hashes in journal.earlier.items():
        path = asset / relative
        if relative not in journal.outputs and path.parent.is_dir():
            folders.add(path.parent)
            if path.is_file() and sha256_of(path) in hashes:
                inside(asset, path.parent)
                path.unlink()
    kept = {_first_that_holds_something(asset, folder) for folder in folders if folder.is_dir()}
    return {folder for folder in kept if folder.is_dir()}


def _first_that_holds_something(asset: Path, folder: Path) -> Path:
    """The folder, or the first above it that is not empty; those that are get removed."""
    while folder != asset and next(folder.iterdir(), None) is None:
        folder.rmdir()
        folder = folder.parent
    return folder
