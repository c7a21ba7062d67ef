"""The layers that hold no measurement: root, the artist's edits, and layers still to come."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.asset.header import Provenance, Scopes, StageHeader, new_layer, read_header
from usdbrdf.asset.layers.author import export, over
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.errors import OwnershipConflict

_VERSION = "1"  # of the folder's layout; these layers outlive the version of the tool


def write_root(path: Path, asset: Asset, header: StageHeader) -> None:
    """NAME.usda: the sublayers, strongest first, and metadata. Written once, never again."""
    layer = new_layer(header, Provenance(role="root", version=_VERSION))
    layer.documentation = (
        "Captured scene with measured materials. Put your own opinions into edits.usda, the "
        "strongest layer: no tool writes it again. The files in layers/ are regenerated."
    )
    layer.subLayerPaths = [
        f"./{asset.edits_layer.name}",
        *(f"./layers/{asset.layer(role).name}" for role in reversed(ROLES)),
    ]
    # Only a root layer can say this. The scan layer may still be waiting beside it, unpublished.
    staged = Asset(path.parent, asset.name)
    scopes = Scopes.of(staged if staged.layer("scan").is_file() else asset)
    layer.pseudoRoot.SetInfo("renderSettingsPrimPath", scopes.path("render", "capture"))
    export(layer, path, folder=asset.folder)


def check_root(asset: Asset, header: StageHeader) -> None:
    """Raise if the asset has a root layer that says otherwise about units or the up axis.

    USD believes the root, which is never written again: a capture in other units would come out
    in the wrong size, beneath edits that were made for the old one.
    """
    if not asset.root_layer.is_file():
        return
    root = read_header(asset.root_layer)
    ours, theirs = ((h.meters_per_unit, h.up_axis) for h in (root, header))
    if ours != theirs:
        raise OwnershipConflict(
            f"{asset.root_layer}: the asset was made with {ours[0]:g} metres per unit and "
            f"{ours[1]} up, this capture has {theirs[0]:g} and {theirs[1]}. Convert it into a new "
            "folder. [ownership.units]"
        )


def write_edits(path: Path, asset: Asset, header: StageHeader) -> None:
    """edits.usda: empty, for the artist. Written once, never again."""
    layer = new_layer(header, Provenance(role="edits", version=_VERSION))
    layer.documentation = "Yours: stronger than everything that was measured, never overwritten."
    over(layer, f"/{header.name}")
    export(layer, path, folder=asset.folder)


def write_pending_layer(path: Path, role: str, header: StageHeader) -> None:
    """A layer without opinions, so that the root composes before the task of its role has run."""
    layer = new_layer(header, Provenance(role=role, version=_VERSION), state="pending")
    over(layer, f"/{header.name}")
    export(layer, path, folder=path.parent)
