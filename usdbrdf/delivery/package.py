"""Asset folder in, one file out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pxr import Usd, UsdGeom

from usdbrdf.asset.layers.author import export
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.surfaces import paths_of, surfaces_from_stage
from usdbrdf.delivery.flat_stage import (
    fit_for_arkit,
    flattened,
    lights_of,
    look_of,
    stage_in_look,
    take_materials_literally,
)
from usdbrdf.delivery.glb import write_glb
from usdbrdf.delivery.packaged_files import (
    NewTexture,
    file_in_asset,
    other_files,
    replace_files,
    texture_uses,
    use_texture,
)
from usdbrdf.delivery.textures import EXR, PNG, PictureOptions, add_file, add_texture
from usdbrdf.delivery.usdz import write_usdz
from usdbrdf.errors import OwnershipConflict, UsageError
from usdbrdf.files.atomic import environment_failures
from usdbrdf.job.progress import say
from usdbrdf.options import PackageOptions
from usdbrdf.relighting.insert import turned_up

USDZ, GLB = ".usdz", ".glb"

ARKIT = "arkit"


def package(folder: Path, output: Path, options: PackageOptions | None = None) -> dict[str, Any]:
    """Write the asset in ``folder`` as one file: .usdz, or .glb for what reads no USD.

    The asset is what everybody opens, the artist's edits included, in one look; it is not changed.
    Equal assets give equal bytes. Returns a summary of plain values.

    Raises UsageError for options that exclude each other, and InputRefused where the asset names
    files outside of its folder.
    """
    options = options or PackageOptions()
    textures = _texture_options(output, folder, options)
    asset = Asset.at(folder)
    glb = output.suffix.lower() == GLB
    stage = stage_in_look(asset, options.look)
    flat = flattened(stage, asset, with_lights=not glb and options.profile != ARKIT)
    with environment_failures(str(output)), _folder_of(output):
        if glb:
            summary = _write_glb(output, flat, asset, textures)
        else:
            summary = _write_usdz(output, flat, asset, textures, options)
        size = output.stat().st_size
    return {"output": str(output), "look": look_of(stage), "bytes": size, **summary}


def _write_usdz(
    output: Path, flat: Usd.Stage, asset: Asset, textures: PictureOptions, options: PackageOptions
) -> dict[str, Any]:
    if options.profile == ARKIT:
        fit_for_arkit(flat, _warn)
    with TemporaryDirectory(prefix="usdbrdf-package-") as name:
        folder = Path(name)
        packed = _add_textures(flat, asset, folder, textures)
        others: dict[str, str] = {}
        for path in other_files(flat, packed):
            file, taken = file_in_asset(path, asset), {*packed, *others.values()}
            others[path] = add_file(file, asset.folder.resolve(), folder, taken)
        replace_files(flat, others)
        root = f"{asset.name}.usdc"
        export(flat.GetRootLayer(), folder / root, folder=folder)
        write_usdz(output, folder, [root, *sorted({*packed, *others.values()})])
    return {"textures": len(packed), "format": textures.format, "profile": options.profile}


def _write_glb(
    output: Path, flat: Usd.Stage, asset: Asset, textures: PictureOptions
) -> dict[str, Any]:
    texture_uses(flat, asset)  # refuses what lies outside
    take_materials_literally(flat)
    time = Usd.TimeCode.EarliestTime()
    turn = turned_up(str(UsdGeom.GetStageUpAxis(flat)), "Y")
    subject = asset.root_layer
    if lights := lights_of(flat):
        _warn(f"{subject}: .glb packages hold no lights; left out: {paths_of(lights)}.")
    surfaces = [s.moved(turn) for s in surfaces_from_stage(flat, time, _warn, subject)]
    return write_glb(output, surfaces, textures.max_size, _warn)


@contextmanager
def _folder_of(output: Path) -> Iterator[None]:
    """Make the folders above a file; those that hold nothing at the end go again."""
    made = [folder for folder in output.parents if not folder.exists()]
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for folder in made:  # the innermost first
            with suppress(OSError):  # it is not empty, or was never made
                folder.rmdir()


def _add_textures(flat: Usd.Stage, asset: Asset, folder: Path, options: PictureOptions) -> set[str]:
    """Write each texture once, however many nodes read it in the same way; returns their paths."""
    done: dict[tuple[Any, ...], NewTexture] = {}
    for use in texture_uses(flat, asset):
        key = (use.file, use.space, use.colour, use.reads_alpha)
        if key not in done:
            taken = {new.path for new in done.values()}
            done[key] = add_texture(use, folder, taken, options)
        use_texture(flat, use, done[key])
    return {new.path for new in done.values()}


def _texture_options(output: Path, folder: Path, options: PackageOptions) -> PictureOptions:
    """Everything that can be refused before the asset is opened."""
    suffix = output.suffix.lower()
    if suffix not in (USDZ, GLB):
        raise UsageError(f"{output}: packages are {USDZ} or {GLB} files. [package.format]")
    if options.profile == ARKIT and suffix == GLB:
        raise UsageError(f"{output}: the ARKit profile is one of {USDZ}. [package.profile]")
    eight_bit = options.profile == ARKIT or suffix == GLB
    if eight_bit and options.textures == EXR:
        raise UsageError(
            f"--textures exr: {'ARKit' if suffix == USDZ else 'glTF'} knows PNG and JPEG only. "
            "[package.textures]"
        )
    if output.is_dir():
        raise OwnershipConflict(f"{output}: a folder has this name. Choose another. [package.name]")
    if output.resolve().is_relative_to(folder.resolve()):
        raise UsageError(
            f"{output}: lies inside the asset {folder}, which stays as it is. Name another place "
            "with -o. [package.output]"
        )
    chosen = options.textures or (PNG if eight_bit else EXR)
    return PictureOptions(format=chosen, max_size=options.max_size)


def _warn(sentence: str) -> None:
    say(f"warning: {sentence}")
