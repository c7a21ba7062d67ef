"""Asset paths of a foreign USD file, checked before anything is composed.

USD follows absolute paths, ``../`` and links without a question, wherever they lead.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pxr import Ar, Sdf, Tf, UsdUtils

from usdbrdf.errors import InputRefused

_LAYER_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})
_MAX_LAYERS = 1000
_MAX_BYTES = 4 << 30


def check_asset_paths(path: Path, allow: Sequence[Path]) -> None:
    """InputRefused unless every path in ``path`` and its layers stays beside it or in ``allow``.

    Layers, references, payloads, of every variant, and asset-valued attributes count; links are
    judged by where they lead. What a crafted crate file does to USD's own reader is not caught
    here: call this in a child process.
    """
    allowed = [path.resolve().parent, *(folder.resolve() for folder in allow)]
    waiting, seen, total = [path.resolve()], set[Path](), 0
    while waiting:
        layer = waiting.pop()
        if layer in seen:
            continue
        seen.add(layer)
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
