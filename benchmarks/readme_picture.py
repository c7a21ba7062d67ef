"""The picture of the README: a photograph, its base colour, and the asset in other light.

usdbrdf convert samples/study -o out/study
python benchmarks/readme_picture.py out/study -o docs/pictures/study.jpg
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

import usdbrdf
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps, camera_hits, overview_frame
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.files.atomic import publish, temporary_beside
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import encoded_jpeg, read_exr

# A lamp of its own, low in a corner of the sample's room, metres.
LIGHTS = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def SphereLight "lamp" {
    color3f inputs:color = (1, 0.62, 0.32)
    float inputs:intensity = 40
    float inputs:radius = 0.12
    double3 xformOp:translate = (0.55, 0.6, 1.35)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
WIDTH, GAP, QUALITY, SAMPLES = 288, 8, 92, 32


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    maps = AssetMaps(open_measured(Asset.at(options.asset)))
    frame = overview_frame(maps.scene, maps.surface.rays, maps.frames)
    photograph = np.nan_to_num(read_frame(maps.frames, frame).radiance)
    height = round(WIDTH * photograph.shape[0] / photograph.shape[1])
    hits = camera_hits(maps.surface.rays, maps.frames, frame, photograph.shape[1], len(photograph))
    colour = maps.surface.texture(maps.map_where_present("base_color", 3))
    base = np.asarray(colour.at(hits.face, hits.u, hits.v)).reshape(photograph.shape)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "lamp.usda").write_text(LIGHTS)
        usdbrdf.relight(
            options.asset,
            Path(folder) / "relit.exr",
            usdbrdf.RelightOptions(
                lights=Path(folder) / "lamp.usda", frame=frame + 1, width=WIDTH, samples=SAMPLES
            ),
        )
        relit = read_exr(Path(folder) / "relit.exr")
    exposures = display_exposure(photograph.reshape(-1, 3).mean(axis=1)), 1.0
    pictures = [
        enlarged(to_display_srgb8(photograph, exposure_scale=exposures[0]), height),
        enlarged(to_display_srgb8(base, exposure_scale=exposures[1]), height),
        to_display_srgb8(relit, exposure_scale=display_exposure(relit.reshape(-1, 3).mean(axis=1))),
    ]
    gap = np.full((height, GAP, 3), 255, np.uint8)
    sheet = np.concatenate([pictures[0], gap, pictures[1], gap, pictures[2]], axis=1)
    with temporary_beside(options.output) as staged:
        staged.write_bytes(encoded_jpeg(np.ascontiguousarray(sheet), QUALITY))
        publish(staged, options.output)
    return 0


def enlarged(picture: np.ndarray, height: int) -> np.ndarray:
    """Nearest pixels: what the capture does not show is not made up."""
    rows = np.arange(height) * len(picture) // height
    columns = np.arange(WIDTH) * picture.shape[1] // WIDTH
    return picture[rows[:, None], columns]


if __name__ == "__main__":
    sys.exit(main())
