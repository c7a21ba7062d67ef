"""Rules about the files of an asset: its layers are there, in order and of one mind; what they
name is named so that the asset can move, there, and needed."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from pxr import Ar, Sdf, Tf, Usd

from usdbrdf.asset.layout import record_of
from usdbrdf.asset.manifest import changes
from usdbrdf.asset.properties import SCHEMA_VERSION
from usdbrdf.asset.readers.compose import named_files
from usdbrdf.asset.readers.scene import asset_file
from usdbrdf.asset.readers.tried import try_layers
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.images import read_exr
from usdbrdf.files.published_images import misnamed
from usdbrdf.job.ownership import edited_files
from usdbrdf.job.stamp import STATE_FOLDER, known_hashes
from usdbrdf.validation.rule import AssetStage, Fault, Severity, Site, located, rule

_HEADER = ("metersPerUnit", "upAxis", "timeCodesPerSecond")
_UDIM = "<UDIM>"
_PICTURES = frozenset({".exr", ".hdr", ".jpeg", ".jpg", ".png", ".tif", ".tiff"})
# A letter before a colon is a drive.
_URI = re.compile(r"[A-Za-z][A-Za-z0-9+-]+:")


@rule(Severity.ERROR)
def layer_missing(scene: AssetStage) -> Iterator[Fault]:
    """The root layer names edits.usda and what the tasks let be chosen, contents.usda the layers of
    all tasks, and they are there. USD passes over a missing sublayer with a message that is easily
    lost.

    Run usdbrdf convert again, which makes what is missing; or restore the sublayers of the root
    layer."""
    for path, holder in scene.missing_layers.items():
        kind = "payload" if scene.asset and path == scene.asset.contents_layer else "sublayer"
        yield Fault(holder, f"its {kind} @{path}@ is not there.")
    for holder, named, expected in scene.expected_sublayers:
        for layer in expected:
            if layer not in named and layer not in scene.missing_layers:
                yield Fault(holder, f"@{layer}@ is not among its sublayers.")


@rule(Severity.ERROR)
def layer_order(scene: AssetStage) -> Iterator[Fault]:
    """Strongest first the sublayers of contents.usda are material, shading, texturing, scan; the
    root layer has edits.usda before the interfaces of these. In another order the lobe of a
    material is hidden by the task before it, or the artist's edits by a measurement. Other layers
    may stand between them. lights, texturing_uv and materialx are sublayers of the layers that own
    them.

    Restore the order in the root layer; mute a layer instead of moving it."""
    for holder, named, expected in scene.expected_sublayers:
        found = [layer for layer in named if layer in expected]
        if found != [layer for layer in expected if layer in found]:
            yield Fault(
                holder,
                f"the sublayers are in the order {', '.join(p.name for p in found)}; "
                f"strongest first it is {', '.join(p.name for p in expected)}.",
            )


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
    edits.usda: those made elsewhere stop the next run, or are lost with it. One that holds what
    another was written with is an error: it shows the maps of one object on another, or the wrong
    ones.

    Keep edits with usdbrdf convert --adopt, or give them up with --discard, which undoes a mix-up
    too."""
    if not scene.asset or not scene.asset_root:
        return
    folder, owners = scene.asset.folder, dict[str, str]()
    for relative, hashes in sorted(known_hashes(folder / STATE_FOLDER).items()):
        owners.update(dict.fromkeys(hashes, relative))
    for relative in edited_files(folder):
        file = folder / relative
        if other := owners.get(sha256_of(file)):
            problem = f"@{file}@ holds what was written into @{folder / other}@."
            yield Fault(scene.asset_root, problem, Severity.ERROR)
        else:
            yield Fault(
                scene.asset_root,
                f"@{file}@ was edited by hand: the next run would write it again, and refuses to.",
            )


