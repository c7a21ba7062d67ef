"""Run a stage so that it can be killed at any moment and started again by the same command.

Work happens in ``.usdbrdf/work/<stage>-<fingerprint>``: checkpoints of finished pieces, and the
outputs under their final names. Only complete, verified outputs are published; a journal written
before the first replacement lets the next run finish a publish that was interrupted half-way.
The stamp comes last. Hold ``folder_lock`` around it: nothing here expects company.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from usdbrdf.errors import UsdBrdfError
from usdbrdf.files.atomic import TEMPORARY_PREFIX, environment_failures, fault_point, sha256_of
from usdbrdf.files.documents import json_text
from usdbrdf.job.checkpoints import Checkpoints
from usdbrdf.job.memory import give_back_freed
from usdbrdf.job.publishing import can_publish, publish_stage
from usdbrdf.job.stamp import (
    Stamp,
    check_relative,
    journal_path,
    read_stamp,
    stamp_of,
    stamp_path,
    why_rerun,
    write_stamp,
)
from usdbrdf.model.arrays import Array

# Seconds between saved states of a running computation, and how many times as long as saving one
# takes: what a kill can cost, and what saving may.
_SAVE_AFTER, _SAVE_SELDOM = 2.0, 30


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """summary: what the work returned, now or when it was done; reason: why it (re)ran or not."""

    summary: dict[str, Any]
    reran: bool
    reason: str


class StageRun:
    """What the work of a stage gets: places for its outputs, and checkpoints."""

    def __init__(self, asset: Path, name: str, folder: Path) -> None:
        self.asset = asset
        self.name = name
        self.staged = folder / "staged"
        self.outputs: list[str] = []
        self.once: list[str] = []
        shutil.rmtree(self.staged, ignore_errors=True)
        self.staged.mkdir(parents=True)
        self._checkpoints = Checkpoints(folder / "checkpoints")
        # When a running computation's state was saved last, and how long that took: the first is
        # saved at once, which tells.
        self._saved = -math.inf, 0.0

    def output(self, relative: str) -> Path:
        """Where to write the file that will be published as ASSET/``relative``."""
        return self._place(relative, self.outputs)

    def output_once(self, relative: str) -> Path:
        """The same for a file that is the artist's once it exists: it is never replaced."""
        return self._place(relative, self.once)

    def checkpoint(self, key: str, compute: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
        """The arrays of ``compute``, from an earlier run of the same stage if it got that far."""
        stored = self.checkpoint_if(key)
        if stored is not None:
            return stored
        arrays = dict(compute())
        self.save(key, arrays)
        return arrays

    def checkpoint_if(self, key: str) -> dict[str, Array] | None:
        """The arrays saved under ``key`` by this run or an interrupted one, or None."""
        return self._checkpoints.load(key)

    def save(self, key: str, arrays: Mapping[str, Array]) -> None:
        """Store arrays under ``key`` for a later run of the same stage."""
        self._checkpoints.save(key, arrays)
        fault_point(f"stage:{self.name}:checkpoint")

    def latest(self, prefix: str) -> tuple[int, dict[str, Array]] | None:
        """Index and arrays of the newest intact state that ``save_latest`` stored, or None."""
        for index in self._checkpoints.indices(prefix):
            arrays = self._checkpoints.load(prefix, index)
            if arrays is not None:
                return index, arrays
        return None

    def save_latest(self, prefix: str, index: int, arrays: Mapping[str, Array]) -> None:
        """Store the state of a running computation after step ``index``; older ones are deleted."""
        self._checkpoints.save(prefix, arrays, index)
        fault_point(f"stage:{self.name}:checkpoint")
        for other in self._checkpoints.indices(prefix):
            if other != index:
                self._checkpoints.drop(prefix, other)

    def save_latest_in_time(
        self, prefix: str, index: int, arrays: Callable[[], Mapping[str, Array]]
    ) -> None:
        """``save_latest``, but not so often that it costs more than a few per cent of the time."""
        last, took = self._saved
        start = time.monotonic()
        if start - last >= max(_SAVE_AFTER, _SAVE_SELDOM * took):
            self.save_latest(prefix, index, arrays())
            end = time.monotonic()
            self._saved = end, end - start

    def _place(self, relative: str, register: list[str]) -> Path:
        relative = check_relative(relative)
        if relative not in register:
            register.append(relative)
        path = self.staged / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        fault_point(f"stage:{self.name}:before_write")
        return path


def run_stage(
    asset: Path,
    name: str,
    *,
    order: int,
    parameters: Mapping[str, Any],
    inputs: Mapping[str, str],
    work: Callable[[StageRun], dict[str, Any]],
) -> StageResult:
    """Bring one stage of an asset up to date.

    order        its place in the chain, part of the stamp's name
    parameters   all options that its outputs depend on (JSON)
    inputs       label -> SHA-256 of all that it reads
    work         writes to ``StageRun.output`` places and returns a summary (JSON)

    A run that was interrupted and resumed gives the same bytes as one that was not, provided that
    ``work`` depends on nothing but parameters, inputs and checkpoints.
    """
    wanted = stamp_of(name, parameters, inputs)
    folder = asset / ".usdbrdf" / "work" / f"{name}-{wanted.fingerprint}"
    with environment_failures(f"stage {name}"):
        reason = why_rerun(asset, order, wanted)
        journal = read_stamp(journal_path(asset, name))
        interrupted = journal is not None and journal.fingerprint == wanted.fingerprint
        if reason is None:
            if interrupted:
                journal_path(asset, name).unlink()
            shutil.rmtree(folder, ignore_errors=True)
            done = read_stamp(stamp_path(asset, order, name))
            return StageResult(summary=done.summary if done else {}, reran=False, reason="done")
        _sweep(asset, name, keep=folder)
        if journal and interrupted and can_publish(asset, folder / "staged", journal):
            publish_stage(asset, folder, journal, order)
            return StageResult(summary=journal.summary, reran=True, reason="publish interrupted")
        run = StageRun(asset, name, folder)
        summary = json.loads(json_text(work(run)))
        finished = replace(wanted, summary=summary, **_staged(run))
        finished = replace(finished, earlier=_earlier(asset, order, finished))
        fault_point(f"stage:{name}:before_publish")
        write_stamp(journal_path(asset, name), finished)
        publish_stage(asset, folder, finished, order)
        give_back_freed()
        return StageResult(summary=summary, reran=True, reason=reason)


def _staged(run: StageRun) -> dict[str, Any]:
    for relative in (*run.outputs, *run.once):
        if not (run.staged / relative).is_file():
            raise UsdBrdfError(f"stage {run.name} did not write {relative}. [stage.output]")
    hashes = {relative: sha256_of(run.staged / relative) for relative in run.outputs}
    return {"outputs": hashes, "once": sorted(run.once)}


def _earlier(asset: Path, order: int, finished: Stamp) -> dict[str, list[str]]:
    """The hashes of this stage's files as they may lie there now: from its stamp and journal, and
    of what is about to be replaced, such as an empty layer that another stage put there."""
    earlier: dict[str, set[str]] = {}
    for stamp in (
        read_stamp(stamp_path(asset, order, finished.stage)),
        read_stamp(journal_path(asset, finished.stage)),
    ):
        for relative, sha256 in (stamp.outputs if stamp else {}).items():
            earlier.setdefault(relative, set()).add(sha256)
        for relative, hashes in (stamp.earlier if stamp else {}).items():
            earlier.setdefault(relative, set()).update(hashes)
    for relative in finished.outputs:
        if (asset / relative).is_file():
            earlier.setdefault(relative, set()).add(sha256_of(asset / relative))
    return {relative: sorted(hashes) for relative, hashes in earlier.items()}


def _sweep(asset: Path, name: str, keep: Path) -> None:
    """Delete this stage's work for other parameters, and what killed processes left half."""
    ours = re.compile(re.escape(name) + r"-[0-9a-f]{12}")
    state = asset / ".usdbrdf"
    for folder in ("stamps", "work"):
        (state / folder).mkdir(parents=True, exist_ok=True)
    for path in (state / "work").iterdir():
        if ours.fullmatch(path.name) and path != keep:
            shutil.rmtree(path, ignore_errors=True)
    for litter in (*state.glob(f"{TEMPORARY_PREFIX}*"), *state.glob(f"*/{TEMPORARY_PREFIX}*")):
        litter.unlink(missing_ok=True)
