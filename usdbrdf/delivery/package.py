"""Asset folder in, one file out: the asset composed in one look becomes one layer that needs no
other, and is packed with its pictures; or all its layers are packed, with every look and lighting.

What is kept of one look: geometry, the materials bound in it with their UsdPreviewSurface
networks, lights, cameras, and the numbers measured. What goes: the other looks, the maps behind
them, render settings, the photographs, and every path of this machine."""

from __future__ import annotations

import os
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils

from usdbrdf.asset.header import Scopes
from usdbrdf.asset.layers.author import export
from usdbrdf.asset.layers.interface import NEEDS, UNPUBLISHED
from usdbrdf.asset.layers.lights_layer import DAYLIGHT, EMISSIVE, LIGHTS, USDLUX
from usdbrdf.asset.layers.looks import SHADED, VARIANT_SET
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import (
    in_one_line,
    named_files,
    not_run,
    open_edited,
    open_weaker,
    steps_to_come,
)
from usdbrdf.asset.readers.surfaces import paths_of, surfaces_from_stage
from usdbrdf.delivery.collection import OF_PHOTOGRAPHS, SCHEMAS_OF_PHOTOGRAPHS
from usdbrdf.delivery.colours import ColourTextures, convert_layer, in_space
from usdbrdf.delivery.copy_of_asset import SPACES, write_copy
from usdbrdf.delivery.glb import need_pillow, write_glb
from usdbrdf.delivery.low_poly import make_low_poly
from usdbrdf.delivery.packaged_files import (
    EXR,
    IMAGES,
    NewTexture,
    add_file,
    add_texture,
    file_in_asset,
    texture_uses,
    use_texture,
)
from usdbrdf.errors import (
    EnvironmentFailure,
    InputRefused,
    OwnershipConflict,
    UsageError,
    UsdBrdfError,
)
from usdbrdf.files.atomic import (
    cure_of_writing,
    environment_failures,
    folders_above,
    publish,
    refuse_unwritable,
    temporary_beside,
)
from usdbrdf.files.colour import WORKING_SPACE
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.ownership import reads_asset
from usdbrdf.job.progress import warn
from usdbrdf.job.stamp import code_version
from usdbrdf.model.material import turned_up
from usdbrdf.options import PackageOptions

_PURPOSES = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview)
# Properties and schemas that name files of the capture or of other looks.
_LEFT_OUT = ("usdBrdf:aov:", *OF_PHOTOGRAPHS)
_MAPPING = "usdBrdf:fit:mapping"
_FROM_OUTSIDE = {"DistantLight", "DomeLight"}
_LEFT_OUT_SCHEMAS = ("UsdBrdfAovAPI:", *SCHEMAS_OF_PHOTOGRAPHS)
USDZ, GLB = ".usdz", ".glb"
# A zip archive stores local times; one and the same, so that equal content is equal bytes.
_PINNED_TIME = (2000, 1, 1, 0, 0, 0, 0, 1, -1)
_UTF8 = 0x800  # flag of a name in a zip archive
ARKIT = "arkit"


def stage_in_look(asset: Asset, look: str | None = None) -> Usd.Stage:
    """The asset as everybody opens it, edits included, with a look selected; nothing is written.

    look  None: the one that it opens in, or ``shaded`` where that is no look of the asset

    Raises UsageError for a look that it has not, and InputRefused for layers that lie elsewhere
    than in the asset's folder, but for the captured geometry that the scan layer refers to.
    """
    stage = open_edited(asset)
    captured = open_weaker(asset, "texturing")  # its layers are valid only as long as it is held
    known = {os.path.realpath(layer.realPath) for layer in captured.GetUsedLayers()}
    for layer in (layer for layer in stage.GetUsedLayers() if not layer.anonymous):
        place = os.path.realpath(layer.realPath)
        if place not in known and not Path(place).is_relative_to(os.path.realpath(asset.folder)):
            raise InputRefused(
                f"{asset.folder}: the layer {place} lies outside of the asset. Copy it into the "
                "folder, or take it out of edits.usda. [package.outside]"
            )
    looks = stage.GetDefaultPrim().GetVariantSet(VARIANT_SET)
    names = looks.GetVariantNames()
    if not names:
        raise InputRefused(
            f"{asset.folder}: the asset has no look yet. Run usdbrdf convert, which measures its "
            "textures and materials, first. [package.look]"
        )
    if look is not None and look not in names:
        raise UsageError(f"--look {look}: the asset has {', '.join(names)}. [package.look]")
    chosen = (look, looks.GetVariantSelection(), SHADED, *names)
    stage.SetEditTarget(stage.GetSessionLayer())
    looks.SetVariantSelection(next(name for name in chosen if name in names))
    return stage


