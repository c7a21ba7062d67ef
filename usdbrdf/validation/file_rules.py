"""Rules about the files of an asset: its layers are there, in order and of one mind; what they
name is named so that the asset can move, there, and needed."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from pxr import Ar, Sdf, Usd

from usdbrdf.asset.layout import ROLES
from usdbrdf.asset.manifest import changes
from usdbrdf.asset.properties import SCHEMA_VERSION
from usdbrdf.asset.readers.scene import asset_file
from usdbrdf.errors import InputRefused
from usdbrdf.job.ownership import edited_files
from usdbrdf.validation.rule import AssetStage, Fault, Severity, Site, located, record_of, rule

_HEADER = ("metersPerUnit", "upAxis", "timeCodesPerSecond")
_UDIM = "<UDIM>"
# A letter before a colon is a drive.
_URI = re.compile(r"[A-Za-z][A-Za-z0-9+-]+:")


@rule(Severity.ERROR)
def layer_missing(scene: AssetStage) -> Iterator[Fault]:
    """The root layer names edits.usda and the layers of all tasks, and they are there. USD passes
    over a missing sublayer with a message that is easily lost.

    Run usdbrdf convert again, which makes what is missing; or restore the sublayers of the root
    layer."""
    named, expected = _sublayers(scene)
    for layer in expected:
        if layer not in named:
            yield Fault(scene.asset_root, f"@{layer}@ is not among its sublayers.")
        elif not layer.is_file():
            yield Fault(scene.asset_root, f"its sublayer @{layer}@ is not there.")


@rule(Severity.ERROR)
def layer_order(scene: AssetStage) -> Iterator[Fault]:
    """Strongest first the sublayers are edits.usda, material, shading, texturing, scan. In another
    order the lobe of a material is hidden by the task before it, or the artist's edits by a
    measurement. Other layers may stand between them. lights, texturing_uv and materialx are no
    sublayers of the root, but of the layers that own them.

    Restore the order in the root layer; mute a layer instead of moving it."""
    named, expected = _sublayers(scene)
    found = [layer for layer in named if layer in expected]
    if found != [layer for layer in expected if layer in found]:
        yield Fault(
            scene.asset_root,
            f"the sublayers are in the order {', '.join(p.name for p in found)}; "
            f"strongest first it is {', '.join(p.name for p in expected)}.",
        )


def _sublayers(scene: AssetStage) -> tuple[list[Path], list[Path]]:
    """Those that the root layer names, and those that it should, strongest first."""
    root, asset = scene.asset_root, scene.asset
    if not root or not asset:
        return [], []
    named = [located(root, path) for path in root.subLayerPaths]
    return named, [asset.edits_layer, *(asset.layer(role) for role in reversed(ROLES))]


@rule(Severity.ERROR)
def layer_header(scene: AssetStage) -> Iterator[Fault]:
    """No layer states other units, another up axis or another rate of time codes than the root
    layer. USD believes the root for the first two, so that the layer's content has the wrong size
    or lies on its side, and rescales its time samples for the third: photographs then meet the
    wrong poses.

    Correct the metadata of the layer, or bring it in by a reference with a correcting transform."""
    root = scene.asset_root
    if root:
        stated = [name for name in _HEADER if root.pseudoRoot.HasInfo(name)]
        for layer in scene.layers:
            for name in (name for name in stated if layer.pseudoRoot.HasInfo(name)):
                theirs, ours = (x.pseudoRoot.GetInfo(name) for x in (layer, root))
                if theirs != ours:
                    yield Fault(layer, f"{name} is {theirs}, but {ours} in @{root.realPath}@.")


@rule(Severity.ERROR)
def schema_version(scene: AssetStage) -> Iterator[Fault]:
    """The layers state a version of the usdBrdf schemas (customLayerData.usdbrdf.schemaVersion)
    that this usdbrdf knows. In a newer one an attribute may mean something else.

    Install the version of usdbrdf that wrote the asset."""
    for layer in scene.layers:
        # The layers of the first version do not state it.
        version = record_of(layer).get("schemaVersion", 1)
        if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
            problem = (
                f"its schema version is {version!r}; this usdbrdf knows 1 to {SCHEMA_VERSION}."
            )
            yield Fault(layer, problem)


@rule(Severity.WARNING)
def layer_edited(scene: AssetStage) -> Iterator[Fault]:
    """Layers and textures that the pipeline wrote are as it wrote them. Edits belong into
    edits.usda: those made elsewhere stop the next run, or are lost with it.

    Keep them with usdbrdf convert --adopt, or give them up with --discard."""
    if scene.asset and scene.asset_root:
        for relative in edited_files(scene.asset.folder):
            yield Fault(
                scene.asset_root,
                f"@{scene.asset.folder / relative}@ was edited by hand: the next run would "
                "write it again, and refuses to.",
            )


@rule(Severity.ERROR)
def anchored_path(scene: AssetStage) -> Iterator[Fault]:
    """Every path in a layer begins with ./ or ../ . Absolute paths lead nowhere on another machine;
    paths without a dot are looked up wherever a site's resolver is set up to, and packages rename
    them. A path with a scheme, such as https:, is a warning alone, and no other rule looks for its
    file.

    Bring the file into the asset's folder and name it relative to the layer."""
    for layer, path, value in scene.asset_paths if scene.asset else ():
        site, said = _site(scene.stage, layer, path), f"@{value}@ in @{layer.realPath}@"
        if _URI.match(value):
            problem = f"{said} is for a resolver that others may not have."
            yield Fault(site, problem, severity=Severity.WARNING)
        elif not value.startswith(("./", "../")):
            yield Fault(site, f"{said} does not begin with ./ or ../ .")


