"""A stage as the rules look at it, what a rule is, and what it finds. The rules themselves know of
no framework that runs them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

from pxr import Ar, Sdf, Usd, UsdShade

from usdbrdf.asset.header import Scopes
from usdbrdf.asset.layers.looks import VARIANT_SET
from usdbrdf.asset.layout import ROLES, Asset, record_of
from usdbrdf.asset.readers.compose import named_files, with_variant
from usdbrdf.asset.readers.scene import authored

# Before the name of a rule of ours, where it stands among those of others.
PREFIX = "usdbrdf"
_ASSET_TYPES = (Sdf.ValueTypeNames.Asset, Sdf.ValueTypeNames.AssetArray)


@dataclass(frozen=True)
class AssetStage:
    """A stage whose root layer, or one of its sublayers, is that of an asset of ours; or any other
    stage, of which nearly all that follows is empty."""

    stage: Usd.Stage

    @cached_property
    def layers(self) -> tuple[Sdf.Layer, ...]:
        """The root layer and its sublayers, strongest first; then those of the asset's contents,
        which it has as payload."""
        stack = list(self.stage.GetLayerStack(includeSessionLayers=False))
        loaded = {layer.realPath: layer for layer in self.stage.GetUsedLayers()}
        roots = [layer for layer in stack if record_of(layer).get("role") == "root"]
        for root in roots:
            contents = located(root, "layers/contents.usda")
            stack += _with_sublayers(loaded.get(str(contents)), loaded)
        return tuple(dict.fromkeys(stack))

    @cached_property
    def own_layers(self) -> tuple[Sdf.Layer, ...]:
        """Those that the pipeline writes again: not the root layer, nor the artist's.

        The record alone does not tell: an adopted copy of a layer of ours is the artist's.
        """
        return tuple(layer for layer in self.layers if self._is_own(layer))

    def _is_own(self, layer: Sdf.Layer) -> bool:
        if self.asset is None or not layer.realPath:
            return False
        path = Path(layer.realPath)
        # In a published version the edits lie there, too.
        placed = path.parent == self.asset.folder / "layers" and path != self.asset.edits_layer
        return bool(placed and record_of(layer))

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
    def expected_sublayers(self) -> tuple[tuple[Sdf.Layer, list[Path], list[Path]], ...]:
        """The root layer and contents.usda: the sublayers that they name, and those that they
        should, strongest first."""
        root, asset = self.asset_root, self.asset
        if not root or not asset:
            return ()
        roles = [*reversed(ROLES)]
        interfaces = [asset.interface(role) for role in roles]
        expected = {asset.root_layer: [asset.edits_layer, *interfaces]}
        expected[asset.contents_layer] = [*(asset.layer(role) for role in roles), interfaces[-1]]
        return tuple(
            (layer, [located(layer, path) for path in layer.subLayerPaths], wanted)
            for layer in self.layers
            if (wanted := expected.get(Path(layer.realPath)))
        )

    @cached_property
    def missing_layers(self) -> Mapping[Path, Sdf.Layer]:
        """Layers that an asset of ours consists of and that are not there, each with the layer that
        is to name it. What they hold is gone with them: that it is says nothing more."""
        missing = {
            path: holder
            for holder, _, expected in self.expected_sublayers
            for path in expected
            if not path.is_file()
        }
        root, asset = self.asset_root, self.asset
        # A package has its layers inside, and is no folder.
        if (
            root
            and asset
            and not (root.GetFileFormat().IsPackage() or asset.contents_layer.is_file())
        ):
            missing[asset.contents_layer] = root
        return missing

    @cached_property
    def scopes(self) -> Scopes | None:
        return Scopes.of(self.asset) if self.asset else None

    @cached_property
    def root_prim(self) -> Usd.Prim | None:
        """The prim that has the looks."""
        prim = self.stage.GetPrimAtPath(self.scopes.root) if self.scopes else None
        return prim if prim and prim.IsValid() else None

    @cached_property
    def recorded(self) -> tuple[Usd.Prim, ...]:
        """All prims that have an attribute of ours, wherever the stage got them from."""
        prims = self.stage.Traverse()
        return tuple(p for p in prims if p.GetAuthoredPropertiesInNamespace("usdBrdf"))

    @cached_property
    def objects(self) -> tuple[Usd.Prim, ...]:
        """The meshes that are objects of the capture."""
        return tuple(prim for prim in self.recorded if authored(prim, "usdBrdf:label") is not None)

    @cached_property
    def cameras(self) -> tuple[Usd.Prim, ...]:
        """The cameras with photographs."""
        name = "usdBrdf:capture:pinhole"
        return tuple(p for p in self.recorded if authored(p, name) is not None)

    @cached_property
    def asset_paths(self) -> tuple[tuple[Sdf.Layer, Sdf.Path, str], ...]:
        """Every path that a layer of the stage names, or one of the asset's folder that it reaches
        by a reference, payload or clip, of all variants: (layer, spec, path). In metadata the spec
        is the empty path. A package names its own content, and does not count."""
        stack = self.stage.GetLayerStack(includeSessionLayers=True)
        reached = [
            layer
            for layer in self.stage.GetUsedLayers()
            if self.asset
            and layer not in stack
            and layer not in self.layers
            and not layer.GetFileFormat().IsPackage()
            and not Ar.IsPackageRelativePath(layer.identifier)
            and Path(layer.realPath).is_relative_to(self.asset.folder)
        ]
        reached.sort(key=lambda layer: str(layer.realPath))
        layers = (*self.layers, *reached)
        return tuple((layer, *found) for layer in layers for found in _asset_paths(layer))

    @cached_property
    def identifiers(self) -> tuple[str, ...]:
        """Those of the objects that can be names of prims."""
        names = (str(authored(item, "usdBrdf:identifier") or "") for item in self.objects)
        return tuple(name for name in names if self.scopes and Sdf.Path.IsValidIdentifier(name))

    @cached_property
    def looks(self) -> Mapping[str, Usd.Stage]:
        """The stage in each of its looks, the selected one first: what objects wear in a look is
        composed in it alone. The other stages hold as long as this does, and edit what the stage
        edits. A look whose variant has no material, as in an asset by an earlier version, shows no
        more than the stage does, and is not composed once more."""
        root = self.root_prim
        if not root:
            return {"": self.stage}
        chosen = root.GetVariantSet(VARIANT_SET)
        found = {str(chosen.GetVariantSelection()): self.stage}
        for look in chosen.GetVariantNames():
            if look not in found:
                found[look] = self.stage
                if self._is_dressed(look):
                    found[look] = with_variant(self.stage, root, VARIANT_SET, look)
        return found

    def _is_dressed(self, look: str) -> bool:
        root = Sdf.Path(self.scopes.root if self.scopes else "/")
        variant = root.AppendVariantSelection(VARIANT_SET, look)
        layers = [layer for layer in self.stage.GetUsedLayers() if layer.GetPrimAtPath(variant)]
        return any(
            layer.GetPrimAtPath(place.ReplacePrefix(root, variant))
            for place in self._wardrobes(of_looks=True)
            for layer in layers
        )

    def _wardrobes(self, *, of_looks: bool) -> Iterator[Sdf.Path]:
        """The scopes of the objects' materials, or of what they wear in the looks of maps."""
        if scopes := self.scopes:
            for name in self.identifiers:
                one = scopes.look(name, "x") if of_looks else scopes.material(name)
                yield Sdf.Path(one).GetParentPath()

    def _worn(self, *, of_looks: bool) -> Iterator[Usd.Prim]:
        """The prims below these scopes; of what is worn in the looks, of all, each path once."""
        seen: set[Sdf.Path] = set()
        stages = dict.fromkeys(self.looks.values()) if of_looks else [self.stage]
        for stage in stages:
            prims = map(stage.GetPrimAtPath, self._wardrobes(of_looks=of_looks))
            for below in (each for prim in prims if prim for each in Usd.PrimRange(prim)):
                if below.GetPath() not in seen:
                    seen.add(below.GetPath())
                    yield below

    def shaders(self, identifier: str, *, of_looks: bool) -> Iterator[UsdShade.Shader]:
        """The shaders with an ``info:id`` of the objects' materials, or of what they wear in the
        looks that show maps; of all looks, each path once."""
        for prim in self._worn(of_looks=of_looks):
            shader = UsdShade.Shader(prim)
            if shader and shader.GetShaderId() == identifier:
                yield shader

    def only_in_other_looks(self) -> list[list[Usd.Prim]]:
        """What is worn in looks that are not selected, one list for each."""
        found: dict[Usd.Stage, list[Usd.Prim]] = {}
        for prim in self._worn(of_looks=True):
            if prim.GetStage() != self.stage:
                found.setdefault(prim.GetStage(), []).append(prim)
        return list(found.values())

    def surface_of(self, item: Usd.Prim) -> UsdShade.Shader | None:
        """The UsdPreviewSurface of an object's measured material; None where there is none."""
        identifier = str(authored(item, "usdBrdf:identifier") or "")
        if not self.scopes or not Sdf.Path.IsValidIdentifier(identifier):
            return None
        path = self.scopes.material(identifier)
        material = UsdShade.Material(self.stage.GetPrimAtPath(path))
        shader = material.ComputeSurfaceSource()[0] if material else None
        return shader if shader and shader.GetShaderId() == "UsdPreviewSurface" else None

    def is_measured(self, attribute: Usd.Attribute) -> bool:
        """Whether the opinion that wins comes from a layer of ours, not from the artist."""
        stack = attribute.GetPropertyStack(Usd.TimeCode.Default())
        # Not all are in the root's layer stack: those of one of several lightings are referenced.
        return bool(stack) and self._is_own(stack[0].layer)

    def own_variants(self, name: str) -> set[str]:
        """Those that layers of ours have of a set of the root prim; the artist may add others."""
        root = self.root_prim
        specs = [layer.GetPrimAtPath(root.GetPath()) for layer in self.own_layers] if root else []
        sets = [spec.variantSets.get(name) for spec in specs if spec]
        return set[str]().union(*(found.variants.keys() for found in sets if found))