def look_of(stage: Usd.Stage) -> str:
    """The look that is selected in a stage of ``stage_in_look``."""
    return str(stage.GetDefaultPrim().GetVariantSet(VARIANT_SET).GetVariantSelection())


def flattened(stage: Usd.Stage, asset: Asset, *, with_lights: bool = True) -> Usd.Stage:
    """All that the stage composes to, as a new stage of one anonymous layer; its asset paths are
    absolute and have still to be replaced.

    with_lights  False where the package can hold none: then lamps glow by their material, also
                 where the artist selected lights in their place; light from outside stays, for
                 the caller to tell of what it leaves out
    """
    # Instances become prims of their own, in the session layer: flattened, prototypes would lie
    # beside the default prim, and what is bound to an instance would be seen by nobody.
    while instances := [prim for prim in stage.TraverseAll() if prim.IsInstance()]:
        for prim in instances:
            prim.SetInstanceable(False)
    if not with_lights:
        prims = stage.TraverseAll()
        sets = [(prim.GetPath(), prim.GetVariantSet(LIGHTS).GetVariantNames()) for prim in prims]
        for path in (path for path, names in sets if EMISSIVE in names):
            if prim := stage.GetPrimAtPath(path):  # the choice above it may have taken it away
                _let_lamps_glow(prim)
    layer = stage.Flatten(addSourceFileComment=False)
    flat = Usd.Stage.Open(layer)
    layer.documentation = ""
    layer.customLayerData = {
        "usdbrdf": {"role": "package", "version": code_version(), "look": look_of(stage)}
    }
    if layer.pseudoRoot.HasInfo("renderSettingsPrimPath"):
        layer.pseudoRoot.ClearInfo("renderSettingsPrimPath")
    flat.RemovePrim(Scopes.of(asset).path("render"))
    for prim in flat.TraverseAll():
        info = dict(prim.GetAssetInfo())
        for name in ("identifier", NEEDS):  # of the asset in its folder
            info.pop(name, None)
        if info.get("version") == UNPUBLISHED:
            info.pop("version")
        prim.SetMetadata("assetInfo", info) if info else prim.ClearMetadata("assetInfo")
    # What is said of materials of other looks, which are not there.
    for path in [prim.GetPath() for prim in flat.TraverseAll() if not prim.IsDefined()]:
        flat.RemovePrim(path)
    _keep_bound_materials(flat)
    for prim in flat.TraverseAll():
        for name in [*prim.GetAuthoredPropertyNames()]:
            if name.startswith(_LEFT_OUT):
                prim.RemoveProperty(name)
        schemas = prim.GetMetadata("apiSchemas")
        if schemas is not None:
            # A flattened layer has one explicit list.
            listed = (*schemas.explicitItems, *schemas.prependedItems, *schemas.appendedItems)
            kept = [name for name in listed if not name.startswith(_LEFT_OUT_SCHEMAS)]
            prim.SetMetadata("apiSchemas", Sdf.TokenListOp.Create(prependedItems=kept))
    return flat


def _let_lamps_glow(prim: Usd.Prim) -> None:
    """Select of the set ``lights`` what has no light in the place of a lamp."""
    choice, stage = prim.GetVariantSet(LIGHTS), prim.GetStage()
    chosen = choice.GetVariantSelection()
    if chosen == USDLUX and DAYLIGHT in choice.GetVariantNames():
        choice.SetVariantSelection(DAYLIGHT)
    elif chosen not in (EMISSIVE, DAYLIGHT):
        before = {light.GetPath(): light.GetTypeName() for light in lights_of(stage)}
        choice.SetVariantSelection(EMISSIVE)
        gone = before.keys() - {light.GetPath() for light in lights_of(stage)}
        if gone and {before[path] for path in gone} <= _FROM_OUTSIDE:
            choice.SetVariantSelection(chosen)


def lights_of(flat: Usd.Stage) -> list[Usd.Prim]:
    """All UsdLux lights."""
    return [prim for prim in flat.TraverseAll() if prim.HasAPI(UsdLux.LightAPI)]


