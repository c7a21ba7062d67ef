"""Keeping what somebody edited by hand in files that the tool is about to write again."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from pxr import Sdf, Tf, UsdUtils

from usdbrdf.asset.layout import LIGHTING, ROLES, Asset, relative_path
from usdbrdf.asset.readers.compose import in_one_line, try_in_child
from usdbrdf.asset.readers.tried import try_layers
from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict
from usdbrdf.files.atomic import cure_of_writing, make_folders, publish, temporary_beside

_LAYER_SUFFIXES = frozenset({".usd", ".usda", ".usdc"})


def adopt(asset: Asset, edited: Sequence[Path]) -> list[Path]:
    """Copy edited tool-owned files beside edits.usda and return the copies, for the artist to use.
    A layer becomes adopted-N.usda: text, its paths made right for the new place; one of a single
    lighting holds in that alone. Other files go to
    a folder adopted-N/, and the layers that are adopted with them point there. The artist adds
    adopted-N.usda to the sublayers of edits.usda, which is not touched, or takes parts of it.
    All of it is on the disk when this returns: what was edited is about to be replaced."""
    layers = [path for path in edited if path.suffix in _LAYER_SUFFIXES]
    others = [path for path in edited if path.suffix not in _LAYER_SUFFIXES]
    stems = (asset.folder / f"adopted-{n}" for n in itertools.count(1))
    free = (
        stem
        for stem in stems
        if not (os.path.lexists(stem) or os.path.lexists(stem.with_suffix(".usda")))
    )
    copies: dict[Path, Path] = {}
    if others:
        folder = next(free)
        for path in others:
            # The same name may occur in several folders.
            target = copies[path] = folder / path.absolute().relative_to(asset.folder)
            make_folders(target.parent)
            with temporary_beside(target) as copy:
                shutil.copyfile(path, copy)
                publish(copy, target)
    adopted = [next(free).with_suffix(".usda") for _ in layers]
    for path, target in zip(layers, adopted, strict=True):
        _adopt_layer(path, target, asset, copies)
    return [*adopted, *copies.values()]


def is_damaged(path: Path) -> bool:
    """Whether a file is a binary layer that USD cannot read, which is nobody's edit; in text, that
    may be an artist's slip. What it refers to need not be there."""
    if path.suffix != ".usdc":
        return False
    try:
        try_in_child(path, composes=False)
        return not Sdf.Layer.OpenAsAnonymous(str(path))
    except (InputRefused, Tf.ErrorException):
        return True


def _lighting_of(path: Path, asset: Asset) -> str:
    """The lighting that a layer is of alone; "" where it is of all."""
    for one in asset.in_each_lighting:
        own = [*map(one.layer, ROLES), one.lights_layer] if one.lighting else []
        if path.name in {layer.name for layer in own} - {asset.layer("scan").name}:
            return one.lighting
    return ""


def _confine_to(lighting: str, layer: Sdf.Layer) -> None:
    """Move what a layer says of the default prim into a variant of the set ``lighting``: in the
    root layer's stack it would hold in all of them."""
    whole, root = Sdf.Layer.CreateAnonymous(".usda"), Sdf.Path(f"/{layer.defaultPrim}")
    whole.TransferContent(layer)
    if not whole.GetPrimAtPath(root):
        return
    del layer.rootPrims[root.name]
    variant = root.AppendVariantSelection(LIGHTING, lighting)
    Sdf.CreatePrimInLayer(layer, variant)
    Sdf.CopySpec(whole, root, layer, variant)


def _adopt_layer(path: Path, target: Path, asset: Asset, copies: Mapping[Path, Path]) -> None:
    try:
        try_layers([path])
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
        text = Sdf.Layer.CreateAnonymous(".usda")
        text.TransferContent(layer)
    except (Tf.ErrorException, TypeError, InputRefused) as error:
        raise OwnershipConflict(
            f"{path}: the layer was edited and USD cannot read it any more, so its edits cannot be "
            "adopted. Repair it, or give it up with --discard. [ownership.unreadable]"
        ) from error
    copied = {os.path.realpath(source): copy for source, copy in copies.items()}

    def from_new_place(asset_path: str) -> str:
        if not asset_path.startswith(("./", "../")):
            return asset_path
        file = Path(os.path.normpath(path.parent / asset_path))
        return relative_path(copied.get(os.path.realpath(file), file), asset.folder)

    # The tool's own sublayers stay where they are: they are in the stage anyway.
    lights = (one.lights_layer for one in asset.in_each_lighting)
    own = {f"./{sub.name}" for sub in (asset.uv_layer, asset.materialx_layer, *lights)}
    text.subLayerPaths = [sub for sub in layer.subLayerPaths if sub not in own]
    UsdUtils.ModifyAssetPaths(text, from_new_place)
    if lighting := _lighting_of(path, asset):
        _confine_to(lighting, text)
    text.documentation = (
        f"Adopted from {path.absolute().relative_to(asset.folder).as_posix()}, which was edited by "
        "hand. Add this layer to the sublayers of edits.usda, or take from it what you need."
    )
    with temporary_beside(target) as written:
        try:
            text.Export(str(written))
        except Tf.ErrorException as error:
            raise EnvironmentFailure(
                f"{target}: USD could not write it ({in_one_line(error)}). "
                f"{cure_of_writing(written)}, then run the same command again. [environment.io]"
            ) from error
        publish(written, target)