@rule(Severity.ERROR)
def anchored_path(scene: AssetStage) -> Iterator[Fault]:
    """Every path in a layer begins with ./ or ../ . Absolute paths lead nowhere on another machine;
    paths without a dot are looked up wherever a site's resolver is set up to, and packages rename
    them. A path with a scheme, such as https:, is a warning alone, and no other rule looks for its
    file.

    Bring the file into the asset's folder and name it relative to the layer."""
    known = scene.root_prim.GetAssetInfoByKey("identifier") if scene.root_prim else None
    for layer, path, value in scene.asset_paths if scene.asset else ():
        site, said = _site(scene.stage, layer, path), f"@{value}@ in @{layer.realPath}@"
        if _URI.match(value):
            if isinstance(known, Sdf.AssetPath) and value == known.path:
                continue  # by which others find the asset, and nothing of it
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
    """What the layers name lies in the asset's folder, apart from geometry that came as USD. An
    asset that is copied or packed leaves the rest behind.

    Bring the file into the asset's folder."""
    if not scene.asset:
        return
    folder = Path(os.path.realpath(scene.asset.folder))
    scan = [scene.asset.layer("scan"), scene.asset.interface("scan")]
    for layer, path, value in scene.asset_paths:
        # Geometry that came as USD stays where the capture has it.
        if value.startswith(("./", "../")) and Path(layer.realPath) not in scan:
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
    for file, sites in _missing(scene):
        more = f" It is named {len(sites)} times." if len(sites) > 1 else ""
        yield Fault(sites[0], f"@{file}@ does not exist.{more}")


@rule(Severity.ERROR)
def unreadable_texture(scene: AssetStage) -> Iterator[Fault]:
    """Every picture that a layer names can be read to its last pixel, and is of the format that its
    name says. Of one that was cut off, by a copy that was interrupted, renderers show a part,
    black, or nothing; a JPEG that is called .exr some of them do not open.

    Bring the file back from a copy, or rename it; or delete it and run usdbrdf convert, which makes
    it anew."""
    if not scene.asset:
        return
    named: dict[Path, tuple[Sdf.Layer, Sdf.Path]] = {}
    for layer, path, value in scene.asset_paths:
        file = located(layer, value)
        if file.suffix.lower() in _PICTURES and not _URI.match(value) and file.is_file():
            named.setdefault(file, (layer, path))
    for file, (layer, path) in sorted(named.items()):
        severity = None
        try:
            read_exr(file)
            if not (said := misnamed(file)):
                continue
            if scene.asset.is_published:  # then it came with the capture, and may not change
                severity = Severity.WARNING
        except UsdBrdfError as problem:
            said = str(problem).rpartition(" [")[0].removeprefix(f"{file}: ")
        yield Fault(_site(scene.stage, layer, path), f"@{file}@: {said}", severity)


@rule(Severity.WARNING)
def missing_photograph(scene: AssetStage) -> Iterator[Fault]:
    """The photographs that photographs.usdc names exist. They are not needed to render the asset,
    but to evaluate it and to measure anything anew. Without any the asset is likely a copy: that
    is worth knowing, and no warning.

    Put the capture back where it was; ignore it where the asset is only shown."""
    file = scene.asset.photographs_layer if scene.asset else None
    if file is None or not file.is_file():
        return
    try:
        try_layers([file])
        layer = Sdf.Layer.FindOrOpen(str(file))
    except (Tf.ErrorException, InputRefused):
        layer = None
    if layer is None:
        problem = f"@{file}@ cannot be read. usdbrdf convert makes it anew."
        yield Fault(scene.asset_root or scene.stage.GetRootLayer(), problem)
        return
    named = sorted({located(layer, path) for path in named_files(layer)})
    if gone := [path for path in named if not _is_there(path)]:
        more = f" Nor do {len(gone) - 1} more of its photographs." if len(gone) > 1 else ""
        severity = Severity.INFO if len(gone) == len(named) > 1 else None
        yield Fault(layer, f"@{gone[0]}@ does not exist.{more}", severity)


def _missing(scene: AssetStage) -> Iterator[tuple[Path, list[Site]]]:
    """Files that are not there, where the composed stage, or a variant, names them; but for the
    photographs of a capture's camera."""
    missing: dict[Path, list[Site]] = defaultdict(list)
    prims: list[Usd.Prim] = []
    if scene.asset:
        prims = [*scene.stage.Traverse(), *chain.from_iterable(scene.only_in_other_looks())]
    for prim in (prim for prim in prims if prim not in scene.cameras):
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
        if file in scene.missing_layers:
            continue
        uncomposed = path.isEmpty or path.ContainsPrimVariantSelection()
        if uncomposed and not _URI.match(value) and file not in missing and not _is_there(file):
            missing[file].append(layer)
    yield from sorted(missing.items())


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
    pending = any(record_of(layer).get("state") == "pending" for layer in scene.own_layers)
    if pending or scene.missing_layers:
        return  # their layer is written after them, or gone
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
