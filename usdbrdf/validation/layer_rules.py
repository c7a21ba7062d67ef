"""Rules about the layers of an asset: all there, in order, of one mind, of a known version."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pxr import Sdf

from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.properties import SCHEMA_VERSION
from usdbrdf.job.ownership import edited_files
from usdbrdf.validation.asset_stage import AssetStage, located, record_of
from usdbrdf.validation.rule import Fault, Severity, rule

_HEADER = ("metersPerUnit", "upAxis", "timeCodesPerSecond")


@rule(
    Severity.ERROR,
    advice="Run usdbrdf convert again, which makes what is missing; or restore the sublayers of "
    "the root layer.",
)
def layer_missing(scene: AssetStage) -> Iterator[Fault]:
    """The root layer names edits.usda and the layers of all stages, and they are there. USD passes
    over a missing sublayer with a message that is easily lost."""
    if scene.asset and scene.asset_root:
        named = _named(scene.asset_root)
        for layer in _expected(scene.asset):
            if layer not in named:
                yield Fault(scene.asset_root, f"@{layer}@ is not among its sublayers.")
            elif not layer.is_file():
                yield Fault(scene.asset_root, f"its sublayer @{layer}@ is not there.")


@rule(
    Severity.ERROR, advice="Restore the order in the root layer; mute a layer instead of moving it."
)
def layer_order(scene: AssetStage) -> Iterator[Fault]:
    """Strongest first the sublayers are edits.usda, material, shading, texturing, scan. In another
    order the lobe of a material is hidden by the stage before it, or the artist's edits by a
    measurement. Other layers may stand between them. lights, texturing_uv and materialx are no
    sublayers of the root, but of the layers that own them."""
    if scene.asset and scene.asset_root:
        expected = _expected(scene.asset)
        found = [layer for layer in _named(scene.asset_root) if layer in expected]
        if found != [layer for layer in expected if layer in found]:
            yield Fault(
                scene.asset_root,
                f"the sublayers are in the order {', '.join(p.name for p in found)}; "
                f"strongest first it is {', '.join(p.name for p in expected)}.",
            )


def _expected(asset: Asset) -> list[Path]:
    """The sublayers of the root layer, strongest first."""
    return [asset.edits_layer, *(asset.layer(role) for role in reversed(ROLES))]


def _named(root: Sdf.Layer) -> list[Path]:
    return [located(root, path) for path in root.subLayerPaths]


@rule(
    Severity.ERROR,
    advice="Correct the metadata of the layer, or bring it in by a reference with a correcting "
    "transform.",
)
def layer_header(scene: AssetStage) -> Iterator[Fault]:
    """No layer states other units, another up axis or another rate of time codes than the root
    layer. USD believes the root for the first two, so that the layer's content has the wrong size
    or lies on its side, and rescales its time samples for the third: photographs then meet the
    wrong poses."""
    root = scene.asset_root
    if root:
        for layer in scene.layers:
            for name in _HEADER:
                theirs, ours = _authored(layer, name), _authored(root, name)
                if theirs is not None and ours is not None and theirs != ours:
                    yield Fault(layer, f"{name} is {theirs}, but {ours} in @{root.realPath}@.")


def _authored(layer: Sdf.Layer, name: str) -> Any:
    return layer.pseudoRoot.GetInfo(name) if layer.pseudoRoot.HasInfo(name) else None


@rule(Severity.ERROR, advice="Install the version of usdbrdf that wrote the asset.")
def schema_version(scene: AssetStage) -> Iterator[Fault]:
    """The layers state a version of the usdBrdf schemas (customLayerData.usdbrdf.schemaVersion)
    that this usdbrdf knows. In a newer one an attribute may mean something else."""
    for layer in scene.layers:
        # The layers of the first version do not state it.
        version = record_of(layer).get("schemaVersion", 1)
        if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
            yield Fault(
                layer,
                f"its schema version is {version!r}; this usdbrdf knows 1 to {SCHEMA_VERSION}.",
            )


@rule(
    Severity.WARNING,
    advice="Keep them with usdbrdf convert --adopt, or give them up with --discard.",
)
def layer_edited(scene: AssetStage) -> Iterator[Fault]:
    """Layers and textures that the pipeline wrote are as it wrote them. Edits belong into
    edits.usda: those made elsewhere stop the next run, or are lost with it."""
    if scene.asset and scene.asset_root:
        for relative in edited_files(scene.asset.folder):
            yield Fault(
                scene.asset_root,
                f"@{scene.asset.folder / relative}@ was edited by hand: the next run would "
                "write it again, and refuses to.",
            )


RULES = (layer_missing, layer_order, layer_header, schema_version, layer_edited)
