"""Units of work: what the long parts of a task are made of, and who does them.

A unit is a function at the top of one of our modules, of two things: what all units of one kind
share, and a small piece that is its own. It returns named arrays, depends on nothing else and
changes nothing. So it knows nothing of where it runs, and may be done more than once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from usdbrdf.model.arrays import Array

# Of what is shared, which nobody changes, and of a piece.
Unit: TypeAlias = Callable[[Any, Any], Mapping[str, Array]]


class Workers(Protocol):
    """Whoever does units of work."""

    def elsewhere(self) -> int:
        """How many units others than this process can do at once; 0 where it does all itself."""
        ...

    def results(
        self, unit: Unit, shared: Any, pieces: Mapping[str, Any], folder: Path, at_a_time: int
    ) -> Iterator[tuple[str, Mapping[str, Array]]]:
        """What the unit returns for each of the pieces, under its key, as they come; they are begun
        in the order of ``pieces``.

        folder     for what workers are to read, which may stay there until the task is done
        at_a_time  units that one process works on together, whose own loops share its cores
        """
        ...

    def forget(self, folder: Path) -> None:
        """Delete what ``results`` with that folder left elsewhere: its task is done."""
        ...


class ThisProcess:
    """Does all units here."""

    def elsewhere(self) -> int:
        return 0

    def results(
        self, unit: Unit, shared: Any, pieces: Mapping[str, Any], folder: Path, at_a_time: int
    ) -> Iterator[tuple[str, Mapping[str, Array]]]:
        if at_a_time == 1:
            for key, piece in pieces.items():
                yield key, unit(shared, piece)
            return
        with ThreadPoolExecutor(max_workers=at_a_time) as pool:
            jobs = {pool.submit(unit, shared, piece): key for key, piece in pieces.items()}
            try:
                for job in as_completed(jobs):
                    yield jobs[job], job.result()
            finally:
                for job in jobs:
                    job.cancel()

    def forget(self, folder: Path) -> None:
        """Nothing is elsewhere."""


HERE = ThisProcess()