def _with_sublayers(layer: Sdf.Layer | None, loaded: Mapping[str, Sdf.Layer]) -> list[Sdf.Layer]:
    """A layer that a stage has, and those below it, strongest first; none where it has it not."""
    if layer is None:
        return []
    below = (loaded.get(str(located(layer, path))) for path in layer.subLayerPaths)
    return [layer, *(each for sub in below for each in _with_sublayers(sub, loaded))]


def located(layer: Sdf.Layer, asset_path: str) -> Path:
    """Where a path that a layer names leads, whether or not there is a file; of one in a package
    into that."""
    if layer.GetFileFormat().IsPackage() or Ar.IsPackageRelativePath(layer.realPath):
        return Path(layer.ComputeAbsolutePath(asset_path))
    return Path(os.path.normpath(Path(layer.realPath).parent / asset_path))


def _asset_paths(layer: Sdf.Layer) -> list[tuple[Sdf.Path, str]]:
    found = [(Sdf.Path.absoluteRootPath, path) for path in layer.subLayerPaths]

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec):
            for arcs in (spec.referenceList, spec.payloadList):
                found.extend((path, arc.assetPath) for arc in arcs.GetAddedOrExplicitItems())
        elif isinstance(spec, Sdf.AttributeSpec) and spec.typeName in _ASSET_TYPES:
            times = layer.ListTimeSamplesForPath(path)
            for value in (spec.default, *(layer.QueryTimeSample(path, time) for time in times)):
                items = [value] if isinstance(value, Sdf.AssetPath) else value or []
                found.extend((path, x.path) for x in items if isinstance(x, Sdf.AssetPath))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    metadata = named_files(layer) - {value for _, value in found}
    found.extend((Sdf.Path.emptyPath, value) for value in sorted(metadata))
    return [(path, value) for path, value in found if value]


