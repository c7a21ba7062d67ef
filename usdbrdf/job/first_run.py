"""The first run on a machine: its kernels are compiled in a child beside the work.

Numba compiles one kernel at a time in a process. So a child converts a tiny room (``warm_up``) and
leaves what was compiled in the cache, where the run finds it; each waits for what the other has
begun."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.identity import tasks_identity
from usdbrdf.job.child import child
from usdbrdf.job.progress import say
from usdbrdf.kernel import mark_of_compiled, when_compiling

_WORK, _LONGEST_SECONDS = "usdbrdf.warm_up:compile_all", 600.0


@contextmanager
def compiling_beside() -> Iterator[None]:
    """From the first kernel that has to be compiled on, whatever the pipeline needs is compiled
    beside this block, unless that was done for this state of the sources. No result depends on it,
    and its failure is nobody's concern."""
    mark = mark_of_compiled(tasks_identity())
    if mark is None or mark.exists() or (os.cpu_count() or 1) < 2:
        yield
        return
    needed, over = Event(), Event()

    def work() -> None:
        needed.wait()
        if not over.is_set():
            say("compiling for this machine beside the work: later runs take less time")
            with (
                suppress(EnvironmentFailure),
                child(_WORK, {}, {"done": str(mark)}, _LONGEST_SECONDS, "compiling"),
            ):
                over.wait()

    # A thread of its own: the child dies with the thread that it was started by.
    thread = Thread(target=work, name="first run", daemon=True)
    thread.start()
    try:
        with when_compiling(needed.set):
            yield
    finally:
        over.set()
        needed.set()
        thread.join()
