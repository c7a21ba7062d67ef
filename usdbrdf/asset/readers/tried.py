"""An asset may come from strangers, and there are layers that USD crashes on: a child process opens
them first, but for those that this process has had tried or wrote itself."""

from __future__ import annotations

import stat
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf, Usd, UsdUtils

from usdbrdf.errors import InputRefused
from usdbrdf.job.child import run_child
from usdbrdf.model.arrays import Array

TIMEOUT_S = 600.0
_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")

# Of files, as they are, what tells them from others: those that USD has opened alone, those that
# it has composed as one stage, with or without ours, and those that we wrote.
_State = tuple[int, int, int, int]
_alone: set[_State] = set()
_together: set[frozenset[_State]] = set()
_ours: set[_State] = set()


def try_layers(files: Sequence[Path], *, together: bool = False) -> None:
    """InputRefused where USD crashes on one of these layers, or one is no regular file; whether it
    can be opened is for whoever opens it to say.

    together  compose a stage of them, the strongest first, rather than look at each alone
    """
    _refuse_special(files)
    there = {file: state for file in files if (state := _state(file)) is not None}
    strange = frozenset(there.values()) - _ours
    if not strange or (strange in _together if together else strange <= _alone):
        return
    # All of a stage; alone, those that are new.
    asked = [f for f, state in there.items() if together or state in strange - _alone]
    names = f"{asked[0]} and {len(asked) - 1} layers beside it" if len(asked) > 1 else f"{asked[0]}"
    run_child(
        f"{__name__}:look_in_child",
        {},
        {"layers": [*map(str, asked)], "together": together},
        TIMEOUT_S,
        f"{names}: opening them as USD" if len(asked) > 1 else f"{names}: opening it as USD",
    )
    _alone.update(strange)
    if together:
        _together.add(strange)


def look_in_child(_arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
    """The child's part of ``try_layers``."""
    if parameters["together"]:
        for file in parameters["layers"]:
            refuse_special_behind(file)
        root = Sdf.Layer.CreateAnonymous(".usda")
        root.subLayerPaths = parameters["layers"]
        with suppress(Tf.ErrorException):
            Usd.Stage.Open(root)
    for file in parameters["layers"]:
        look_through(file)
    return {}


def wrote(file: Path) -> None:
    """A layer that this process has just written: it need not be tried."""
    if (state := _state(file)) is not None:
        _ours.add(state)


def look_through(file: str) -> None:
    """Open a layer alone and ask for all paths in it."""
    with suppress(Tf.ErrorException):
        if layer := Sdf.Layer.OpenAsAnonymous(file):
            UsdUtils.ModifyAssetPaths(layer, lambda path: path)


def refuse_special(folder: Path) -> None:
    """InputRefused where something lies among the layers of an asset that USD would wait for."""
    places = folder, folder / "layers", *folder.glob("objects/*")
    for place in (place for place in places if place.is_dir()):
        _refuse_special([file for file in place.iterdir() if file.suffix in _ENDINGS])


def refuse_special_behind(layer: str) -> None:
    """The same for whatever a layer names as a part of its stage, wherever that lies: the layers
    are opened one by one, so this is for a child."""
    waiting, seen, kept = [layer], {layer}, []
    while waiting:
        found = None
        with suppress(Tf.ErrorException):  # which whoever composes the stage will say
            found = Sdf.Layer.FindOrOpen(waiting.pop())
        if found is None:
            continue
        kept.append(found)  # or it would be read again
        for name in {*found.GetCompositionAssetDependencies(), *_clips_of(found)}:
            place, _ = Sdf.Layer.SplitIdentifier(found.ComputeAbsolutePath(name))
            if place not in seen:
                _refuse_special([Path(place)])
                seen.add(place)
                waiting.append(place)


def _clips_of(layer: Sdf.Layer) -> list[str]:
    """What else a layer with value clips names that USD may open as one, among it their files,
    which are no dependencies of the composition."""
    clips: list[Sdf.Path] = []

    def look(path: Sdf.Path) -> None:
        if path.IsPrimPath() or path.IsPrimVariantSelectionPath():
            prim = layer.GetPrimAtPath(path)
            clips.extend([path] if prim and prim.HasInfo("clips") else [])

    with suppress(Tf.ErrorException):
        layer.Traverse(Sdf.Path.absoluteRootPath, look)
        if clips:
            named = UsdUtils.ExtractExternalReferences(layer.identifier)
            return [name for kind in named for name in kind if Path(name).suffix in _ENDINGS]
    return []


def _refuse_special(files: Sequence[Path]) -> None:
    for file in files:
        # Of folders USD says it itself; an artist's may be called like that.
        if file.exists() and not file.is_file() and not file.is_dir():
            raise InputRefused(
                f"{file}: this is no regular file, and a layer is to be here. Put the layer there, "
                "from a copy of the asset, or remove it. [stage.file]"
            )


def _state(file: Path) -> _State | None:
    """A file keeps it when it is renamed, and has another when it was replaced or changed; None
    where there is no file, or none any more."""
    try:
        found = file.stat()
    except OSError:
        return None
    regular = stat.S_ISREG(found.st_mode)
    return (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns) if regular else None