def _site(stage: Usd.Stage, layer: Sdf.Layer, path: Sdf.Path) -> Site:
    """The property where the stage has it; else the layer that names the file."""
    found = stage.GetPropertyAtPath(path) if path.IsPropertyPath() else None
    return found if found else layer


@rule(Severity.WARNING)
def path_outside(scene: AssetStage) -> Iterator[Fault]:
    """What the layers name lies in the asset's folder, apart from the photographs and from geometry
    that came as USD. An asset that is copied or packed leaves the rest behind.

    Bring the file into the asset's folder."""
    if not scene.asset:
        return
    folder, scan = Path(os.path.realpath(scene.asset.folder)), scene.asset.layer("scan")
    for layer, path, value in scene.asset_paths:
        # The photographs, and geometry that came as USD, stay where the capture has them.
        if value.startswith(("./", "../")) and Path(layer.realPath) != scan:
            file = Path(os.path.realpath(located(layer, value)))
            if not file.is_relative_to(folder):
                problem = f"@{value}@ in @{layer.realPath}@ leads out of the asset's folder."
                yield Fault(_site(scene.stage, layer, path), problem)


@rule(Severity.ERROR)
def missing_texture(scene: AssetStage) -> Iterator[Fault]:
    """Every texture that the composed stage names exists, and every file that a layer names in its
    metadata, such as clips and thumbnails. Renderers show the fallback, or black, in place of a
    texture that does not.

    Run usdbrdf convert again, which makes missing textures anew; or restore the file."""
    for file, sites, cameras in _missing(scene):
        if not cameras:
            more = f" It is named {len(sites)} times." if len(sites) > 1 else ""
            yield Fault(sites[0], f"@{file}@ does not exist.{more}")


@rule(Severity.WARNING)
def missing_photograph(scene: AssetStage) -> Iterator[Fault]:
    """The photographs that the capture camera names exist. They are not needed to render the asset,
    but to evaluate it and to measure anything anew.

    Put the capture back where it was; ignore it where the asset is only shown."""
    # Each file once, and one fault for all files that an attribute is the first to name.
    gone: dict[Site, list[Path]] = defaultdict(list)
    for file, _, cameras in _missing(scene):
        if cameras:
            gone[cameras[0]].append(file)
    for site, files in gone.items():
        more = f" Nor do {len(files) - 1} more of its photographs." if len(files) > 1 else ""
        yield Fault(site, f"@{files[0]}@ does not exist.{more}")


