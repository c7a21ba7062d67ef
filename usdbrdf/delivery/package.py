"""Asset folder in, one file out."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pxr import Sdf, Tf, Usd, UsdGeom

from usdbrdf.asset.layers.author import export
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import in_one_line
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
    EXR,
    PNG,
    NewTexture,
    PictureOptions,
    add_file,
    add_texture,
    file_in_asset,
    other_files,
    replace_files,
    texture_uses,
    use_texture,
)
from usdbrdf.errors import EnvironmentFailure, OwnershipConflict, UsageError, UsdBrdfError
from usdbrdf.files.atomic import environment_failures, publish, temporary_beside
from usdbrdf.job.progress import warn
from usdbrdf.model.material import turned_up
from usdbrdf.options import PackageOptions

USDZ, GLB = ".usdz", ".glb"
# A zip archive stores local times; one and the same, so that equal content is equal bytes.
_PINNED_TIME = (2000, 1, 1, 0, 0, 0, 0, 1, -1)
ARKIT = "arkit"


def package(folder: Path, output: Path, options: PackageOptions | None = None) -> dict[str, Any]:
    """Write the asset in ``folder`` as one file: .usdz, or .glb for what reads no USD.

    The asset is what everybody opens, the artist's edits included, in one look; it is not changed.
    Equal assets give equal bytes. Returns a summary of plain values.

    Raises UsageError for options that exclude each other, and InputRefused where the asset names
    files outside of its folder.
    """
    options = options or PackageOptions()
    asset = Asset.made(folder)
    textures = _texture_options(output, asset, options)
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
        fit_for_arkit(flat, warn)
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
    turn = turned_up(str(UsdGeom.GetStageUpAxis(flat)), "Y")
    subject = asset.root_layer
    if lights := lights_of(flat):
        warn(f"{subject}: .glb packages hold no lights; left out: {paths_of(lights)}.")
    surfaces = surfaces_from_stage(flat, Usd.TimeCode.EarliestTime(), warn, subject)
    return write_glb(output, [s.moved(turn) for s in surfaces], textures.max_size, warn)


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


def _texture_options(output: Path, asset: Asset, options: PackageOptions) -> PictureOptions:
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
    asset.refuse_output(output, "package.output")
    chosen = options.textures or (PNG if eight_bit else EXR)
    return PictureOptions(format=chosen, max_size=options.max_size)


def write_usdz(path: Path, folder: Path, members: Sequence[str]) -> None:
    """Pack files of a folder, the root layer first; opened and checked before it gets its name.

    Exactly these are packed: USD's own packager also takes whatever a layer happens to name.
    """
    pinned = time.mktime(_PINNED_TIME)
    with temporary_beside(path) as staged:
        try:
            writer = Sdf.ZipFileWriter.CreateNew(str(staged))
            for member in members:
                os.utime(folder / member, (pinned, pinned))
                writer.AddFile(str(folder / member), member)
            done = writer.Save()
        except Tf.ErrorException as error:
            raise EnvironmentFailure(
                f"{path}: the package could not be written ({in_one_line(error)}). Free disk space "
                "or correct the permission. [package.write]"
            ) from error
        if not done or not staged.is_file():
            raise EnvironmentFailure(
                f"{path}: the package could not be written. Free disk space or correct the "
                "permission. [package.write]"
            )
        _check_package(staged, path)
        publish(staged, path)


def _check_package(staged: Path, path: Path) -> None:
    stage = Usd.Stage.Open(str(staged))
    problems = [in_one_line(problem) for problem in stage.GetCompositionErrors()]
    for prim in stage.TraverseAll():
        for attribute in prim.GetAuthoredAttributes():
            value = attribute.Get()
            if isinstance(value, Sdf.AssetPath) and value.path and not value.resolvedPath:
                problems.append(f"<{attribute.GetPath()}> finds no {value.path}")
    if problems:
        raise UsdBrdfError(
            f"{path}: the package does not compose: {problems[0]}. This is a defect of usdbrdf; "
            "please report it. [package.composition]"
        )
