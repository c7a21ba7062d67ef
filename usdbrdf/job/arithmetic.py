"""What the bytes of a result depend on beside what is computed of what: who computes, and where."""

from __future__ import annotations

import hashlib
import platform
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version

import llvmlite.binding

from usdbrdf.identity import tasks_identity

# Whose numbers become ours.
_RECKONING = ("embreex", "llvmlite", "numba", "numpy", "scipy")


@cache
def arithmetic() -> dict[str, str]:
    """Our code, the libraries, and the processor, since they choose their loops by it."""
    told = {"usdbrdf's code": tasks_identity(), "Python": platform.python_version()}
    for name in _RECKONING:
        try:
            told[name] = version(name)
        except PackageNotFoundError:
            told[name] = "unknown"
    told["processor"] = f"{llvmlite.binding.get_host_cpu_name()} ({sys.platform})"
    return told


def name_of_arithmetic() -> str:
    """12 hexadecimal digits of ``arithmetic``."""
    return hashlib.sha256(repr(sorted(arithmetic().items())).encode()).hexdigest()[:12]
