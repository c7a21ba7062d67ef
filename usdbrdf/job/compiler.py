"""What the environment may tell numba, which compiles our loops, that nothing can be done with."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from usdbrdf.errors import EnvironmentFailure

# Which numba looks for in the current folder, and obeys where PyYAML is there to read it.
_SETTINGS = Path(".numba_config.yaml")


def refuse_unusable_settings() -> None:
    """EnvironmentFailure where kernels would not be compiled, which then find nothing, or where
    numba does not start."""
    # A capture by others may bring one along. Not Path.is_file: a folder may be closed to us.
    if os.path.isfile(_SETTINGS) and find_spec("yaml") is not None:
        raise EnvironmentFailure(
            f"{_SETTINGS.absolute()}: numba, which compiles our code, would take settings from "
            "this file. Run the same command in another folder, or delete it. "
            "[environment.compiler]"
        )
    if number_told("NUMBA_DISABLE_JIT"):
        raise EnvironmentFailure(
            "NUMBA_DISABLE_JIT is set: without compiled code rays hit nothing. Unset it. "
            "[environment.compiler]"
        )
    threads = number_told("NUMBA_NUM_THREADS")
    if threads is not None and threads < 1:
        raise EnvironmentFailure(
            f"NUMBA_NUM_THREADS is {threads}, and work needs one thread. Unset it, or give the "
            "number of cores to be used. [environment.compiler]"
        )


def number_told(name: str) -> int | None:
    """What libraries make of a variable of the environment; None where they take their default."""
    try:
        return int(os.environ[name])
    except (KeyError, ValueError):
        return None
