"""Compiled functions: numba's decorators with the project's settings and with types kept.

Never ``fastmath``: under it ``np.isnan`` is False, and sums depend on the machine.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numba

from usdbrdf.kernel_cache import KernelCache

F = TypeVar("F", bound=Callable[..., Any])
# One kernel at a time runs on all cores: numba's own pool of threads, which is all that some
# machines have, ends the process when two threads of Python call it.
_turn = threading.Lock()


def kernel(function: F) -> F:
    """Compile for one thread; may be called from other kernels."""
    return _compiled(function)


def parallel_kernel(function: F) -> F:
    """Compile with ``prange`` over all cores. Every iteration writes to places of its own, so that
    the result does not depend on the number of threads."""
    compiled = _compiled(function, parallel=True)

    @functools.wraps(function)
    def in_turn(*arguments: Any, **named: Any) -> Any:
        with _turn:
            return compiled(*arguments, **named)

    result: Any = in_turn
    return result  # type: ignore[no-any-return]


def loop(function: F) -> F:
    """Compile for one thread, without Python's lock. Divisions by 0 give infinities instead of
    exceptions: the test for them would keep a loop from using vector instructions."""
    return _compiled(function, nogil=True, error_model="numpy")


def _compiled(function: F, **options: Any) -> F:
    compiled: Any = numba.njit(**options)(function)
    if not numba.config.DISABLE_JIT:
        compiled._cache = KernelCache(function)
    result: F = compiled
    return result
