"""How many processes and threads the machine grants, which count alike."""

from __future__ import annotations

import os
from threading import Event, Thread

# USD and OpenBLAS start one for each core as they are loaded. Where they get none, one crashes and
# the other interrupts us.
_THREADS_OF_CORE = 2


def refuse_few_threads() -> None:
    """RuntimeError, as of any thread that cannot be started, where there are too few for the
    libraries to be loaded at all."""
    over = Event()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count = _THREADS_OF_CORE * (cores or 1)
    threads = [Thread(target=over.wait, daemon=True) for _ in range(count)]
    started = []
    try:
        for thread in threads:
            thread.start()
            started.append(thread)
    finally:
        over.set()
        for thread in started:
            thread.join()