Site: TypeAlias = "Usd.Prim | Usd.Property | Sdf.Layer"


class Severity(str, Enum):
    """An error shows in pictures or numbers; a warning is likely not what was meant."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True)
class Fault:
    """One thing that a rule does not accept; ``severity`` only where it is not the rule's own."""

    site: Site
    message: str
    severity: Severity | None = None


@dataclass(frozen=True, kw_only=True)
class Cure:
    """What sets a fault right beyond doubt.

    ``apply`` authors at the edit target of the site's stage and returns whether it could. It never
    chooses a layer: whoever calls it does.
    """

    name: str
    description: str
    apply: Callable[[Site], bool]


Check: TypeAlias = Callable[[AssetStage], Iterator[Fault]]


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A rule about stages of ours.

    description  what is wrong, and what comes of it
    advice       what to do
    check        the faults of a stage; none for a stage that the rule is not about
    """

    name: str
    severity: Severity
    description: str
    advice: str
    check: Check
    cure: Cure | None = None


def cure(description: str) -> Callable[[Callable[[Site], bool]], Cure]:
    """Decorates what authors a cure: the cure of its name (``read_raw`` becomes ReadRaw)."""
    return lambda apply: Cure(name=_title(apply), description=description, apply=apply)


def rule(severity: Severity, cure: Cure | None = None) -> Callable[[Check], Rule]:
    """Decorates a check: the rule of its name (``layer_missing`` becomes LayerMissing). The last
    paragraph of its docstring is the advice, what stands before is the description."""

    def made(check: Check) -> Rule:
        text, advice = (" ".join(part.split()) for part in str(check.__doc__).rsplit("\n\n", 1))
        name = _title(check)
        return Rule(
            name=name, severity=severity, description=text, advice=advice, check=check, cure=cure
        )

    return made


def _title(function: Callable[..., object]) -> str:
    return function.__name__.title().replace("_", "")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fault in words.

    site   the prim or property in <>; of a file its default prim
    layer  in @@ the file itself; of a property the layer whose opinion wins; else the root layer
    """

    severity: Severity
    site: str
    layer: str
    message: str
    rule: str

    def __str__(self) -> str:
        return f"{self.severity.value}: {self.site} {self.layer}: {self.message} [{self.rule}]"

    @staticmethod
    def at(sites: Sequence[Site], severity: Severity, message: str, rule: str) -> Finding:
        """Of one or several sites, the first of which tells the layer."""
        paths = [
            f"/{site.defaultPrim.lstrip('/')}" if isinstance(site, Sdf.Layer) else site.GetPath()
            for site in sites
        ]
        layer = first = sites[0]
        if not isinstance(first, Sdf.Layer):
            layer = first.GetStage().GetRootLayer()
        if isinstance(first, Usd.Property):
            stack = first.GetPropertyStack(Usd.TimeCode.Default())
            layer = stack[0].layer if stack else layer
        return Finding(
            severity=severity,
            site=", ".join(f"<{path}>" for path in paths),
            layer=f"@{layer.realPath or layer.identifier}@",
            message=message,
            rule=rule,
        )


def finding_of(rule: Rule, fault: Fault) -> Finding:
    """A fault of one of our rules in words."""
    severity = fault.severity or rule.severity
    return Finding.at([fault.site], severity, fault.message, f"{PREFIX}.{rule.name}")
