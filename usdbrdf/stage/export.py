"""From a layer in memory to a file that has been opened again and composes."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdUtils

from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.files.atomic import temporary_beside
from usdbrdf.stage.usd_errors import in_one_line


def export(layer: Sdf.Layer, path: Path, *, folder: Path) -> None:
    """Write ``layer`` to ``path``, in the format of its suffix, checked before it gets the name.

    folder   where the layer will lie once published; its relative paths are judged from there

    When the disk is full USD leaves a truncated file in place of the old one: hence a name beside.
    """
    with temporary_beside(path) as written:
        try:
            done = layer.Export(str(written))
        except Tf.ErrorException as error:
            raise EnvironmentFailure(_not_written(path)) from error
        if not done:
            raise EnvironmentFailure(_not_written(path))
        _check(written, layer, path, folder)
        os.replace(written, path)


def _check(written: Path, layer: Sdf.Layer, path: Path, folder: Path) -> None:
    try:
        stored = Sdf.Layer.OpenAsAnonymous(str(written))
    except Tf.ErrorException as error:
        raise EnvironmentFailure(_not_written(path)) from error
    if not stored or stored.defaultPrim != layer.defaultPrim:
        raise EnvironmentFailure(_not_written(path))
    UsdUtils.ModifyAssetPaths(stored, lambda asset: _absolute(asset, folder))
    # Sublayers that are not there yet are published later, or by another stage.
    stored.subLayerPaths = [sub for sub in stored.subLayerPaths if Path(sub).is_file()]
    stage = Usd.Stage.Open(stored, Usd.Stage.LoadAll)
    problems = [in_one_line(error) for error in stage.GetCompositionErrors()]
    if problems:
        raise UsdBrdfError(
            f"{path.name}: the layer does not compose: {problems[0]}. This is a defect of usdbrdf; "
            "please report it. [stage.composition]"
        )


def _absolute(asset: str, folder: Path) -> str:
    return os.path.normpath(folder / asset) if asset.startswith(("./", "../")) else asset


def _not_written(path: Path) -> str:
    return (
        f"{path}: the USD layer could not be written completely. Free disk space or correct the "
        "permission, then run the same command again. [environment.io]"
    )
