"""What an asset's layers say may have been written by anybody: any prim may be missing, and any
attribute of ours may have a value of another type, or none. What is just as this version wrote it
is not to blame: who stumbles there is us."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from pxr import Usd

from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import raise_shortage, sha256_of
from usdbrdf.job.stamp import STATE_FOLDER, code_version, hashes_in, read_stamp
from usdbrdf.untrusted.usd_paths import words_of

P = ParamSpec("P")
R = TypeVar("R")
_MAX_LENGTH = 200
# What is raised by who goes on with such a value, by USD's own functions among them.
_STUMBLES = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


def refuses_foreign(what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function that reads ``what`` in one of its arguments, a stage or a prim, and finds it, or
    says in a sentence (InputRefused) that it is not what we would have written there. Where all
    layers have the bytes that steps of this version recorded, that would be untrue: the defect is
    raised as it is."""

    def of_reader(reader: Callable[P, R]) -> Callable[P, R]:
        @wraps(reader)
        def read(*given: P.args, **named: P.kwargs) -> R:
            try:
                return reader(*given, **named)
            except _STUMBLES as error:
                raise_shortage(error)
                if _is_as_written(_stage_of(*given)):
                    raise
                said = " ".join(words_of(error).split())[:_MAX_LENGTH]
                raise InputRefused(
                    f"{place_of(*given)}: what the layers say of {what} is not what usdbrdf writes "
                    f"there ({type(error).__name__}: {said}). Take the layers from a copy of the "
                    "asset, or run `usdbrdf convert` again with --discard. [stage.content]"
                ) from error

        return read

    return of_reader


def place_of(*given: Any) -> str:
    """The file by which a stage, or that of a prim, the first of ``given``, is to be named."""
    layer = _stage_of(*given).GetRootLayer()
    # Of a stage that we put together, the strongest of its layers.
    below = [*layer.subLayerPaths] if layer.anonymous else []
    return str((below or [layer.identifier])[0])


def _stage_of(*given: Any) -> Usd.Stage:
    place = next(each for each in given if isinstance(each, Usd.Stage | Usd.Prim))
    return place.GetStage() if isinstance(place, Usd.Prim) else place


def _is_as_written(stage: Usd.Stage) -> bool:
    """Whether every file that the stage is made of is one that a step of this version recorded so:
    of another one's we may not know what it means."""
    layers = [layer for layer in stage.GetUsedLayers() if not layer.anonymous]
    files = [Path(layer.realPath) for layer in layers]
    folder = next(
        (up for file in files for up in file.parents if (up / STATE_FOLDER).is_dir()), None
    )
    if folder is None or any(layer.dirty for layer in layers):
        return False
    stamps = map(read_stamp, (folder / STATE_FOLDER / "stamps").glob("*.json"))
    known = hashes_in(one for one in stamps if one and one.version == code_version())
    return all(
        file.is_relative_to(folder)
        and file.is_file()
        and sha256_of(file) in known.get(file.relative_to(folder).as_posix(), ())
        for file in files
    )
