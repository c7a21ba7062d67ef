"""The light from outside, as the task shade finds it and writes it down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import LightFromOutside, colour
from usdbrdf.files.colour import DATA
from usdbrdf.files.images import needs_float, write_exr
from usdbrdf.job.progress import warn
from usdbrdf.job.task import TaskRun
from usdbrdf.options import NO_LIGHT, ShadeOptions
from usdbrdf.shading.outside import Outside, estimated_outside
from usdbrdf.shading.panes import beside_panes, find_panes
from usdbrdf.transport.environment import environment_from_file, unknown_primaries
from usdbrdf.transport.lit_scene import TexturedScene


def with_panes(
    run: TaskRun, maps: AssetMaps, options: ShadeOptions, up_axis: str, said: Mapping[int, bool]
) -> TexturedScene:
    """The scene with the panes that the capture shows, none where nothing is to be outside; what a
    person calls a lamp is none."""
    if options.environment == NO_LIGHT:
        return maps.surface
    found = find_panes(run, maps.surface, maps.lit, maps.coverage, maps.frames, up_axis == "Z")
    return replace(maps.surface, panes=tuple(i for i in found if not said.get(i)))


def outside_of(
    run: TaskRun,
    maps: AssetMaps,
    surface: TexturedScene,
    options: ShadeOptions,
    up_axis: str,
    said: Mapping[int, bool],
) -> Outside | None:
    """The light from outside as a file tells it, or the capture; None without any. said: of
    objects, by number, whether they are lamps, where a person says so."""
    if isinstance(options.environment, Path):
        if unknown := unknown_primaries(options.environment):
            warn(unknown)
        return Outside.given(environment_from_file(options.environment, up_axis))
    if options.environment == NO_LIGHT:
        return None
    lit, coverage = beside_panes(surface, maps.lit, maps.coverage)
    return estimated_outside(
        run, surface, maps.frames, lit, coverage, up_axis == "Z",
        options.sampling.seed, said, lambda: maps.differing,
    )  # fmt: skip


def write_outside(run: TaskRun, asset: Asset, outside: Outside) -> LightFromOutside:
    """Its pictures, and the record that names them."""
    image, sun = outside.environment.image, outside.environment.sun
    write_exr(run.output(asset.sky), image, half=not needs_float(image))
    confidence = outside.confidence[..., None]
    write_exr(run.output(asset.sky_confidence), confidence, half=True, encoding=DATA)
    return LightFromOutside(
        sky=asset.sky,
        confidence=asset.sky_confidence,
        source="estimated" if outside.is_estimated else "given",
        open_share=outside.open_share,
        sky_error=outside.sky_error,
        sun_irradiance=colour(sun.irradiance),
        sun_direction=colour(sun.direction),
        sun_half_angle=sun.half_angle,
        sun_error=outside.sun_error,
    )
