"""What the environment may tell numba, which compiles our loops, that nothing can be done with."""

from __future__ import annotations

import os

from usdbrdf.errors import EnvironmentFailure


def refuse_unusable_settings() -> None:
    """EnvironmentFailure where kernels would not be compiled, which then find nothing, or where
    numba does not start."""
    if _number("NUMBA_DISABLE_JIT"):
        raise EnvironmentFailure(
            "NUMBA_DISABLE_JIT is set: without compiled code rays hit nothing. Unset it. "
            "[environment.compiler]"
        )
    threads = _number("NUMBA_NUM_THREADS")
    if threads is not None and threads < 1:
        raise EnvironmentFailure(
            f"NUMBA_NUM_THREADS is {threads}, and work needs one thread. Unset it, or give the "
            "number of cores to be used. [environment.compiler]"
        )


def _number(name: str) -> int | None:
    """What numba makes of a variable; None where it takes its own default."""
    try:
        return int(os.environ[name])
    except (KeyError, ValueError):
        return None
