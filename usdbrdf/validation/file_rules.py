"""Rules about files: named so that the asset can move, there, and needed."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from pxr import Ar, Sdf, Usd

from usdbrdf.asset.readers.scene import asset_file
from usdbrdf.validation.asset_stage import AssetStage, located, record_of
from usdbrdf.validation.rule import Fault, Severity, Site, rule

_UDIM = "<UDIM>"
# A letter before a colon is a drive.
_URI = re.compile(r"[A-Za-z][A-Za-z0-9+-]+:")


@rule(
    Severity.ERROR,
    advice="Bring the file into the asset's folder and name it relative to the layer.",
)
def anchored_path(scene: AssetStage) -> Iterator[Fault]:
    """Every path in a layer begins with ./ or ../ . Absolute paths lead nowhere on another machine;
    paths without a dot are looked up wherever a site's resolver is set up to, and packages rename
    them. A path with a scheme, such as https:, is a warning alone, and no other rule looks for its
    file."""
    if scene.asset:
        for layer, path, value in scene.asset_paths:
            if _URI.match(value):
                yield Fault(
                    _site(scene.stage, layer, path),
                    f"@{value}@ in @{layer.realPath}@ is for a resolver that others may not have.",
                    severity=Severity.WARNING,
                )
            elif not value.startswith(("./", "../")):
                yield Fault(
                    _site(scene.stage, layer, path),
                    f"@{value}@ in @{layer.realPath}@ does not begin with ./ or ../ .",
                )


def _site(stage: Usd.Stage, layer: Sdf.Layer, path: Sdf.Path) -> Site:
    """The property where the stage has it; else the layer that names the file."""
    found = stage.GetPropertyAtPath(path) if path.IsPropertyPath() else None
    return found if found else layer


@rule(Severity.WARNING, advice="Bring the file into the asset's folder.")
def path_outside(scene: AssetStage) -> Iterator[Fault]:
    """What the layers name lies in the asset's folder, apart from the photographs and from geometry
    that came as USD. An asset that is copied or packed leaves the rest behind."""
    if not scene.asset:
        return
    folder = Path(os.path.realpath(scene.asset.folder))
    scan = scene.asset.layer("scan")
    for layer, path, value in scene.asset_paths:
        # The photographs, and geometry that came as USD, stay where the capture has them.
        if value.startswith(("./", "../")) and Path(layer.realPath) != scan:
            file = Path(os.path.realpath(located(layer, value)))
            if not file.is_relative_to(folder):
                yield Fault(
                    _site(scene.stage, layer, path),
                    f"@{value}@ in @{layer.realPath}@ leads out of the asset's folder.",
                )


@rule(
    Severity.ERROR,
    advice="Run usdbrdf convert again, which makes missing textures anew; or restore the file.",
)
def missing_texture(scene: AssetStage) -> Iterator[Fault]:
    """Every texture that the composed stage names exists, and every file that a layer names in its
    metadata, such as clips and thumbnails. Renderers show the fallback, or black, in place of a
    texture that does not."""
    for file, sites in sorted(_missing(scene).items()):
        if not any(_of_camera(scene, site) for site in sites):
            more = f" It is named {len(sites)} times." if len(sites) > 1 else ""
            yield Fault(sites[0], f"@{file}@ does not exist.{more}")


@rule(
    Severity.WARNING,
    advice="Put the capture back where it was; ignore it where the asset is only shown.",
)
def missing_photograph(scene: AssetStage) -> Iterator[Fault]:
    """The photographs that the capture camera names exist. They are not needed to render the asset,
    but to evaluate it and to measure anything anew."""
    # Each file once, and one fault for all files that an attribute is the first to name.
    gone: dict[Site, list[Path]] = defaultdict(list)
    for file, sites in sorted(_missing(scene).items()):
        cameras = [site for site in sites if _of_camera(scene, site)]
        if cameras:
            gone[cameras[0]].append(file)
    for site, files in gone.items():
        more = f" Nor do {len(files) - 1} more of its photographs." if len(files) > 1 else ""
        yield Fault(site, f"@{files[0]}@ does not exist.{more}")


def _of_camera(scene: AssetStage, site: Site) -> bool:
    return isinstance(site, Usd.Attribute) and site.GetPrim() in scene.cameras


def _missing(scene: AssetStage) -> dict[Path, list[Site]]:
    """Files that are not there, and where the composed stage, or a variant, names them."""
    missing: dict[Path, list[Site]] = defaultdict(list)
    for prim in scene.stage.Traverse() if scene.asset else ():
        for attribute in prim.GetAuthoredAttributes():
            if attribute.GetTypeName() != Sdf.ValueTypeNames.Asset:
                continue
            times = [Usd.TimeCode.Default(), *attribute.GetTimeSamples()]
            files = {asset_file(attribute, t) for t in times if not _is_uri(attribute.Get(t))}
            for file in files:
                if file is not None and not _is_there(file):
                    missing[file].append(attribute)
    for layer, path, value in scene.asset_paths:
        file = located(layer, value)
        uncomposed = path.isEmpty or path.ContainsPrimVariantSelection()
        if uncomposed and not _URI.match(value) and file not in missing and not _is_there(file):
            missing[file].append(layer)
    return missing


def _is_uri(value: Sdf.AssetPath | None) -> bool:
    return value is not None and bool(_URI.match(value.path))


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


@rule(Severity.WARNING, advice="Remove the file, or name it in edits.usda.")
def orphan_texture(scene: AssetStage) -> Iterator[Fault]:
    """Every file in the folder textures is named by some layer. One that is not is left over from
    an earlier run or from another tool, and makes packages larger."""
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


RULES = (anchored_path, path_outside, missing_texture, missing_photograph, orphan_texture)
