"""Modules that other packages announce: whether importing them comes to an end."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint

import numpy as np

from usdbrdf.errors import UsdBrdfError
from usdbrdf.job.child import run_child
from usdbrdf.model.arrays import Array
from usdbrdf.untrusted.bounds import PLUGIN_SECONDS


def problem_of_plugin(point: EntryPoint) -> str:
    """Why the module cannot be imported, "" if it can. A child tries it first: a foreign module may
    hang or crash, and then this process goes on without it."""
    announced = {"name": point.name, "value": point.value, "group": point.group}
    try:
        found = run_child(f"{__name__}:import_here", {}, announced, PLUGIN_SECONDS, "its import")
    except UsdBrdfError as error:
        return str(error).rpartition(". [")[0]
    return str(found["problem"])


def import_here(arrays: Mapping[str, Array], announced: Mapping[str, str]) -> dict[str, Array]:
    """The child's part of ``problem_of_plugin``."""
    try:
        EntryPoint(**announced).load()
    except (Exception, SystemExit) as error:
        return {"problem": np.array(f"{type(error).__name__}: {error}")}
    return {"problem": np.array("")}
