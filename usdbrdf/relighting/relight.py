"""The published asset, with models put in, in its own light or another, path traced."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import not_run, open_edited, recorded_photographs, steps_to_come
from usdbrdf.asset.readers.render_scene import (
    eye_height,
    metres_per_unit,
    render_scene_from_stage,
    time_code,
    view_from_stage,
)
from usdbrdf.asset.readers.views import cameras_of_views
from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.atomic import environment_failures, refuse_unwritable, temporary_folder
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.images import read_radiance, write_exr, write_preview_png
from usdbrdf.job.ownership import reads_asset
from usdbrdf.job.progress import say, warn
from usdbrdf.model.arrays import Float
from usdbrdf.model.camera import Camera
from usdbrdf.options import RelightOptions
from usdbrdf.relighting.relit_scene import SKY_SUFFIXES, USD_SUFFIXES, relit_scene
from usdbrdf.relighting.render import mitsuba_scene, mitsuba_variant, render_view
from usdbrdf.relighting.scene_file import SUFFIX, write_scene_file
from usdbrdf.transport.denoise import OIDN, chosen_filter, denoise_picture

LINEAR, DISPLAYED = (".exr",), (".png", ".jpg", ".jpeg")
_LEVELS = 1 << 16  # pixels of a picture that the exposure is taken from


@reads_asset("folder")
def relight(folder: Path, output: Path, options: RelightOptions | None = None) -> dict[str, Any]:
    """Render the asset in ``folder`` into ``output``: a picture, or with views a folder of them; or
    write there the scene that Mitsuba would be given, an .xml.

    What is rendered is the root layer as everybody opens it, the artist's edits included; nothing
    of the asset is changed. Returns a summary of plain values.
    """
    options = options or RelightOptions()
    asset = Asset.made(folder).in_lighting(options.lighting)
    _check(options, output, asset)
    mitsuba, noise = mitsuba_variant(), chosen_filter(options.denoise)
    stage = open_edited(asset)
    if missing := steps_to_come(asset):
        measures = "it measures" if len(missing) == 1 else "they measure"
        warn(f"{asset.folder}: {not_run(missing)}; the picture lacks what {measures}.")
    time = time_code(stage, options.frame)
    # What may be refused is read before all meshes and pictures are.
    if options.views is None:
        views: tuple[Camera, ...] = (view_from_stage(stage, options.camera, time),)
    else:
        views = cameras_of_views(options.views, asset, metres_per_unit(stage))
    if options.width is not None:
        views = tuple(view.at_width(options.width) for view in views)
    targets, is_scene = [output], output.suffix.lower() == SUFFIX
    if options.views is not None and not is_scene:
        targets = [output / f"{Path(view.name).stem}.{options.format}" for view in views]
        for target in targets:
            _refuse_taken(target, folder=False)
    _refuse_inputs(targets, asset, options)
    refuse_unwritable(targets[0])
    captured = render_scene_from_stage(stage, time, warn)
    falls = any(insert.falls_from_eye_height for insert in options.inserts)
    scene = relit_scene(captured, options, eye_height(stage) if falls else 0.0)
    told = {
        "samples": options.samples,
        "bounces": options.bounces,
        "surfaces": len(scene.surfaces),
        "lights": len(scene.lights) + sum(s.material.emits for s in scene.surfaces),
    }
    if is_scene:
        files = write_scene_file(
            mitsuba, output, scene, views, bounces=options.bounces, samples=options.samples,
            seed=options.seed,
        )  # fmt: skip
        return {"scene": str(output), "files": files, "cameras": len(views), **told}
    loaded = mitsuba_scene(mitsuba, scene, bounces=options.bounces)
    with environment_failures(str(output)):
        targets[0].parent.mkdir(parents=True, exist_ok=True)
    rendered = _rendered(mitsuba, loaded, views, options, denoise=noise == OIDN)
    exposure = _write_pictures(rendered, targets, options.exposure)
    return {
        "pictures": [str(target) for target in targets],
        "variant": mitsuba.variant(),
        "denoise": noise,
        "exposure": exposure,
        **told,
    }


def _write_pictures(
    rendered: Iterator[Float], targets: Sequence[Path], exposure: float | None
) -> float | None:
    """Write all views, in the order of the targets; returns the exposure in stops of displayed
    pictures, which is automatic where none is given."""
    displayed = targets[0].suffix.lower() in DISPLAYED
    if not displayed or exposure is not None:
        stops = exposure or 0.0
        for target, picture in zip(targets, rendered, strict=True):
            _write_picture(target, picture, stops)
    else:
        # One exposure for all, so that they can be compared. Until it is known the pictures wait on
        # disk: many would not fit into memory.
        levels = []
        with ExitStack() as held:
            with environment_failures(str(targets[0].parent)):
                waiting = held.enter_context(temporary_folder(targets[0]))
            spilled = [waiting / f"{i}.exr" for i in range(len(targets))]
            for spill, picture in zip(spilled, rendered, strict=True):
                levels.append(exposure_levels(picture))
                write_exr(spill, picture, half=False)
            stops = float(np.log2(display_exposure(np.concatenate(levels))))
            for target, spill in zip(targets, spilled, strict=True):
                _write_picture(target, read_radiance(spill), stops)
    if not displayed:
        return None
    say(f"exposure: {stops:+.2f} stops{' (automatic)' if exposure is None else ''}")
    return stops


def _rendered(
    mitsuba: Any, loaded: Any, views: Sequence[Camera], options: RelightOptions, *, denoise: bool
) -> Iterator[Float]:
    """(H, W, 3) radiance of one view after the other."""
    for i, view in enumerate(views):
        label, seed = f"relight {i + 1} of {len(views)}", (options.seed, i)
        found = render_view(mitsuba, loaded, view, samples=options.samples, seed=seed, label=label)
        yield denoise_picture(*found) if denoise else found[0]


def exposure_levels(picture: Float) -> Float:
    """(N,) means of R, G and B at pixels all over the picture, at most 65536: what its exposure is
    taken from."""
    means = picture.mean(axis=2).ravel()
    return np.ascontiguousarray(means[:: -(-means.size // _LEVELS)])


def _write_picture(path: Path, radiance: Float, stops: float) -> None:
    """Float radiance as EXR; as PNG or JPEG times 2^stops, clipped, in sRGB."""
    if path.suffix.lower() in LINEAR:
        write_exr(path, radiance, half=False)
    else:
        write_preview_png(path, to_display_srgb8(radiance, exposure_scale=2.0**stops))


def _check(options: RelightOptions, output: Path, asset: Asset) -> None:
    """Everything that can be refused before the renderer is started."""
    suffix, many = output.suffix.lower(), options.views is not None
    if not many and suffix not in (*LINEAR, *DISPLAYED, SUFFIX):
        raise UsageError(
            f"{output}: pictures are written as {', '.join((*LINEAR, *DISPLAYED))}, scenes for "
            f"Mitsuba as {SUFFIX}. Choose one of these extensions. [relight.format]"
        )
    if many and options.camera is not None:
        raise UsageError("--views, --camera: they exclude each other. [usage.option]")
    if suffix == SUFFIX:
        _refuse_options_of_pictures(options)
    else:
        _refuse_what_has_no_effect(options, suffix)
    _refuse_taken(output, folder=many and suffix != SUFFIX)
    asset.refuse_output(output, "relight.output")
    lights = options.lights
    if lights is not None and lights.suffix.lower() not in USD_SUFFIXES | SKY_SUFFIXES:
        raise UsageError(
            f"--lights {lights}: lights come from a USD file, or from a latitude-longitude .exr "
            "or .hdr. [relight.lights]"
        )
    for file in (lights, *(insert.model for insert in options.inserts)):
        if file is not None and not file.is_file():
            raise InputRefused(f"{file}: no such file. Check the path. [usage.file]")


def _refuse_inputs(targets: Sequence[Path], asset: Asset, options: RelightOptions) -> None:
    """OwnershipConflict where a picture would replace a photograph of the capture, or what it is
    made from."""
    inputs = {
        os.path.realpath(file): "one of the capture's photographs and masks,"
        for file in recorded_photographs(asset)
    }
    inputs |= {os.path.realpath(insert.model): "a model of --insert," for insert in options.inserts}
    if options.lights is not None:
        inputs[os.path.realpath(options.lights)] = "the file of --lights,"
    for target in targets:
        if (which := inputs.get(os.path.realpath(target))) is not None:
            raise OwnershipConflict(
                f"{target}: this is {which} which stays as it is. Name another place with -o. "
                "[relight.output]"
            )


def _refuse_options_of_pictures(options: RelightOptions) -> None:
    """UsageError for what a scene for Mitsuba cannot follow."""
    usual = RelightOptions()
    for name in ("exposure", "format", "denoise"):
        if getattr(options, name) != getattr(usual, name):
            raise UsageError(
                f"--{name}: is of pictures, and {SUFFIX} is a scene. Leave it out, or name a "
                "picture with -o. [relight.scene]"
            )


def _refuse_what_has_no_effect(options: RelightOptions, suffix: str) -> None:
    """UsageError for options of other pictures than those that are asked for."""
    many = options.views is not None
    if not many and options.format != RelightOptions().format:
        raise UsageError(
            f"--format {options.format}: is of the pictures of --views; without them the ending "
            "of -o says what is written. Leave it out. [usage.option]"
        )
    if options.exposure is not None and (f".{options.format}" if many else suffix) in LINEAR:
        raise UsageError(
            "--exposure: is of .png and .jpg, and .exr holds radiance as it is. Leave it out, or "
            "ask for another picture. [usage.option]"
        )


def _refuse_taken(path: Path, *, folder: bool) -> None:
    """OwnershipConflict where a file or folder stands where the other kind is to be written."""
    if folder and path.exists() and not path.is_dir():
        raise OwnershipConflict(f"{path}: not a folder. Name another with -o. [relight.output]")
    if not folder and path.is_dir():
        raise OwnershipConflict(
            f"{path}: a folder of this name is in the place of the picture. Name another file "
            "with -o. [relight.output]"
        )
    above = next((parent for parent in path.absolute().parents if parent.exists()), None)
    if above is not None and not above.is_dir():
        raise OwnershipConflict(
            f"{path}: {above} is not a folder. Name another place with -o. [relight.output]"
        )
