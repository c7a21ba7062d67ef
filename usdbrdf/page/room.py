"""The room in three dimensions: the asset's glTF and what a viewer needs besides to light it."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from typing import Any

import numpy as np

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.delivery.package import write_package
from usdbrdf.errors import UsdBrdfError
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.images import resized
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.progress import say
from usdbrdf.model.camera import Camera
from usdbrdf.model.material import turned_up
from usdbrdf.options import PackageOptions, Surroundings
from usdbrdf.page.daylight import area_of, daylight
from usdbrdf.page.pictures import data_uri, status_of
from usdbrdf.page.small_glb import small_glb
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.rays import RayScene

# Pixels of a texture's longer side.
_TEXTURE = 384
# Lamps with a light and a switch of their own: graphics cards compile shaders for so many.
_MOST_LAMPS = 24
# And what sends out a smaller share of the strongest one's light has none.
_FAINT = 1e-3
# Pixels across in which it is looked how far what a camera sees is.
_LOOKED_AT = 96


def room_model(
    asset: Asset,
    atlas: AssetMaps,
    lit: LitScene,
    camera: Camera,
    up_axis: str,
    environment: Surroundings,
) -> dict[str, Any] | None:
    """What the page needs for its view in 3D; None, and a line that says why, where there is none.

    glb    gzip, base64, see ``small_glb``: y up, metres; nodes name their prims
    first  where the view opens, see ``first_look``: as ``camera`` looked
    lit    by prim, the lit texture as a picture
    lamps  where those are that shine, y up, with their intensity as points, in the asset's units of
           radiance times m^2; the weakest of many are one, and parts of things that are no lamps
           say so
    area   m^2 of the surfaces that their light is spread over
    outside  see ``daylight``; the surroundings of ``lit`` are those of ``environment``
    """
    try:
        with scratch_folder() as folder:
            file = folder / "room.glb"
            options = PackageOptions(max_size=_TEXTURE, lighting=asset.lighting or None)
            # Its lights are told apart from it, and glTF is not what is handed over here.
            write_package(asset.folder, file, options, lambda _: None)
            content = small_glb(file.read_bytes())
    except UsdBrdfError as error:
        say(f"report: without the room in 3D: {error}")
        return None
    exposure = display_exposure(atlas.lit[atlas.coverage.measured].mean(axis=1))
    area, outside = area_of(lit), daylight(atlas, lit, environment, up_axis, exposure)
    packed = gzip.compress(content, compresslevel=6, mtime=0)
    return {
        "glb": base64.b64encode(packed).decode("ascii"),
        "first": first_look(lit.rays, camera, up_axis),
        "lit": lit_pictures(atlas, exposure),
        "exposure": exposure,
        "irradiance": _typical_irradiance(atlas),
        "lamps": with_the_weakest_as_one(lamps(atlas, up_axis, _as_lamps(outside, area))),
        "area": area,
        "outside": outside,
    }


def first_look(rays: RayScene, camera: Camera, up_axis: str) -> dict[str, list[float]] | None:
    """``eye`` and ``target``, which is as far as what the camera sees, y up; None where it sees
    nothing."""
    small = camera.at_width(min(_LOOKED_AT, camera.width))
    hits = rays.closest(*small.rays(small.pixels()))
    seen = hits.face >= 0
    if not seen.any():
        return None
    turn, forward = turned_up(up_axis, "Y")[:3, :3], -camera.world_from_camera[:3, 2]
    target = camera.eye + float(np.median(hits.distance[seen])) * forward
    places = {"eye": turn @ camera.eye, "target": turn @ target}
    return {name: [round(float(value), 4) for value in place] for name, place in places.items()}


def lit_pictures(atlas: AssetMaps, exposure: float) -> dict[str, str]:
    """By prim path its lit texture, one exposure for all."""
    found, light = {}, atlas.light
    for i, obj in enumerate(atlas.scene.objects):
        image = atlas.texels.image(i, light)
        height, width = image.shape[:2]
        if max(width, height) > _TEXTURE:
            scale = _TEXTURE / max(width, height)
            image = resized(image, max(1, round(width * scale)), max(1, round(height * scale)))
        found[obj.prim_path] = data_uri(to_display_srgb8(image, exposure_scale=exposure))
    return found


def _as_lamps(outside: dict[str, Any] | None, area: float) -> float:
    """The sum of the intensities of lamps that bring as much light as comes from outside."""
    sources = [source for name in ("sky", "sun") if outside and (source := outside[name])]
    return area / (4 * np.pi) * sum(sum(source["direct"]) for source in sources)


def lamps(atlas: AssetMaps, up_axis: str, beside: float = 0.0) -> list[dict[str, Any]]:
    """Lamps as points that send out as much light, alike in all directions: of an area A that
    shines with radiance L all around itself or to one side, the mean intensity is A L / 4. A few
    texels of a thing that mirrors a lamp are none, nor are those that mirror the light from
    outside, which is as strong as lamps of the intensity ``beside``."""
    turn, texels = turned_up(up_axis, "Y")[:3, :3], atlas.texels
    found: list[dict[str, Any]] = []
    for i, obj in enumerate(atlas.scene.objects):
        own = texels.of_object(i)
        power = texels.area[own, None] * atlas.emission[own]
        if not power.any():
            continue
        weight = power.sum(axis=1)
        whole = status_of(atlas, i, None) == "lamp"
        # A little before the surface, on the side that shines, so that it lights what is there.
        middle = np.average(texels.position[own], axis=0, weights=weight)
        facing = np.average(texels.geometric_normal[own], axis=0, weights=weight)
        place = turn @ (middle + 0.05 * facing)
        found.append(
            {
                "prim": obj.prim_path,
                "label": obj.name if whole else f"part of {obj.name}",
                "place": [round(float(value), 4) for value in place],
                "intensity": [float(value) for value in power.sum(axis=0) / 4],
            }
        )
    strength = [sum(lamp["intensity"]) for lamp in found]
    least = _FAINT * max([*strength, beside])
    return [lamp for lamp, own in zip(found, strength, strict=True) if own >= least]


def with_the_weakest_as_one(
    found: Sequence[dict[str, Any]], most: int = _MOST_LAMPS
) -> list[dict[str, Any]]:
    """At most ``most`` lamps of ``found``, in its order; those that send out least are one of no
    prim, amid them, with the light of all."""
    if len(found) <= most:
        return list(found)
    power = [sum(lamp["intensity"]) for lamp in found]
    strong = set(sorted(range(len(found)), key=lambda i: -power[i])[: most - 1])
    weak = [i for i in range(len(found)) if i not in strong]
    middle = np.average([found[i]["place"] for i in weak], axis=0, weights=[power[i] for i in weak])
    together = {
        "prim": "",
        "label": f"{len(weak)} weaker lamps, as one",
        "place": [round(float(value), 4) for value in middle],
        "intensity": np.sum([found[i]["intensity"] for i in weak], axis=0).tolist(),
    }
    return [*(found[i] for i in sorted(strong)), together]


def _typical_irradiance(atlas: AssetMaps) -> list[float]:
    if not atlas.has("irradiance"):
        return [0.0, 0.0, 0.0]
    return [float(value) for value in np.median(atlas.irradiance, axis=0)]
