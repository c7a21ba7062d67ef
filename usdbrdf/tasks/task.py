"""What every task does around its own work: what it depends on, stamp, provenance of its layers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from usdbrdf.asset.header import (
    Draft,
    Provenance,
    StageHeader,
    read_header,
    refuse_newer,
    refuse_old_layout,
)
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import refuse_missing
from usdbrdf.job.progress import say, warn
from usdbrdf.job.stamp import code_version, name_in_lighting
from usdbrdf.job.task import TaskResult, TaskRun, run_task
from usdbrdf.job.units import HERE, Workers

# The input that later steps follow and a task only hands on: a layer that told of it would change
# with it, and all steps after that.
HANDED_ON = "directives"


def in_each_lighting(task: Callable[..., TaskResult], asset: Asset, *given: Any) -> TaskResult:
    """What a task finds that is done for each lighting apart, each time with what is ``given``: of
    several under their names, with all their warnings."""
    several = asset.in_each_lighting
    if not several[0].lighting:
        return task(asset, *given)
    found = {}
    for one in several:
        say(f"{task.__name__}: in the lighting {one.lighting}")
        found[one.lighting] = task(one, *given)
    warnings = [w for each in found.values() for w in each.summary.get("warnings", ())]
    ran = [each for each in found.values() if each.reran]
    return TaskResult(
        summary={"lightings": {k: v.summary for k, v in found.items()}, "warnings": warnings},
        reran=bool(ran),
        reason=(ran or [*found.values()])[0].reason,
    )


def warned(doubts: Iterable[str]) -> list[str]:
    """The sentences, each once (lightings may share what they are about), which the user has then
    been told; as "warnings" of its summary they stay with what the task made, for --strict."""
    sentences = list(dict.fromkeys(doubts))
    for sentence in sentences:
        warn(sentence)
    return sentences


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task about to run: its asset, its role ("texturing", ...), what its outputs depend on."""

    asset: Asset
    name: str
    role: str
    parameters: Mapping[str, Any]
    inputs: Mapping[str, str]

    def run(self, work: Callable[[TaskRun], dict[str, Any]], workers: Workers = HERE) -> TaskResult:
        """Do the work unless it is done already (see ``usdbrdf.job.task``); OwnershipConflict in an
        asset of an old layout, InputRefused in one that has lost a layer, or is of a newer one."""
        refuse_old_layout(self.asset)
        # Layers of the steps are made anew; the root layer is written once.
        refuse_newer(self.asset.root_layer)
        order = 1 + ROLES.index(self.role)
        if order > 1:
            refuse_missing(self.asset, order)
        return run_task(
            self.asset.folder,
            name_in_lighting(self.name, self.asset.lighting),
            order=order,
            parameters=self.parameters,
            inputs=self.inputs,
            work=work,
            workers=workers,
        )

    @property
    def provenance(self) -> Provenance:
        told = {k: v for k, v in self.inputs.items() if k.split(".")[0] != HANDED_ON}
        return Provenance(
            role=self.role, version=code_version(), parameters=self.parameters, inputs=told
        )

    @property
    def header(self) -> StageHeader:
        """Units, axes and times of the scan, which every layer repeats."""
        return read_header(self.asset.layer("scan"))

    @property
    def draft(self) -> Draft:
        """What the task's layers begin with."""
        return Draft(asset=self.asset, header=self.header, provenance=self.provenance)
