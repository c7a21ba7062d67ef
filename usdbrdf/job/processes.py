"""How many processes and threads the machine grants, which count alike."""

from __future__ import annotations

import os
from threading import Event, Thread

from usdbrdf.job.compiler import number_told

# OpenBLAS, as numpy and scipy bring it, starts no more than so many, and the first of these that is
# a positive number says fewer.
_MOST_OF_BLAS = 64
_FEWER_OF_BLAS = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")


def granted_cores() -> int:
    """Those that this process may run on."""
    affinity = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
    return len(affinity) or os.cpu_count() or 1


def refuse_few_threads() -> None:
    """RuntimeError, as of any thread that cannot be started, where there are too few for the
    libraries to be loaded at all: USD and OpenBLAS start one for each core, or as many as their
    settings say. Where they get none, one crashes and the other interrupts us."""
    over = Event()
    cores = granted_cores()
    count = _of_blas(cores) + _of_usd(cores)
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


def _of_blas(cores: int) -> int:
    told = (number_told(name) or 0 for name in _FEWER_OF_BLAS)
    return min(cores, next((number for number in told if number > 0), cores), _MOST_OF_BLAS)


def _of_usd(cores: int) -> int:
    """PXR_WORK_THREAD_LIMIT: 0 for all cores, less than that for all but so many."""
    limit = number_told("PXR_WORK_THREAD_LIMIT") or 0
    return min(cores, limit) if limit > 0 else max(1, cores + limit)
