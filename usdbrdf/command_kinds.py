"""What kinds of command there are: which talk, wait for a folder, lock it, run on a capture.

What takes time to load is loaded where it is needed: no page of help waits for NumPy or USD.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from usdbrdf.command_parser import Command
from usdbrdf.job.progress import say, show, tell
from usdbrdf.option import REQUIRED, option
from usdbrdf.options import TalkOptions
from usdbrdf.run_table import table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AbstractContextManager

    from usdbrdf.asset.layout import Asset
    from usdbrdf.job.task import TaskResult


class Talking(TalkOptions, Command):
    def told(self, summary: Mapping[str, Any], *lines: str) -> int:
        """The end of a command that did what it was asked for."""
        if self.json:
            show(json.dumps(summary, indent=2), whole=True)
        for line in lines:
            say(line)
        return 0


class Waiting(Command):
    wait_s: float = option("--wait S", 0.0, (0, 10**9))
    "wait up to this many seconds for a busy asset folder"

    def reading(self, *assets: Path) -> AbstractContextManager[object]:
        """Assets that no run changes meanwhile."""
        from usdbrdf.job.ownership import reading

        return reading(*assets, wait_s=self.wait_s)


class Locking(Waiting):
    without_lock: bool = option("--without-lock", False)
    """go on where the file system has no locks: see that nothing else writes into the asset"""


class Run(Locking, Talking):
    strict: bool = option("--strict", False)
    "exit with 7 if a step of this asset warned, now or when it was done"

    def working_on(self, folder: Path) -> AbstractContextManager[Asset]:
        """The asset folder, made ready and locked as these options say."""
        from usdbrdf.pipeline import working_on

        return working_on(folder, wait_s=self.wait_s, without_lock=self.without_lock)

    def report(self, results: Mapping[str, TaskResult], folder: Path) -> int:
        """What the tasks found, with the root layer, whose name only a finished ingest knows."""
        from usdbrdf.asset.layout import Asset
        from usdbrdf.asset.review import notes_for_run

        root = Asset.at(folder).root_layer
        steps = {
            name: {"reran": result.reran, "reason": result.reason, **result.summary}
            for name, result in results.items()
        }
        done = "written" if any(r.reran for r in results.values()) else "up to date"
        lines = [*table(steps, root), f"{root}: {done}"]
        if steps.get("ingest", {}).get("radiometric") is False:
            doubt = "the images are not radiometric; albedo and fit have no absolute meaning."
            lines = [f"warning: {doubt}", *lines]
        notes = notes_for_run(Asset.at(folder)) if any(r.reran for r in results.values()) else []
        lines += [f"review.usda: {note}" for note in notes]
        known = {"review": notes} if notes else {}
        status = self.told({"asset": str(root), "steps": steps, **known}, *lines)
        doubts = sum(len(result.summary.get("warnings", ())) for result in results.values())
        if self.strict and doubts:
            tell(f"usdbrdf: done, with {doubts} warnings, which --strict counts. [quality.strict]")
            return 7
        return status


class OnCapture(Talking):
    adapter: str | None = option(
        "--adapter NAME", None, unset="recognised by its content", shared="ingest"
    )
    "capture format"
    plugins: bool = option("--no-plugins", True, shared="ingest")
    "use our own adapters only"


class RunOnCapture(OnCapture, Run):
    capture: tuple[Path, ...] = option("SCAN", REQUIRED)
    """capture folder or its main file; several of one scene, with the same mesh and objects, are
    its lightings and get the names of their folders"""
    output: Path = option("-o --output ASSET", REQUIRED)
    "asset folder, made if it is not there"
