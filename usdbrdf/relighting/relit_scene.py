"""The asset, its light and the models put in -> one scene: the captured emitters, or others in
their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.asset.readers.render_scene import RenderScene, sky_of_picture
from usdbrdf.errors import InputRefused
from usdbrdf.job.progress import warn
from usdbrdf.model.light import Light, RelitScene
from usdbrdf.model.material import Surface, turned_up
from usdbrdf.options import Insert
from usdbrdf.relighting.insert import (
    placed,
    render_scene_of_others,
    surfaces_from_model,
    with_material,
)
from usdbrdf.untrusted.pictures import picture_from_file

# Two bounding boxes are of one object if their corners differ by less than this share of their
# diagonal, or by a millimetre.
_SAME_SHARE, _SAME_M = 0.02, 1e-3


def lit_by_others(
    captured: RelitScene,
    surfaces: Sequence[Surface],
    lights: Sequence[Light],
    *,
    keep_emitters: bool,
) -> RelitScene:
    """The captured surfaces in other light; their own, and the lights of their stage, are
    switched off unless kept.

    surfaces  of the file that brings the light: those that glow are lights. One that stands where
              a captured object is takes its place.
    """
    glowing = [surface for surface in surfaces if surface.material.emits]
    own = captured.surfaces
    if not keep_emitters:
        own = tuple(replace(s, material=s.material.unlit) if s.material.emits else s for s in own)
    own = tuple(s for s in own if not any(_same_place(s, light) for light in glowing))
    kept = captured.lights if keep_emitters else ()
    return RelitScene(surfaces=(*own, *glowing), lights=(*kept, *lights))


def emits_light(scene: RelitScene) -> bool:
    return bool(scene.lights) or any(surface.material.emits for surface in scene.surfaces)


def _same_place(a: Surface, b: Surface) -> bool:
    diagonal = float(np.linalg.norm(b.bounds[1] - b.bounds[0]))
    return bool(np.abs(a.bounds - b.bounds).max() <= max(_SAME_SHARE * diagonal, _SAME_M))


USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})
SKY_SUFFIXES = frozenset({".exr", ".hdr"})


def relit_scene(
    asset: RenderScene,
    lights: Path | None,
    inserts: Sequence[Insert],
    *,
    keep_emitters: bool,
    eye_height: float,
    allow_outside: Sequence[Path] = (),
) -> RelitScene:
    """All surfaces and lights, in metres, in the asset's world.

    lights         USD file or latitude-longitude picture; None is the light of the asset
    eye_height     metres from which models fall
    allow_outside  folders, beside their own, in which USD files may name others
    """
    if not asset.surfaces:
        raise InputRefused(
            "no mesh of the asset is visible. Look at what edits.usda hides. [relight.empty]"
        )
    scene = RelitScene(surfaces=asset.surfaces, lights=asset.lights)
    if lights is not None:
        surfaces, given = _light_of_file(lights, asset.up_axis, allow_outside)
        scene = lit_by_others(scene, surfaces, given, keep_emitters=keep_emitters)
    inserted: list[Surface] = []
    for insert in inserts:
        dressed = [
            with_material(surface, insert) for surface in _model(insert, asset, allow_outside)
        ]
        inserted += placed(
            dressed,
            insert,
            up_axis=asset.up_axis,
            metres_per_unit=asset.metres_per_unit,
            scene=(*scene.surfaces, *inserted),
            eye_height=eye_height,
        )
    scene = RelitScene(surfaces=(*scene.surfaces, *inserted), lights=scene.lights)
    if not emits_light(scene):
        warn("nothing in the scene emits light; the picture will be black.")
    return scene


def _light_of_file(
    file: Path, up_axis: str, allow: Sequence[Path]
) -> tuple[Sequence[Surface], Sequence[Light]]:
    if file.suffix.lower() in SKY_SUFFIXES:
        return (), (sky_of_picture(picture_from_file(file), up_axis),)
    found = render_scene_of_others(file, allow)
    if not found.lights and not any(surface.material.emits for surface in found.surfaces):
        raise InputRefused(
            f"{file}: no light in it, and no mesh that glows. Add UsdLux lights or an "
            "emissiveColor. [relight.lights]"
        )
    turn = turned_up(found.up_axis, up_axis)
    surfaces = [surface.moved(turn) for surface in found.surfaces]
    return surfaces, [light.moved(turn) for light in found.lights]


def _model(insert: Insert, asset: RenderScene, allow: Sequence[Path]) -> tuple[Surface, ...]:
    """In metres, with the asset's up axis."""
    suffix = insert.model.suffix.lower()
    if suffix in USD_SUFFIXES:
        found = render_scene_of_others(insert.model, allow)
        if found.lights:
            warn(f"{insert.model}: the lights of an inserted model are left out; see --lights.")
        surfaces, model_up, scale = found.surfaces, found.up_axis, 1.0
    else:
        # glTF says metres and y up; the others say nothing and are taken to be as the asset is.
        surfaces = surfaces_from_model(insert.model)
        model_up = "Y" if suffix == ".glb" else asset.up_axis
        scale = 1.0 if suffix == ".glb" else asset.metres_per_unit
    if not surfaces:
        raise InputRefused(f"{insert.model}: no mesh in it. Export the surface. [relight.model]")
    turn = turned_up(insert.up or model_up, asset.up_axis) @ np.diag([scale, scale, scale, 1.0])
    return tuple(surface.moved(turn) for surface in surfaces)