def fit_for_arkit(flat: Usd.Stage, warn: Callable[[str], None]) -> None:
    """Y up, and only what AR Quick Look takes: no cameras, no lights."""
    root = flat.GetDefaultPrim()
    lights = lights_of(flat)
    if lights:
        warn(f"the ARKit profile holds no lights; left out: {paths_of(lights)}.")
    cameras = [prim for prim in flat.TraverseAll() if prim.IsA(UsdGeom.Camera)]
    for path in sorted((prim.GetPath() for prim in [*cameras, *lights]), reverse=True):
        flat.RemovePrim(path)
    _remove_empty_scopes(flat)
    if UsdGeom.GetStageUpAxis(flat) != UsdGeom.Tokens.y:
        xform = UsdGeom.Xformable(root)
        if not xform:
            raise InputRefused(
                f"<{root.GetPath()}>: the default prim is no Xform, so the scene cannot be turned "
                "to y up. Wrap it in one. [package.up_axis]"
            )
        UsdGeom.SetStageUpAxis(flat, UsdGeom.Tokens.y)
        # By -90 degrees about x, before all that it does itself.
        order, reset = xform.GetOrderedXformOps(), xform.GetResetXformStack()
        turn = xform.AddTransformOp(opSuffix="yUp")
        turn.Set(Gf.Matrix4d(1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1))
        xform.SetXformOpOrder([turn, *order], reset)


def _keep_bound_materials(flat: Usd.Stage) -> None:
    """Delete materials that nothing is bound to, and nodes that no UsdPreviewSurface needs."""
    surfaces = [p for p in flat.TraverseAll() if p.IsA(UsdGeom.Gprim) or p.IsA(UsdGeom.Subset)]
    found = (
        UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)[0]
        for prim in surfaces
        for purpose in _PURPOSES
    )
    bound = {material.GetPath() for material in found if material}
    for prim in list(flat.TraverseAll()):
        if prim and prim.IsA(UsdShade.Material):
            if prim.GetPath() in bound:
                _keep_surface(flat, UsdShade.Material(prim))
            else:
                flat.RemovePrim(prim.GetPath())
    _remove_empty_scopes(flat)


def _keep_surface(flat: Usd.Stage, material: UsdShade.Material) -> None:
    for output in material.GetOutputs():
        if output.GetFullName() != "outputs:surface":
            material.GetPrim().RemoveProperty(output.GetFullName())
    needed: set[Sdf.Path] = set()
    surface = material.ComputeSurfaceSource()[0]
    waiting = [surface.GetPrim()] if surface else []
    while waiting:
        prim = waiting.pop()
        needed.update(prim.GetPath().GetPrefixes())
        for wanted in UsdShade.ConnectableAPI(prim).GetInputs():
            for source in wanted.GetValueProducingAttributes():
                if source.GetPrim().GetPath() not in needed:
                    waiting.append(source.GetPrim())
    for prim in list(Usd.PrimRange(material.GetPrim(), Usd.PrimAllPrimsPredicate)):
        if prim and prim.GetPath() not in needed and prim != material.GetPrim():
            flat.RemovePrim(prim.GetPath())


def _remove_empty_scopes(flat: Usd.Stage) -> None:
    root = flat.GetDefaultPrim()
    paths = [p.GetPath() for p in flat.TraverseAll() if p.GetTypeName() == "Scope" and p != root]
    for path in sorted(paths, reverse=True):  # children before their parents
        if not flat.GetPrimAtPath(path).GetAllChildren():
            flat.RemovePrim(path)


@reads_asset("folder")
def package(folder: Path, output: Path, options: PackageOptions | None = None) -> dict[str, Any]:
    """Write the asset in ``folder`` as one file: .usdz, or .glb for what reads no USD.

    The asset is what everybody opens, the artist's edits included, in one look; it is not changed.
    Equal assets give equal bytes. Returns a summary of plain values.

    Raises UsageError for options that exclude each other, and InputRefused where the asset names
    files outside of its folder.
    """
    summary = write_package(folder, output, options or PackageOptions(), warn)
    if missing := steps_to_come(Asset.made(folder)):
        warn(f"{output}: {not_run(missing)}; the package lacks what they measure.")
    return summary


