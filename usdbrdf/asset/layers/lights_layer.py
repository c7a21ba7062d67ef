"""Emitters once more, as UsdLux lights: lights.usda and its variant set ``lights``. A lighter wants
lights: something to dim, to link, to sample well. The measured emission is in the materials, and a
renderer that honoured both would count every lamp twice. So the default prim has a variant set:
``emissive``, the default unless light comes from outside, has no lights; ``usdlux`` has them, and
scales the emission of the lamps they stand for to nothing. A shot that references the asset chooses
by one opinion of its own, which neither a muted layer nor invisible lights in the root would allow:
mutes are a session's, not a file's, and visibility would leave the glowing surfaces on. A layer may
still be muted: all of it is in lights.usda, a sublayer of shading.usda; without it the lamps glow.

The light from outside is a DomeLight with its picture, and a DistantLight where there is a sun: in
``usdlux``, and where there are lamps in ``daylight``, the default then, where these glow beside it.

Rectangles and discs become RectLight and DiskLight, one per flat side, balls SphereLight (see
``usdbrdf.shading.lamp_shapes`` for the tolerances). All other emitters, and what glows on a part of
an object only, keep their emission in both variants. Flat lights shine from the front of the faces;
their lamps are dark where a renderer does not show lights to the camera. A ball is hidden, since
its light encloses it, and some renderers draw such a light from its centre."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from usdbrdf.asset.header import Draft, StageHeader
from usdbrdf.asset.layers.author import attribute, author_inputs, define, export, inside, over
from usdbrdf.asset.layers.looks import EMISSION_TEXTURE
from usdbrdf.asset.layout import path_in_layer
from usdbrdf.asset.properties import Colour, LightFromOutside
from usdbrdf.model.arrays import Double
from usdbrdf.model.light import LampShape
from usdbrdf.model.material import turned_up
from usdbrdf.transport.warps import axes_across

Types = Sdf.ValueTypeNames
LIGHTS = "lights"
EMISSIVE, DAYLIGHT, USDLUX = "emissive", "daylight", "usdlux"
_TYPES = {"rectangle": "RectLight", "disk": "DiskLight", "sphere": "SphereLight"}


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """An emitter and the lights that may stand for it; none where it has no shape for that."""

    prim_path: str
    identifier: str
    shapes: tuple[LampShape, ...]


def write_lights_layer(
    path: Path,
    draft: Draft,
    lamps: Sequence[Lamp],
    outside: LightFromOutside | None,
    world_from_root: Double,
) -> None:
    """Write lights.usda to ``path``; without a lamp that has shapes, and without light from
    outside, it holds nothing. Light from outside is on, without which a room with a lamp would
    stand in the night.

    world_from_root  (4, 4) of column vectors, of the default prim, in units of the stage
    """
    scopes, layer = draft.scopes, draft.new_layer()
    shaped = [lamp for lamp in lamps if lamp.shapes]
    if shaped or outside:
        emissive, daylight, usdlux = (
            Sdf.Path(scopes.root).AppendVariantSelection(LIGHTS, name)
            for name in (EMISSIVE, DAYLIGHT, USDLUX)
        )
        over(layer, str(emissive))
        shown = EMISSIVE if not outside else DAYLIGHT if lamps else USDLUX
        layer.GetPrimAtPath(scopes.root).variantSelections[LIGHTS] = shown
        define(layer, inside(usdlux, scopes.path("lights")), "Scope")
        if outside:
            for variant in (usdlux, daylight) if lamps else (usdlux,):
                place = inside(variant, scopes.path("lights"))
                define(layer, place, "Scope")
                _author_outside(layer, place, outside, draft.header, world_from_root)
        for lamp in shaped:
            lights = inside(usdlux, scopes.path("lights", lamp.identifier))
            define(layer, lights, "Scope")
            for number, shape in enumerate(lamp.shapes, start=1):
                prim = define(layer, f"{lights}/light_{number}", _TYPES[shape.kind])
                _author_light(prim, shape, world_from_root, draft.header.meters_per_unit)
            # The lamp itself must not shine beside them.
            texture = scopes.material(lamp.identifier, EMISSION_TEXTURE)
            prim = over(layer, inside(usdlux, texture))
            author_inputs(prim, Types.Float4, scale=Gf.Vec4f(0, 0, 0, 1))
            if lamp.shapes[0].kind == "sphere":
                hidden = over(layer, inside(usdlux, lamp.prim_path))
                attribute(hidden, "visibility", Types.Token, UsdGeom.Tokens.invisible)
    export(layer, path, folder=path.parent)


def _author_outside(
    layer: Sdf.Layer,
    lights: str,
    outside: LightFromOutside,
    header: StageHeader,
    world_from_root: Double,
) -> None:
    """A DomeLight with the picture, and a DistantLight where there is a sun."""
    dome = define(layer, f"{lights}/sky", "DomeLight")
    file = Sdf.AssetPath(path_in_layer(outside.sky))
    author_inputs(dome, Types.Asset, **{"texture:file": file})
    author_inputs(dome, Types.Token, **{"texture:format": "latlong"})
    author_inputs(dome, Types.Float, intensity=1.0)
    # A DomeLight's pole is its y axis.
    _author_pose(dome, np.linalg.inv(world_from_root) @ turned_up("Y", header.up_axis))
    if not any(outside.sun_irradiance):
        return
    sun = define(layer, f"{lights}/sun", "DistantLight")
    _author_emission(sun, outside.sun_irradiance, normalize=True)
    author_inputs(sun, Types.Float, angle=math.degrees(2 * outside.sun_half_angle))
    # It shines along its -z.
    back, pose = np.array(outside.sun_direction, np.float64), np.eye(4)
    pose[:3, :3] = np.stack([*axes_across(back), back], axis=-1)
    _author_pose(sun, np.linalg.inv(world_from_root) @ pose)


def _author_emission(prim: Sdf.PrimSpec, emission: Colour, *, normalize: bool) -> None:
    """What a light sends out, intensity * 2^exposure * color: radiance, or, if it is to
    ``normalize``, a distant light's irradiance."""
    brightest = max(emission)
    colour = Gf.Vec3f(*(value / brightest for value in emission))
    author_inputs(prim, Types.Float, intensity=1.0, exposure=math.log2(brightest))
    author_inputs(prim, Types.Color3f, color=colour)
    author_inputs(prim, Types.Bool, normalize=normalize)


