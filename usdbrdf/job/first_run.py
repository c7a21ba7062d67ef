"""The first run on a machine: its kernels are compiled in a child beside the work.

Numba compiles one kernel at a time in a process. So a child converts a tiny room (``warm_up``) and
leaves what was compiled in the cache, where the run finds it; each waits for what the other has
begun."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.identity import tasks_identity
from usdbrdf.job.child import child
from usdbrdf.job.progress import say
from usdbrdf.kernel import mark_of_compiled

_WORK, _LONGEST_SECONDS = "usdbrdf.warm_up:compile_all", 600.0


@contextmanager
def compiling_beside() -> Iterator[None]:
    """Whatever the pipeline needs is compiled beside this block, unless that was done for this
    state of the sources; no result depends on it, and its failure is nobody's concern."""
    mark = mark_of_compiled(tasks_identity())
    with ExitStack() as beside:
        if mark is not None and not mark.exists() and (os.cpu_count() or 1) > 1:
            say("compiling for this machine beside the work: later runs take less time")
            done = {"done": str(mark)}
            with suppress(EnvironmentFailure):
                beside.enter_context(child(_WORK, {}, done, _LONGEST_SECONDS, "compiling"))
        yield