def write_package(
    folder: Path, output: Path, options: PackageOptions, warn: Callable[[str], None]
) -> dict[str, Any]:
    """``package`` for whoever reads the asset already; ``warn`` is told what is left out."""
    asset = Asset.made(folder).in_lighting(options.lighting)
    options = replace(options, textures=_texture_format(output, asset, options))
    if options.whole:
        return _write_whole(output, asset, options)
    glb = output.suffix.lower() == GLB
    stage = stage_in_look(asset, options.look)
    flat = flattened(stage, asset, with_lights=not glb and options.profile != ARKIT)
    shapes = UsdGeom.Gprim, UsdGeom.PointInstancer
    if not any(prim.IsA(shape) for prim in flat.Traverse() for shape in shapes):
        raise InputRefused(
            f"{asset.folder}: no object of the asset is left to pack. Look at what edits.usda sets "
            "aside. [package.empty]"
        )
    with environment_failures(str(output)), folders_above(output), scratch_folder(output) as made:
        reduced: dict[str, int] = {}
        if options.low_poly is not None:
            count = make_low_poly(flat, asset, made, options.low_poly, warn)
            reduced = {"triangles": count}
            _keep_bound_materials(flat)
        if glb:
            texture_uses(flat, asset, made)  # refuses what lies outside
            # Our own reader is to return what renderers are told, not the lobe that is meant by it.
            for prim in flat.TraverseAll():
                if prim.HasAttribute(_MAPPING):
                    prim.RemoveProperty(_MAPPING)
            turn, subject = turned_up(str(UsdGeom.GetStageUpAxis(flat)), "Y"), asset.root_layer
            if lights := lights_of(flat):
                warn(f"{subject}: .glb packages hold no lights; left out: {paths_of(lights)}.")
            surfaces = surfaces_from_stage(flat, Usd.TimeCode.EarliestTime(), warn, subject)
            moved = [surface.moved(turn) for surface in surfaces]
            summary = write_glb(output, moved, options.max_size, warn)
        else:
            count = _write_usdz(output, flat, asset, options, made, warn)
            summary = {"textures": count, "format": options.textures, "profile": options.profile}
        size = output.stat().st_size
    return {"output": str(output), "look": look_of(stage), "bytes": size, **summary, **reduced}


def _write_whole(output: Path, asset: Asset, options: PackageOptions) -> dict[str, Any]:
    """The layers as they are, but without photographs, which no package holds."""
    root = f"{asset.name}.usdc"  # some readers take no text first

    def describe(layer: Sdf.Layer) -> None:
        layer.documentation = "A packed asset: all its looks and lightings are variants."

    with environment_failures(str(output)), folders_above(output):
        with scratch_folder(output) as folder:
            found = write_copy(
                asset,
                folder,
                root=root,
                encoding="",
                space=SPACES[options.texture_space],
                photographs=False,
                describe=describe,
                accept=_refuse_unpacked,
            )
            members = {found.places[file] for file in (*found.layers, *found.named_by)} - {root}
            write_usdz(output, folder, [root, *sorted(members)])
        size, textures = output.stat().st_size, len(found.named_by)
    return {"output": str(output), "look": "", "bytes": size, "textures": textures, "format": EXR}


def _refuse_unpacked(file: Path) -> None:
    if file.suffix.lower() not in IMAGES:
        raise InputRefused(
            f"{file}: USDZ holds {', '.join(sorted(IMAGES))} only. Convert it, or package one look "
            "without --whole. [package.format]"
        )


def _write_usdz(
    output: Path,
    flat: Usd.Stage,
    asset: Asset,
    options: PackageOptions,
    made: Path,
    warn: Callable[[str], None],
) -> int:
    """Returns the number of textures; ``made`` holds those that the asset has not."""
    if options.profile == ARKIT:
        fit_for_arkit(flat, warn)
    space, colours = SPACES[options.texture_space], ColourTextures()
    if space != WORKING_SPACE:
        colours.look_at(flat, space)
        convert_layer(flat.GetRootLayer(), colours, space)
    with scratch_folder(output) as folder:
        textures: dict[tuple[Any, ...], NewTexture] = {}
        packed: set[str] = set()
        for use in texture_uses(flat, asset, made):
            # Each once, however many nodes read it in the same way.
            key = (use.file, use.space, use.colour, use.reads_alpha)
            if key not in textures:
                form, most = str(options.textures), options.max_size
                convert = partial(in_space, space=space) if use.file in colours.files else None
                textures[key] = add_texture(use, folder, packed, form, most, convert, space)
                packed.add(textures[key].path)
            use_texture(flat, use, textures[key])
        others: dict[str, str] = {}
        for path in sorted(named_files(flat.GetRootLayer()) - {f"./{path}" for path in packed}):
            file, taken = file_in_asset(path, asset), {*packed, *others.values()}
            convert = partial(in_space, space=space) if file in colours.files else None
            others[path] = add_file(
                file,
                asset.folder.resolve(),
                folder,
                taken,
                convert,
                space if convert else WORKING_SPACE,
            )
        UsdUtils.ModifyAssetPaths(
            flat.GetRootLayer(), lambda path: f"./{others[path]}" if path in others else path
        )
        root = f"{asset.name}.usdc"
        export(flat.GetRootLayer(), folder / root, folder=folder)
        write_usdz(output, folder, [root, *sorted({*packed, *others.values()})])
    return len(packed)


