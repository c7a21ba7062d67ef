"""Maps on the texels: how a step writes them, and what later steps read back."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Usd

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import Aov
from usdbrdf.asset.readers.objects import aov_path
from usdbrdf.asset.readers.scene import scene_from_stage
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Float
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.model.texels import Texels

# Half floats end at 65504. A map that must lose nothing is stored as floats from here on.
_HALF_UNTIL = 60_000

# Pictures written at a time.
_WRITERS = min(4, os.cpu_count() or 1)


@dataclass(frozen=True, kw_only=True)
class Atlas:
    """The textured scene: its texels, and the pictures that the stage names."""

    stage: Usd.Stage
    scene: Scene
    texels: Texels

    def has(self, aov: str) -> bool:
        """Whether any object has the AOV."""
        return any(aov_path(self.stage, obj.prim_path, aov) for obj in self.scene.objects)

    def map(self, aov: str) -> Float:
        """Per-texel values (T, C) float32 of an AOV that every object has."""
        own = enumerate(self.scene.objects)
        return np.concatenate(
            [self.texels.from_image(i, self._picture(obj, aov)) for i, obj in own]
        )

    def map_where_present(self, aov: str, channels: int) -> Float:
        """The same, with zeros on objects that do not have the AOV."""
        parts = []
        for i, obj in enumerate(self.scene.objects):
            own = self.texels.of_object(i)
            if aov_path(self.stage, obj.prim_path, aov) is None:
                parts.append(np.zeros((own.stop - own.start, channels), np.float32))
            else:
                parts.append(self.texels.from_image(i, self._picture(obj, aov)))
        return np.concatenate(parts)

    def _picture(self, obj: SceneObject, aov: str) -> Float:
        return _read_map(self.stage, obj, aov)


def atlas_from_stage(stage: Usd.Stage) -> Atlas:
    """Scene and texels as the texturing step left them."""
    scene = scene_from_stage(stage)
    if scene.corner_uv is None:
        raise InputRefused(
            "the stage has no texture coordinates of ours. Run `usdbrdf texture` first. "
            "[asset.incomplete]"
        )
    sizes = [_read_map(stage, obj, "coverage").shape[1::-1] for obj in scene.objects]
    return Atlas(
        stage=stage, scene=scene, texels=texels_from_atlas(scene, np.array(sizes, np.int32))
    )


def _read_map(stage: Usd.Stage, obj: SceneObject, aov: str) -> Float:
    path = aov_path(stage, obj.prim_path, aov)
    if path is None or not path.is_file():
        raise InputRefused(
            f"<{obj.prim_path}>: its map {aov!r} is missing ({path}). Run the step that makes it "
            "again. [asset.incomplete]"
        )
    return read_exr(path)


class TexelMap(NamedTuple):
    """values (T, ...) of all objects' texels; scale and unit as in ``Aov``; exact: stored as floats
    rather than clamped."""

    values: Float
    scale: float
    unit: str
    exact: bool = False


@dataclass
class MapWriter:
    """Writes the maps of a step, and counts the values that were too large for them."""

    run: TaskRun
    asset: Asset
    texels: Texels
    clamped: int = 0

    def write(self, index: int, obj: SceneObject, maps: dict[str, TexelMap]) -> tuple[Aov, ...]:
        """One object's pictures."""
        files = [self.asset.texture(obj.identifier, name) for name in maps]
        places = [self.run.output(file) for file in files]

        def written(place: Path, chosen: TexelMap) -> int:
            picture = self.texels.image(index, chosen.values)
            half = not (chosen.exact and float(np.abs(picture).max()) > _HALF_UNTIL)
            return write_exr(place, picture, half=half)

        # Compressing takes a core each, and flushing to the disk time.
        with ThreadPoolExecutor(_WRITERS) as pool:
            self.clamped += sum(pool.map(written, places, maps.values()))
        return tuple(
            Aov(name=name, file=file, scale=chosen.scale, unit=chosen.unit)
            for file, (name, chosen) in zip(files, maps.items(), strict=True)
        )

    def warn(self) -> None:
        """Say once what was lost, if anything."""
        if self.clamped:
            say(
                f"warning: {self.clamped:,} values of the maps exceed 65504 and were clamped. The "
                "unit of the radiance may be wrong. [image.clamped]"
            )
