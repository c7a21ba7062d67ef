"""A stage as the rules look at it: which layers are whose, and which prims are our objects."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Usd, UsdShade

from usdbrdf.asset.header import Scopes
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import named_files
from usdbrdf.asset.readers.scene import authored


@dataclass(frozen=True)
class AssetStage:
    """A stage whose root layer, or one of its sublayers, is that of an asset of ours; or any other
    stage, of which nearly all that follows is empty."""

    stage: Usd.Stage

    @cached_property
    def layers(self) -> tuple[Sdf.Layer, ...]:
        """The root layer and its sublayers, strongest first."""
        return tuple(self.stage.GetLayerStack(includeSessionLayers=False))

    @cached_property
    def own_layers(self) -> tuple[Sdf.Layer, ...]:
        """Those that the pipeline writes again: not the root layer, nor the artist's.

        The record alone does not tell: an adopted copy of a layer of ours is the artist's.
        """
        folder = self.asset.folder / "layers" if self.asset else None
        return tuple(
            layer
            for layer in self.layers
            if record_of(layer) and layer.realPath and Path(layer.realPath).parent == folder
        )

    @cached_property
    def asset_root(self) -> Sdf.Layer | None:
        """NAME.usda; None where it is not in the stage, or does not say that it is."""
        roots = [layer for layer in self.layers if record_of(layer).get("role") == "root"]
        return roots[0] if roots and roots[0].realPath else None

    @cached_property
    def asset(self) -> Asset | None:
        """The asset folder; None for a stage that is not one of ours."""
        if self.asset_root:
            return Asset(Path(self.asset_root.realPath).parent, str(self.asset_root.defaultPrim))
        for layer in self.layers:
            path = Path(layer.realPath)
            if record_of(layer).get("role") in ROLES and path.parent.name == "layers":
                return Asset(path.parents[1], str(layer.defaultPrim))
        return None

    @cached_property
    def scopes(self) -> Scopes | None:
        """None for a stage that is not one of ours."""
        return Scopes.of(self.asset) if self.asset else None

    @cached_property
    def root_prim(self) -> Usd.Prim | None:
        """The prim that has the looks."""
        prim = self.stage.GetPrimAtPath(self.scopes.root) if self.scopes else None
        return prim if prim and prim.IsValid() else None

    @cached_property
    def recorded(self) -> tuple[Usd.Prim, ...]:
        """All prims that have an attribute of ours, wherever the stage got them from."""
        return tuple(
            prim
            for prim in self.stage.Traverse()
            if prim.GetAuthoredPropertiesInNamespace("usdBrdf")
        )

    @cached_property
    def objects(self) -> tuple[Usd.Prim, ...]:
        """The meshes that are objects of the capture."""
        return tuple(prim for prim in self.recorded if authored(prim, "usdBrdf:label") is not None)

    @cached_property
    def cameras(self) -> tuple[Usd.Prim, ...]:
        """The cameras with photographs."""
        name = "usdBrdf:capture:image"
        return tuple(prim for prim in self.recorded if prim.GetAttribute(name))

    @cached_property
    def asset_paths(self) -> tuple[tuple[Sdf.Layer, Sdf.Path, str], ...]:
        """Every path that a layer of the stage names, or one of the asset's folder that it reaches
        by an arc, of all variants: (layer, spec, path). In metadata the spec is the empty path."""
        layers = (*self.layers, *self._reached_layers())
        return tuple((layer, *found) for layer in layers for found in _asset_paths(layer))

    def _reached_layers(self) -> list[Sdf.Layer]:
        """Layers of the folder by reference, payload or clip; a package names its own content."""
        if not self.asset:
            return []
        stack = self.stage.GetLayerStack(includeSessionLayers=True)
        reached = [
            layer
            for layer in self.stage.GetUsedLayers()
            if layer not in stack
            and not layer.GetFileFormat().IsPackage()
            and not Ar.IsPackageRelativePath(layer.identifier)
            and Path(layer.realPath).is_relative_to(self.asset.folder)
        ]
        return sorted(reached, key=lambda layer: str(layer.realPath))

    def shaders(self, scope: str, identifier: str) -> Iterator[UsdShade.Shader]:
        """The shaders with an ``info:id`` below a scope of ours ("materials" or "looks")."""
        prim = self.stage.GetPrimAtPath(self.scopes.path(scope)) if self.scopes else None
        for below in Usd.PrimRange(prim) if prim else ():
            shader = UsdShade.Shader(below)
            if shader and shader.GetShaderId() == identifier:
                yield shader

    def surface_of(self, item: Usd.Prim) -> UsdShade.Shader | None:
        """The UsdPreviewSurface of an object's measured material; None where there is none."""
        if not self.scopes:
            return None
        identifier = str(authored(item, "usdBrdf:identifier") or "")
        if not Sdf.Path.IsValidIdentifier(identifier):
            return None
        path = self.scopes.path("materials", identifier)
        material = UsdShade.Material(self.stage.GetPrimAtPath(path))
        shader = material.ComputeSurfaceSource()[0] if material else None
        return shader if shader and shader.GetShaderId() == "UsdPreviewSurface" else None

    def is_measured(self, attribute: Usd.Attribute) -> bool:
        """Whether the opinion that wins comes from a layer of ours, not from the artist."""
        stack = attribute.GetPropertyStack(Usd.TimeCode.Default())
        return bool(stack) and stack[0].layer in self.own_layers

    def measured(self, attribute: Usd.Attribute) -> Any:
        """The strongest value that a layer of ours has, whoever wins; None without one."""
        for spec in attribute.GetPropertyStack(Usd.TimeCode.Default()):
            if spec.layer in self.own_layers and spec.HasDefaultValue():
                return spec.default
        return None


def record_of(layer: Sdf.Layer) -> dict[str, Any]:
    """``customLayerData.usdbrdf`` of a layer; empty where it has none."""
    record = layer.customLayerData.get("usdbrdf", {})
    return record if isinstance(record, dict) else {}


def located(layer: Sdf.Layer, asset_path: str) -> Path:
    """Where a path that a layer names leads, whether or not there is a file."""
    return Path(os.path.normpath(Path(layer.realPath).parent / asset_path))


def _asset_paths(layer: Sdf.Layer) -> list[tuple[Sdf.Path, str]]:
    found = [(Sdf.Path.absoluteRootPath, path) for path in layer.subLayerPaths]

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.AttributeSpec):
            found.extend((path, value) for value in _values(layer, spec))
        elif isinstance(spec, Sdf.PrimSpec):
            for arcs in (spec.referenceList, spec.payloadList):
                found.extend((path, arc.assetPath) for arc in arcs.GetAddedOrExplicitItems())

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    metadata = named_files(layer) - {value for _, value in found}
    found.extend((Sdf.Path.emptyPath, value) for value in sorted(metadata))
    return [(path, value) for path, value in found if value]


def _values(layer: Sdf.Layer, spec: Sdf.AttributeSpec) -> list[str]:
    if spec.typeName not in (Sdf.ValueTypeNames.Asset, Sdf.ValueTypeNames.AssetArray):
        return []
    values = [spec.default]
    values += [layer.QueryTimeSample(spec.path, t) for t in layer.ListTimeSamplesForPath(spec.path)]
    paths = []
    for value in values:
        several = [value] if isinstance(value, Sdf.AssetPath) else value or []
        paths += [item.path for item in several if isinstance(item, Sdf.AssetPath)]
    return paths
