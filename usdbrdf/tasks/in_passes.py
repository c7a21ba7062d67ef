"""What all frames say of the texels, in as many passes over the frames as memory asks for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array
from usdbrdf.texturing.passes import by_parts


def in_passes(
    run: TaskRun,
    name: str,
    groups: Sequence[slice],
    count: int,
    observe: Callable[[slice], Mapping[str, Array]],
) -> dict[str, Array]:
    """Arrays of ``count`` texels, of which one pass observes each of the ``groups``; of several
    passes those that are done are kept under ``name`` for a run that goes on."""
    if len(groups) == 1:
        return by_parts(groups, count, observe)
    say(f"{run.name}: {len(groups)} passes over the frames, for lack of memory")

    def kept(part: slice) -> dict[str, Array]:
        return run.checkpoint(f"{name}-{part.start}-{part.stop}", partial(observe, part))

    return by_parts(groups, count, kept)
