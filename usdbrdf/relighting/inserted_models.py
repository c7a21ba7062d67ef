"""Files of others as they are put into a scene: models, and USD with meshes and lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.asset.readers.render_scene import RenderScene, render_scene_from_file
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.job.progress import warn
from usdbrdf.model.arrays import Float
from usdbrdf.model.light import DistantLight, ShapeLight, SkyLight
from usdbrdf.model.material import Material, Surface
from usdbrdf.untrusted.mesh_files import model_from_file
from usdbrdf.untrusted.usd_files import render_scene_of_usd

_CREASE_ANGLE_DEG = 40.0


def surfaces_from_model(path: Path) -> tuple[Surface, ...]:
    """The meshes of an OBJ, PLY or GLB file, in the file's own axes and units.

    Meshes that bring no normals are smooth where their faces meet at less than 40 degrees.
    """
    return tuple(
        replace(surface, corner_normals=_smooth(surface))
        if np.isnan(surface.corner_normals).any()
        else surface
        for surface in model_from_file(path)
    )


def _smooth(surface: Surface) -> Float:
    points = np.asarray(surface.points, np.float32)
    return corner_normals(points, surface.triangles, _CREASE_ANGLE_DEG)


def render_scene_of_others(path: Path, allow: Sequence[Path]) -> RenderScene:
    """Surfaces and lights of a USD file that is not ours; what is left out is said.

    allow  folders outside the file's own that its asset paths may lead into
    """
    parts = (RenderScene, Surface, Material, ShapeLight, DistantLight, SkyLight)
    reader = f"{__name__}:read_published_here"
    found, warnings = render_scene_of_usd(path, reader, allow=allow, parts=parts)
    for sentence in warnings:
        warn(sentence)
    assert isinstance(found, RenderScene)
    return found


def read_published_here(path: Path) -> tuple[RenderScene, list[str]]:
    """``render_scene_of_others`` in this process, which is to be a child, and its warnings."""
    warnings: list[str] = []
    return render_scene_from_file(path, warnings.append), warnings
