"""The asset as it lies on disk -> what cameras see of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.asset.header import read_header
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.objects import read_fit
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.render_view import ViewedAsset
from usdbrdf.tasks.surroundings import environment_from_file


def measured_atlas(folder: Path) -> tuple[Asset, AssetMaps]:
    """The maps of an asset that all steps have been through, without the artist's layer."""
    asset = Asset.at(folder)
    if not asset.root_layer.is_file():
        raise InputRefused(f"{folder}: there is no asset in this folder. [asset.missing]")
    return asset, AssetMaps(open_measured(asset))


def map_or(atlas: AssetMaps, aov: str, otherwise: str) -> str:
    """The name of the first map where the asset has it, else of the second."""
    return aov if atlas.has(aov) else otherwise


def viewed_asset(asset: Asset, atlas: AssetMaps, environment: Path | None) -> ViewedAsset:
    """Its light, its diffuse radiance (``diffuse``, else ``lit``), its lobes as the fit left them.

    environment  latitude-longitude picture of the surroundings, None: black
    """
    fits = [read_fit(atlas.stage, obj.prim_path) for obj in atlas.scene.objects]
    if any(fit is None for fit in fits):
        raise InputRefused(
            f"{asset.folder}: its objects have no roughness and specular yet. Run `usdbrdf fit` "
            "first. [asset.incomplete]"
        )
    up_axis = read_header(asset.layer("scan")).up_axis
    lit = atlas.lit_scene(environment_from_file(environment, up_axis))
    diffuse = atlas.map_where_present(map_or(atlas, "diffuse", "lit"), 3)
    return ViewedAsset(
        lit=lit,
        measured=lit.radiance.showing(atlas.texels, atlas.map("lit")),
        diffuse=lit.radiance.showing(atlas.texels, diffuse),
        phi=np.array([fit.phi for fit in fits if fit], np.float32),
        psi=np.array([fit.psi for fit in fits if fit], np.float32),
    )
