"""What may be said about a job of many scans, beside what its conversions are told."""

from __future__ import annotations

from usdbrdf.option import Options, option


class FarmOptions(Options):
    """How scans are shared out among tasks, and what machines those need."""

    chunk: int = option("--chunk N", 1, (1, 10**6), unset="1")
    "scans that a task converts, one after another; for small ones, which take less than a minute"
    cores: int | None = option("--cores N", None, (1, 4096), unset="any")
    "processor cores that a machine must have to get a task"
    ram: float | None = option("--ram GIB", None, (1, 2**16), unset="any")
    """memory that a machine must have to get a task; without --memory, three quarters of it are
    for texturing and refining"""
    photographs: bool = option("--no-photographs", True)
    "leave photographs out of the pages"
