"""The light from outside, as the task shade finds it and writes it down."""

from __future__ import annotations

from collections.abc import Mapping
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
from usdbrdf.transport.environment import environment_from_file, unknown_primaries


def outside_of(
    run: TaskRun, maps: AssetMaps, options: ShadeOptions, up_axis: str, said: Mapping[int, bool]
) -> Outside | None:
    """The light from outside as a file tells it, or the capture; None without any. said: of
    objects, by number, whether they are lamps, where a person says so."""
    if isinstance(options.environment, Path):
        if unknown := unknown_primaries(options.environment):
            warn(unknown)
        return Outside.given(environment_from_file(options.environment, up_axis))
    if options.environment == NO_LIGHT:
        return None
    return estimated_outside(
        run, maps.surface, maps.frames, maps.lit, maps.coverage, up_axis == "Z",
        options.sampling.seed, said,
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
