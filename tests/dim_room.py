"""A small room in which nothing but the lamp sends more than it receives, converted as it is and
told otherwise, and what is measured of its objects."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import usdbrdf
from tests.scenes import MadeCapture, make_capture, poses_down_and_up
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured

# Lengths are in metres, whatever the capture is in.
OPTIONS = usdbrdf.ConvertOptions(
    texture=usdbrdf.TextureOptions(texel_size=0.1),
    shade=usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.05, max_rays=256)),
    fit=usdbrdf.FitOptions(max_pixels=60),
)
DIM = {
    "ceiling": (0.125, 0.125, 0.125), "walls": (0.25, 0.3, 0.2), "floor": (0.25, 0.125, 0.0625),
    "box": (0.06, 0.09, 0.12), "lamp": (32.0, 28.0, 24.0),
}  # fmt: skip


def converted(
    folder: Path, subdivisions: int, otherwise: Callable[[MadeCapture], None] | None = None
) -> AssetMaps:
    """The asset of the room, whose capture ``otherwise`` may change in place of itself."""
    made = make_capture(
        folder / "scan", poses=poses_down_and_up(6, 6), subdivisions=subdivisions, radiance=DIM
    )
    if otherwise:
        otherwise(made)
    usdbrdf.convert(made.folder, folder / "asset", OPTIONS)
    return AssetMaps(open_measured(Asset.at(folder / "asset")))


def write_objects(made: MadeCapture, number: np.ndarray) -> None:
    """The document of the objects, the last one first, with new numbers."""
    objects = [
        {"id": int(number[i]), "name": name, "class_name": name}
        for i, name in enumerate(made.names)
    ]
    (made.folder / "objects.json").write_text(json.dumps({"objects": objects[::-1]}))


def means_of_objects(maps: AssetMaps, aovs: Sequence[str]) -> dict[str, dict[str, np.ndarray]]:
    """What was measured of each object: means over the area that frames show."""
    area, observed = maps.texels.area, maps.coverage.observed
    values = {aov: maps.map(aov) for aov in aovs}
    found = {}
    for i, obj in enumerate(maps.scene.objects):
        own = np.arange(len(area))[maps.texels.of_object(i)]
        seen = own[observed[own] > 0]
        found[obj.label] = {
            aov: np.average(value[seen], axis=0, weights=area[seen])
            for aov, value in values.items()
        }
    return found