def _missing(scene: AssetStage) -> Iterator[tuple[Path, list[Site], list[Site]]]:
    """Files that are not there, where the composed stage, or a variant, names them, and which of
    these places are attributes of a capture camera."""
    missing: dict[Path, list[Site]] = defaultdict(list)
    for prim in scene.stage.Traverse() if scene.asset else ():
        for attribute in prim.GetAuthoredAttributes():
            if attribute.GetTypeName() == Sdf.ValueTypeNames.Asset:
                times = [Usd.TimeCode.Default(), *attribute.GetTimeSamples()]
                known = {time: attribute.Get(time) for time in times}
                local = [time for time, v in known.items() if v is None or not _URI.match(v.path)]
                for file in {asset_file(attribute, time) for time in local}:
                    if file is not None and not _is_there(file):
                        missing[file].append(attribute)
    for layer, path, value in scene.asset_paths:
        file = located(layer, value)
        uncomposed = path.isEmpty or path.ContainsPrimVariantSelection()
        if uncomposed and not _URI.match(value) and file not in missing and not _is_there(file):
            missing[file].append(layer)
    for file, sites in sorted(missing.items()):
        named = [site for site in sites if isinstance(site, Usd.Attribute)]
        yield file, sites, [site for site in named if site.GetPrim() in scene.cameras]


def _is_there(file: Path) -> bool:
    if Ar.IsPackageRelativePath(str(file)):
        return bool(Ar.GetResolver().Resolve(str(file)))
    if _UDIM not in file.name or file.is_file():
        return file.is_file()
    folder = file.parent
    return folder.is_dir() and any(map(_pattern(file.name).fullmatch, os.listdir(folder)))


def _pattern(name: str) -> re.Pattern[str]:
    """What the name of a file, or of one of the tiles that <UDIM> stands for, matches."""
    return re.compile(re.escape(name).replace(re.escape(_UDIM), r"\d{4}"))


@rule(Severity.WARNING)
def orphan_texture(scene: AssetStage) -> Iterator[Fault]:
    """Every file in the folder textures is named by some layer. One that is not is left over from
    an earlier run or from another tool, and makes packages larger.

    Remove the file, or name it in edits.usda."""
    folder = scene.asset.folder / "textures" if scene.asset else None
    if folder is None or scene.asset_root is None or not folder.is_dir():
        return
    if any(record_of(layer).get("state") == "pending" for layer in scene.own_layers):
        return  # the textures of a stage that runs again may be there before its layer
    paths = [(layer, value) for layer, _, value in scene.asset_paths if not _URI.match(value)]
    named = {located(layer, value).name for layer, value in paths}
    tiles = [_pattern(name) for name in named if _UDIM in name]
    for file in sorted(folder.iterdir()):
        known = file.name in named or any(tile.fullmatch(file.name) for tile in tiles)
        if not known and file.is_file() and not file.name.startswith("."):
            yield Fault(scene.asset_root, f"no layer names @{file}@.")


@rule(Severity.ERROR)
def published_file(scene: AssetStage) -> Iterator[Fault]:
    """The files of a published version are those of its manifest, byte for byte. Others may have
    taken the version in already: one that changes shows two people two things under one name.

    Bring the file back from a copy, or publish the next version."""
    if not (scene.asset and scene.asset_root and scene.asset.is_published):
        return
    try:
        for file, what in changes(scene.asset.folder):
            yield Fault(scene.asset_root, f"@{file}@ {what} since it was published.")
    except InputRefused as problem:
        yield Fault(scene.asset_root, str(problem).rpartition(" [")[0])
