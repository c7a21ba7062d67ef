"""What the later steps read back from the texturing step: scene, texels, and maps on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pxr import Usd

from usdbrdf.errors import InputRefused
from usdbrdf.files.images import read_exr
from usdbrdf.geometry.scene import Scene, SceneObject
from usdbrdf.geometry.texels import Texels, texels_from_atlas
from usdbrdf.stage.read import aov_path, scene_from_stage

Float = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Atlas:
    """The textured scene: its texels, and the pictures that the stage names."""

    stage: Usd.Stage
    scene: Scene
    texels: Texels

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
