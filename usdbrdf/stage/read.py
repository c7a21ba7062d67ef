"""From USD back to values: one place to import from."""

from usdbrdf.stage.compose import open_edited, open_measured, open_stage, open_weaker
from usdbrdf.stage.frames_from_stage import capture_camera, frames_from_stage
from usdbrdf.stage.header import read_header, read_provenance
from usdbrdf.stage.objects_from_stage import (
    aov_path,
    read_aovs,
    read_fit,
    read_shading,
    read_texturing,
)
from usdbrdf.stage.scene_from_stage import given_corner_uv, scene_from_stage

__all__ = [
    "aov_path",
    "capture_camera",
    "frames_from_stage",
    "given_corner_uv",
    "open_edited",
    "open_measured",
    "open_stage",
    "open_weaker",
    "read_aovs",
    "read_fit",
    "read_header",
    "read_provenance",
    "read_shading",
    "read_texturing",
    "scene_from_stage",
]
