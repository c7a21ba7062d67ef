"""Writing scene description straight into a layer: prims, attributes, relationships; and from a
layer in memory to a file that has been opened again and composes.

A layer is written as it will lie on disk, with nothing composed: no opinion can come from
anywhere but these calls, and equal calls give equal bytes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf, Usd, UsdUtils

from usdbrdf.asset.readers.compose import in_one_line
from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.files.atomic import temporary_beside


def over(layer: Sdf.Layer, path: str) -> Sdf.PrimSpec:
    """The prim spec at a path, created as an ``over`` with its ancestors if absent."""
    return Sdf.CreatePrimInLayer(layer, Sdf.Path(path))


def define(layer: Sdf.Layer, path: str, type_name: str) -> Sdf.PrimSpec:
    """A ``def``, of a type unless that is ""; its ancestors stay what they are."""
    prim = over(layer, path)
    prim.specifier = Sdf.SpecifierDef
    if type_name:
        prim.typeName = type_name
    return prim


def apply_schema(prim: Sdf.PrimSpec, *names: str) -> None:
    """Append applied API schemas to the prim's own list, each once."""
    present = prim.GetInfo("apiSchemas").prependedItems if prim.HasInfo("apiSchemas") else []
    added = [name for name in names if name not in present]
    items = Sdf.TokenListOp.Create(prependedItems=[*present, *added])
    prim.SetInfo("apiSchemas", items)


def attribute(
    prim: Sdf.PrimSpec,
    name: str,
    type_name: Sdf.ValueTypeName,
    value: Any = None,
    *,
    uniform: bool = False,
    samples: Mapping[float, Any] | None = None,
    interpolation: str = "",
) -> Sdf.AttributeSpec:
    """An attribute with a default value and, per time code, samples."""
    variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
    spec = prim.attributes.get(name)
    if spec is None:
        spec = Sdf.AttributeSpec(prim, name, type_name, variability, declaresCustom=False)
    if value is not None:
        spec.default = value
    for time, sample in (samples or {}).items():
        prim.layer.SetTimeSample(spec.path, time, sample)
    if interpolation:
        spec.SetInfo("interpolation", interpolation)
    return spec


def relationship(prim: Sdf.PrimSpec, name: str, *targets: str) -> Sdf.RelationshipSpec:
    """A relationship to these targets; without any it has no opinion about them."""
    spec = prim.relationships.get(name) or Sdf.RelationshipSpec(prim, name, custom=False)
    if targets:
        spec.targetPathList.explicitItems = [Sdf.Path(target) for target in targets]
    return spec


def connect(
    prim: Sdf.PrimSpec, name: str, type_name: Sdf.ValueTypeName, source: str
) -> Sdf.AttributeSpec:
    """An attribute that takes its value from the output at path ``source``."""
    spec = attribute(prim, name, type_name)
    spec.connectionPathList.explicitItems = [Sdf.Path(source)]
    return spec


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
    # Each layer is checked when it is written; what lies there now may be damaged, about to be
    # replaced, or the artist's.
    stored.subLayerPaths = []
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
