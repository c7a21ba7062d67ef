"""What every task does around its own work: what it depends on, stamp, provenance of its layers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from usdbrdf.asset.header import Draft, Provenance, StageHeader, read_header
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.job.progress import warn
from usdbrdf.job.stamp import code_version
from usdbrdf.job.task import TaskResult, TaskRun, run_task


def warned(doubts: Iterable[str]) -> list[str]:
    """The sentences, which the user has then been told; as "warnings" of its summary they stay with
    what the task made, for --strict."""
    sentences = list(doubts)
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

    def run(self, work: Callable[[TaskRun], dict[str, Any]]) -> TaskResult:
        """Do the work unless it is done already (see ``usdbrdf.job.task``)."""
        return run_task(
            self.asset.folder,
            self.name,
            order=1 + ROLES.index(self.role),
            parameters=self.parameters,
            inputs=self.inputs,
            work=work,
        )

    @property
    def provenance(self) -> Provenance:
        return Provenance(
            role=self.role, version=code_version(), parameters=self.parameters, inputs=self.inputs
        )

    @property
    def header(self) -> StageHeader:
        """Units, axes and times of the scan, which every layer repeats."""
        return read_header(self.asset.layer("scan"))

    @property
    def draft(self) -> Draft:
        """What the task's layers begin with."""
        return Draft(asset=self.asset, header=self.header, provenance=self.provenance)
