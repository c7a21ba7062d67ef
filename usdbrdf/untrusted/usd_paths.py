"""Asset paths of a foreign USD file, checked before anything is composed.

USD follows absolute paths, ``../`` and links without a question, wherever they lead.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Ar, Sdf, Tf, UsdUtils

from usdbrdf.errors import InputRefused
from usdbrdf.job.child import run_child

_LAYER_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})

_MAX_LAYERS = 1000

_MAX_BYTES = 4 << 30

_TIMEOUT_S = 600.0

_MEMORY_BYTES = 64 << 30  # of addresses


def layers_of_usd(path: Path, allow: Sequence[Path]) -> tuple[Path, ...]:
    """A USD file and every layer that it reaches; InputRefused if one lies elsewhere than beside
    it or in ``allow``. The files are read in a child process."""
    found = run_child(
        "usdbrdf.untrusted.usd_paths:layers_in_child",
        {},
        {"path": str(path.resolve()), "allow": [str(folder.resolve()) for folder in allow]},
        _TIMEOUT_S,
        f"{path}: reading USD",
        memory_limit_bytes=_MEMORY_BYTES,
    )
    return tuple(Path(layer) for layer in found["layers"].tolist())


def layers_in_child(
    arrays: Mapping[str, npt.NDArray[Any]], parameters: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """The child's part of ``layers_of_usd``."""
    allow = [Path(folder) for folder in parameters["allow"]]
    layers = check_asset_paths(Path(parameters["path"]), allow)
    return {"layers": np.array([str(layer) for layer in layers])}


def check_asset_paths(path: Path, allow: Sequence[Path]) -> list[Path]:
    """The layers that ``path`` reaches, itself first; InputRefused unless every path in them stays
    beside it or in ``allow``.

    Layers, references, payloads, of every variant, and asset-valued attributes count; links are
    judged by where they lead. What a crafted crate file does to USD's own reader is not caught
    here: call this in a child process.
    """
    allowed = [path.resolve().parent, *(folder.resolve() for folder in allow)]
    waiting, seen, total = [path.resolve()], list[Path](), 0
    while waiting:
        layer = waiting.pop()
        if layer in seen:
            continue
        seen.append(layer)
        total += layer.stat().st_size
        if len(seen) > _MAX_LAYERS or total > _MAX_BYTES:
            raise InputRefused(
                f"{path}: more than {_MAX_LAYERS} layers or {_MAX_BYTES} bytes of layers. Flatten "
                "the stage, or name the part that was captured. [stage.input_size]"
            )
        if layer.suffix.lower() == ".usdz":
            _check_package(layer)
        for reference in _references(layer):
            target = _target(layer, reference, allowed)
            if target.suffix.lower() in _LAYER_SUFFIXES and target.is_file():
                waiting.append(target)
    return seen


def _references(layer: Path) -> list[str]:
    try:
        found = UsdUtils.ExtractExternalReferences(str(layer))
    except Tf.ErrorException as error:
        raise InputRefused(
            f"{layer}: USD cannot read it ({_first_line(error)}). Export it again. [stage.input]"
        ) from error
    return sorted({reference for kind in found for reference in kind if reference})


def _check_package(layer: Path) -> None:
    package = Sdf.ZipFile.Open(str(layer))
    for name in package.GetFileNames() if package else ():
        if name.startswith(("/", "\\")) or ".." in Path(name).parts:
            raise _outside(layer, name, "is an entry that leaves the package")


def _target(layer: Path, reference: str, allowed: Sequence[Path]) -> Path:
    name = reference
    if Ar.IsPackageRelativePath(name):
        name = Ar.SplitPackageRelativePathOuter(name)[0]
    if "://" in name or name.startswith(("\\\\", "//")):
        raise _outside(layer, reference, "is a URI")
    if os.path.isabs(name):
        raise _outside(layer, reference, "is an absolute path")
    name = name.partition(":SDF_FORMAT_ARGS:")[0]
    target = Path(os.path.realpath(layer.parent / name))
    if not any(target.is_relative_to(folder) for folder in allowed):
        raise _outside(layer, reference, "leads outside the capture")
    return target


def _outside(layer: Path, reference: str, reason: str) -> InputRefused:
    return InputRefused(
        f"{layer}: the asset path {reference[:200]!r} {reason}. Keep what belongs to the stage "
        "beside it and name it by relative paths. [paths.outside]"
    )


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
