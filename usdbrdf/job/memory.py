"""What memory there is, what this process has of it, and giving back what it no longer needs."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path

GIB = 1 << 30

_CONTAINER = Path("/sys/fs/cgroup/memory.max")

_OF_PROCESS = Path("/proc/self/statm")


def machine_bytes() -> int:
    """The machine's memory, or less where a container may have less."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with suppress(OSError, ValueError):  # no such file, or "max"
        machine = min(machine, int(_CONTAINER.read_text()))
    return machine


def resident_bytes() -> int:
    """What this process has now; 0 where the system does not tell."""
    with suppress(OSError, ValueError, IndexError):
        return int(_OF_PROCESS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def give_back_freed() -> None:
    """Freed memory goes back to the system, which glibc would keep for later: after texturing a
    million texels two fifths of all that the process held."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
