"""Every look of an asset as Hydra Storm shows it, in one picture.

    USDBRDF_BPY_PYTHON=... python benchmarks/look_sheet.py ASSET OUT.png [FRAME]

From the capture's camera at time code FRAME (default 1), row by row in the order that is printed.
Storm traces no light: in the look `shaded` two distant lights stand for the lamps. Radiance of the
others is shown as the look says.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from blender import in_blender
from pxr import Gf, Sdf, Usd, UsdLux

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.header import Scopes
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_edited
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import read_radiance, write_preview_png

WIDTH, ACROSS = 172, 5
# Degrees about x, y, z, irradiance; from above whatever way is up.
LIGHTS = (((-50, 30, 0), 2.0), ((50, -30, 0), 1.0))


def main(folder: Path, out: Path, frame: int) -> None:
    asset = Asset.at(folder)
    stage = open_edited(asset)
    names = list(stage.GetDefaultPrim().GetVariantSets().GetVariantSet("look").GetVariantNames())
    names.sort(key=lambda name: (name != "shaded", name))
    with tempfile.TemporaryDirectory() as temporary:
        pictures = [picture(asset, name, frame, Path(temporary)) for name in names]
    height = min(p.shape[0] for p in pictures)
    blank = np.zeros((height, WIDTH, 3), np.uint8)
    pictures = [p[:height] for p in pictures] + [blank] * (-len(names) % ACROSS)
    rows = [np.hstack(pictures[i : i + ACROSS]) for i in range(0, len(pictures), ACROSS)]
    write_preview_png(out, np.vstack(rows))
    print(", ".join(names))


def picture(asset: Asset, look: str, frame: int, work: Path) -> np.ndarray:
    """(H, WIDTH, 3) sRGB bytes."""
    layer = Sdf.Layer.CreateNew(str(work / f"{look}.usda"))
    layer.subLayerPaths = [str(asset.root_layer.absolute())]
    root = Sdf.CreatePrimInLayer(layer, f"/{asset.name}")
    root.variantSelections["look"] = look
    stage = Usd.Stage.Open(layer)
    for number, (turn, irradiance) in enumerate(LIGHTS):
        light = UsdLux.DistantLight.Define(stage, f"/light{number}")
        light.CreateAngleAttr(1.0)
        light.CreateIntensityAttr(float(irradiance / (np.pi * np.sin(np.radians(0.5)) ** 2)))
        light.AddRotateXYZOp().Set(Gf.Vec3f(*turn))
    layer.Save()
    file = work / f"{look}.exr"
    camera = Scopes.of(asset).path("cameras", "capture")
    job = {
        "layer": layer.realPath,
        "frames": [{"camera": camera, "time": frame, "width": WIDTH, "out": str(file)}],
    }
    in_blender("storm_views", work, job)
    return to_display_srgb8(read_radiance(file)[..., :3], exposure_scale=1.0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 1)