def _texture_format(output: Path, asset: Asset, options: PackageOptions) -> Literal["exr", "png"]:
    """Refuses what can be refused before the asset is opened."""
    suffix = output.suffix.lower()
    if suffix not in (USDZ, GLB):
        raise UsageError(f"{output}: packages are {USDZ} or {GLB} files. [package.format]")
    if options.profile == ARKIT and suffix == GLB:
        raise UsageError(f"{output}: the ARKit profile is one of {USDZ}. [package.profile]")
    if suffix == GLB:
        need_pillow()
    eight_bit = options.profile == ARKIT or suffix == GLB
    if eight_bit and options.textures == EXR:
        raise UsageError(
            f"--textures exr: {'ARKit' if suffix == USDZ else 'glTF'} knows PNG and JPEG only. "
            "[package.textures]"
        )
    of_one_look = {
        "--look": options.look, "--lighting": options.lighting, "--max-size": options.max_size,
        "--profile": options.profile == ARKIT, "--textures png": options.textures == "png",
        "--low-poly": options.low_poly, ".glb": suffix == GLB,
    }  # fmt: skip
    if options.whole and (excluded := [name for name, given in of_one_look.items() if given]):
        raise UsageError(
            f"--whole: packs all layers as they are, without {', '.join(excluded)}. Leave one of "
            "both out. [package.whole]"
        )
    if options.texture_space != "rec709" and (eight_bit or options.textures == "png"):
        raise UsageError(
            f"--texture-space {options.texture_space}: 8-bit textures are sRGB, which programs "
            "convert by themselves. Pack EXR textures. [package.space]"
        )
    if output.is_dir():
        raise OwnershipConflict(f"{output}: a folder has this name. Choose another. [package.name]")
    asset.refuse_output(output, "package.output")
    refuse_unwritable(output)
    return options.textures or ("png" if eight_bit else "exr")


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
            whole = writer.Save() and _is_whole(staged, members)
            stage, why = Usd.Stage.Open(str(staged)) if whole else None, ""
        except Tf.ErrorException as error:
            stage, why = None, f" ({in_one_line(error)})"
        if stage is None:
            raise EnvironmentFailure(
                f"{path}: the package could not be written completely{why}. "
                f"{cure_of_writing(staged)}, then run the same command again. [package.write]"
            )
        problems = [in_one_line(problem) for problem in stage.GetCompositionErrors()]
        for attribute in (a for prim in stage.TraverseAll() for a in prim.GetAuthoredAttributes()):
            value = attribute.Get()
            if isinstance(value, Sdf.AssetPath) and value.path and not value.resolvedPath:
                problems.append(f"<{attribute.GetPath()}> finds no {value.path}")
        if problems:
            raise UsdBrdfError(
                f"{path}: the package does not compose: {problems[0]}. This is a defect of "
                "usdbrdf; please report it. [package.composition]"
            )
        publish(staged, path)


def _is_whole(package: Path, members: Sequence[str]) -> bool:
    """Whether all that was packed can be read: USD's writer goes on where the disk is full."""
    try:
        with zipfile.ZipFile(package) as found:
            # USD writes UTF-8 without the flag that says so; Python takes it for code page 437.
            names = {
                item.filename if item.flag_bits & _UTF8 else item.filename.encode("cp437").decode()
                for item in found.infolist()
            }
            return set(members) <= names and found.testzip() is None
    except (zipfile.BadZipFile, OSError, EOFError, UnicodeDecodeError):
        return False
