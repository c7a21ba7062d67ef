"""Writing scene description straight into a layer: prims, attributes, relationships.

A layer is written as it will lie on disk, with nothing composed: no opinion can come from
anywhere but these calls, and equal calls give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pxr import Sdf


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
