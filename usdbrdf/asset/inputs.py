"""What a task reads of an asset: the layers before its own, and the hashes that its stamp holds."""

from __future__ import annotations

from pathlib import Path

from pxr import Usd

from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.hashes import hash_of_files


def open_before(asset: Asset, role: str) -> Usd.Stage:
    """The stage that tasks before that of ``role`` wrote; InputRefused where one has not run."""
    for layer in _weaker_layers(asset, role):
        if not layer.is_file():
            raise InputRefused(
                f"{asset.folder}: {layer.name} is missing, so an earlier step has not run here. "
                "Run `usdbrdf convert`, or the steps ingest, texture, shade, fit in this order. "
                "[asset.incomplete]"
            )
    return open_weaker(asset, role)


def hashes_of_inputs(
    asset: Asset,
    role: str,
    maps: AssetMaps,
    *,
    aovs: tuple[str, ...] = (),
    photographs: bool = False,
    environment: Path | None = None,
) -> dict[str, str]:
    """By label the SHA-256 of all that a task of ``role`` reads: the weaker layers and the USD
    geometry that they refer to, the maps ``aovs``, the photographs, the picture of the sky."""
    layers = _weaker_layers(asset, role)
    files = {
        "geometry": maps.layers_elsewhere(asset.folder),
        "environment": [environment] if environment else [],
        "maps": asset.textures(*aovs),
        "frames": [*maps.frames.image_paths] if photographs else [],
    }
    if environment and not environment.is_file():
        raise InputRefused(
            f"{environment}: no such file. Check --environment. [shading.environment]"
        )
    by_label = {layer.name: sha256_of(layer) for layer in layers}
    return by_label | {label: hash_of_files(some) for label, some in files.items() if some}


def _weaker_layers(asset: Asset, role: str) -> list[Path]:
    layers = [asset.layer(weaker) for weaker in ROLES[: ROLES.index(role)]]
    return [*layers, asset.uv_layer] if role in ("shading", "material") else layers
