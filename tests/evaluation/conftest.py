"""Small captures of one room and their assets, made once; they are only read."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Sdf

import usdbrdf
from tests.scenes import MadeCapture, make_capture, turned_capture
from usdbrdf.evaluation.evaluate_views import measured_atlas
from usdbrdf.files.images import write_exr
from usdbrdf.job.progress import set_quiet


@dataclass(frozen=True, kw_only=True)
class Made:
    """A capture and the asset that was made from it."""

    capture: MadeCapture
    asset: Path


@pytest.fixture(autouse=True)
def silence():
    set_quiet(True)
    yield
    set_quiet(False)


@pytest.fixture(scope="session")
def make(tmp_path_factory) -> Callable[..., Made]:
    """make(texel_size, ingest options, **make_capture's)"""

    def make(
        texel_size: float = 0.15, ingest: usdbrdf.IngestOptions | None = None, **capture: Any
    ) -> Made:
        set_quiet(True)
        folder = tmp_path_factory.mktemp("made")
        made = make_capture(folder / "scan", **capture)
        # They are as bright everywhere, which no light explains.
        objects = folder / "scan" / "objects.json"
        document = json.loads(objects.read_text("utf-8"))
        (walls,) = (item for item in document["objects"] if item["name"] == "walls")
        walls["directive"] = "not-lamp"
        objects.write_text(json.dumps(document), "utf-8")
        converted(made.folder, folder / "room", texel_size, ingest)
        return Made(capture=made, asset=folder / "room")

    return make


def converted(
    capture: Path, asset: Path, texel_size: float, ingest: usdbrdf.IngestOptions | None
) -> None:
    """Convert a capture in next to no time."""
    options = usdbrdf.ConvertOptions(
        ingest=ingest or usdbrdf.IngestOptions(),
        texture=usdbrdf.TextureOptions(texel_size=texel_size),
        shade=usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64)),
        fit=usdbrdf.FitOptions(method="paper", max_pixels=50),
    )
    usdbrdf.convert(capture, asset, options)


@pytest.fixture(scope="session")
def turned(room, tmp_path_factory) -> Path:
    """The asset of the same room, captured with x up."""
    folder = tmp_path_factory.mktemp("turned")
    capture = turned_capture(room.capture, folder / "scan", "X")
    ingest = usdbrdf.IngestOptions(up_axis="X", allow_outside=(room.capture.folder,))
    converted(capture, folder / "room", 0.15, ingest)
    return folder / "room"


@pytest.fixture(scope="session")
def room(make) -> Made:
    return make()


@pytest.fixture(scope="session")
def separated(room, tmp_path_factory) -> Made:
    """The room with ``diffuse`` and ``base_color``, half of ``lit`` and ``albedo``, and with its
    irradiance again as ``refined_irradiance``."""
    folder = tmp_path_factory.mktemp("separated") / "room"
    shutil.copytree(room.asset, folder)
    asset, atlas = measured_atlas(folder)
    layer = Sdf.Layer.FindOrOpen(str(asset.layer("material")))
    maps = {"diffuse": ("lit", 0.5), "base_color": ("albedo", 0.5)}
    maps["refined_irradiance"] = ("irradiance", 1.0)
    for name, (of, factor) in maps.items():
        values = (factor * atlas.map(of)).astype(np.float32)
        for i, obj in enumerate(atlas.scene.objects):
            file = asset.texture(obj.identifier, name)
            write_exr(folder / file, atlas.texels.image(i, values))
            prim = Sdf.CreatePrimInLayer(layer, obj.prim_path)
            attribute = Sdf.AttributeSpec(
                prim, f"usdBrdf:aov:{name}:file", Sdf.ValueTypeNames.Asset
            )
            attribute.default = Sdf.AssetPath(f"../{file}")
    layer.Save()
    return Made(capture=room.capture, asset=folder)
