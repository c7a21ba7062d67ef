"""What memory there is, what this process has of it, and giving back what it no longer needs."""

from __future__ import annotations

import ctypes
import os
import resource
from contextlib import suppress
from pathlib import Path

import psutil

from usdbrdf.errors import EnvironmentFailure

GIB = 1 << 30
# What libraries take of addresses before any work, and each thread with its stack and arena. With
# less they crash instead of raising a MemoryError.
_ADDRESSES, _ADDRESSES_OF_CORE = 5 * GIB // 2, 150 << 20
# glibc's numbers of two of its parameters (mallopt), and the values up to which it raises them
# where nobody sets them: so much that is free stays with us, and what is larger is a mapping of its
# own.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT_FREE, _OWN_MAPPING = 64 << 20, 32 << 20
_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


def machine_bytes() -> int:
    """The machine's memory, or less where a container or a batch system allows less: the limits of
    this process's control group and of all above it (versions 2 and 1).

    Lines are ``0::/GROUP`` and ``N:memory:/GROUP``. In a container GROUP may be the host's name
    for it, of which nothing is mounted but the root.
    """
    try:
        limits = [int(psutil.virtual_memory().total)]
    except OSError:  # without /proc/meminfo, by which alone some containers tell of less
        limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError):
        for line in _OWN_CGROUPS.read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            if controllers and "memory" not in controllers.split(","):
                continue
            top = _CGROUPS / "memory" if controllers else _CGROUPS
            file = "memory.limit_in_bytes" if controllers else "memory.max"
            own = top / group.strip("/")
            for folder in (own, *own.parents[: len(own.parts) - len(top.parts)]):
                with suppress(OSError, ValueError):  # no such file, or "max"
                    limits.append(int((folder / file).read_text()))
    return min(limits)


def resident_bytes() -> int:
    """What this process has in memory; where no /proc tells that, the most that it ever had."""
    try:
        return int(psutil.Process().memory_info().rss)
    except (OSError, psutil.Error):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def addresses_of_libraries() -> int:
    """Bytes of addresses that are no memory, up to which libraries reserve some on this machine."""
    return _ADDRESSES + _ADDRESSES_OF_CORE * (os.cpu_count() or 1)


def refuse_few_addresses() -> None:
    """EnvironmentFailure where the shell (``ulimit -v``) leaves too little to start at all."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    needed = addresses_of_libraries()
    if limit != resource.RLIM_INFINITY and limit < needed:
        raise EnvironmentFailure(
            f"the limit on address space is {limit / GIB:.2g} GiB, and the libraries alone take up "
            f"to {needed / GIB:.2g}. Raise it (ulimit -v). [environment.memory]"
        )


def give_back_freed() -> None:
    """Freed memory goes back to the system, which glibc would keep for later: after texturing a
    million texels two fifths of all that the process held."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def keep_freed() -> None:
    """Freed memory is used again, up to as much as glibc keeps by itself. Dask's nannies start
    workers with MALLOC_TRIM_THRESHOLD_=65536, with which every array of more than 128 KiB is mapped
    anew and zeroed by the system: a quarter of all CPU seconds of a conversion."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, _OWN_MAPPING)
        library.mallopt(_TRIM_THRESHOLD, _KEPT_FREE)