def _author_pose(prim: Sdf.PrimSpec, pose: Double) -> None:
    """USD multiplies row vectors from the left: its matrices are ours, of column vectors,
    transposed."""
    attribute(prim, "xformOp:transform", Types.Matrix4d, Gf.Matrix4d(pose.T.tolist()))
    attribute(prim, "xformOpOrder", Types.TokenArray, ["xformOp:transform"], uniform=True)


def world_from_root(stage: Usd.Stage) -> Double:
    """(4, 4) of column vectors: what an input file does to the default prim, in its units."""
    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    return np.array(cache.GetLocalToWorldTransform(stage.GetDefaultPrim()), np.float64).T


def _author_light(
    prim: Sdf.PrimSpec, shape: LampShape, world_from_root: Double, meters_per_unit: float
) -> None:
    """UsdLux, normalize off: radiance = intensity * 2^exposure * color."""
    _author_emission(prim, shape.radiance, normalize=False)
    width, height = (side / meters_per_unit for side in shape.size)
    if shape.kind == "rectangle":
        author_inputs(prim, Types.Float, width=width, height=height)
    else:
        author_inputs(prim, Types.Float, radius=width / 2)
    half = Gf.Vec3f(width / 2, height / 2, width / 2 if shape.kind == "sphere" else 0)
    attribute(prim, "extent", Types.Float3Array, [-half, half])
    # Rigid in the world, in units of the stage: what the root does to sizes is undone here.
    in_units = shape.world_from_light.copy()
    in_units[:3, 3] /= meters_per_unit
    _author_pose(prim, np.linalg.inv(world_from_root) @ in_units)
