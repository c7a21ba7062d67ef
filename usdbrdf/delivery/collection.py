"""All that an asset is made of, its layers and what they name, and a folder that holds a copy of it
and needs nothing else: every layer with all its variants, every path leading to a copy.

Which layers there are and how they name each other is for the layers to say: nothing here knows how
an asset is divided."""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from pxr import Ar, Sdf, Tf, UsdUtils

from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import in_one_line, named_files, open_stage
from usdbrdf.asset.readers.tried import try_layers
from usdbrdf.delivery.packaged_files import ADDRESS
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.files.atomic import cure_of_writing

PHOTOGRAPHS, CAPTURED = "photographs", "captured"  # folders for what lies elsewhere
_LAYERS = frozenset({".usd", ".usda", ".usdc"})
# Attributes that tell which photographs and masks these are, and schemas about nothing else.
OF_PHOTOGRAPHS = (
    "usdBrdf:capture:image", "usdBrdf:capture:photograph", "usdBrdf:capture:mask",
    "usdBrdf:capture:sha256", "backPlate:",
)  # fmt: skip
SCHEMAS_OF_PHOTOGRAPHS = ("BackPlateAPI:",)
_UDIM = "<UDIM>"
# In MaterialX documents: what pictures and other documents are named by.
_NAMES_FILES = (b"filename", b"xi:include", b"fileprefix")


@dataclass(kw_only=True)
class Collection:
    """What an asset is made of. Files go by their absolute place, the folders' links followed.

    layers       copies of all of them, the root first
    changed      those of them that say something else than their files
    places       of layers and of all other files: where they go, relative to the new folder
    named_by     files that are no layers: the attributes that name them, by their names
    photographs  those of the files that are photographs, or their masks
    """

    asset: Asset
    layers: dict[Path, Sdf.Layer] = field(default_factory=dict)
    changed: set[Path] = field(default_factory=set)
    places: dict[Path, str] = field(default_factory=dict)
    named_by: dict[Path, set[str]] = field(default_factory=lambda: defaultdict(set))
    photographs: set[Path] = field(default_factory=set)

    @property
    def own(self) -> frozenset[Path]:
        """Files that are no layers and lie in the asset's folder: its maps, and an artist's."""
        home = os.path.realpath(self.asset.folder)
        return frozenset(f for f in self.named_by if f.is_relative_to(home)) - self.photographs


def collected(asset: Asset, root: str, *, photographs: bool) -> Collection:
    """The asset as everybody opens it, all variants, the artist's edits included.

    root         the new name of its root layer
    photographs  whether these, and what says where they are, belong to it

    Raises InputRefused for files that are not there, and for those outside of the asset's folder,
    but for photographs and geometry that came with the capture.
    """
    found = Collection(asset=asset)
    top, edits = canonical(asset.root_layer), canonical(asset.edits_layer)
    ours = [one.layer(role) for one in (asset, *asset.in_each_lighting) for role in ROLES]
    # No layer names the one that says where the photographs are.
    taken = [asset.photographs_layer] if photographs else []
    beside = [canonical(file) for file in taken if file.is_file()]
    # Layers of ours may name what lies elsewhere; what only the artist's layers reach may not.
    own = [canonical(file) for file in ours if file.is_file()]
    # Together, for a child takes a second; what else they lead to each in its turn.
    try_layers([*own, *beside, *map(canonical, sorted(asset.folder.glob("objects/*/*.usd*")))])
    measured = _reached([*own, *beside], {top, edits})
    layers = _reached([top, *beside], set())
    found.places = {top: root, edits: "layers/edits.usda"}
    for file, layer in layers.items():
        if not photographs and forget_photographs(layer):
            found.changed.add(file)
        _refuse_what_is_not_followed(file, layer)
        found.layers[file] = layer
        _place(found, file, file in measured, CAPTURED)
    for file, layer in found.layers.items():
        for path, attribute in _paths(layer):
            is_photograph = attribute.startswith(OF_PHOTOGRAPHS)
            for target in _targets(file, path):
                if target in found.layers:
                    continue
                if not target.is_file():
                    raise _missing(asset, target, file, is_photograph)
                if is_photograph:
                    found.photographs.add(target)
                found.named_by[target].add(attribute)
                folder = PHOTOGRAPHS if is_photograph else CAPTURED
                _place(found, target, file in measured, folder)
    return found


def write_collection(
    found: Collection,
    folder: Path,
    *,
    edit: Callable[[Sdf.Layer, bool], bool],
    write: Callable[[Path, Path], None],
    encodings: Mapping[str, str],
) -> None:
    """Write a copy of all of it into a folder.

    edit       changes a layer, told whether it is the root layer; returns whether it did
    write      writes a file that is no layer to a place
    encodings  layers that are always written anew, by place: "usda" or "usdc" where their names
               do not say it, else ""
    """
    for file in found.named_by:
        place = folder / found.places[file]
        place.parent.mkdir(parents=True, exist_ok=True)
        write(file, place)
    for i, (file, layer) in enumerate(found.layers.items()):
        name = found.places[file]
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        moved, edited = _lead_to_copies(found, file, layer), edit(layer, i == 0)
        if moved or edited or file in found.changed or name in encodings:
            _export(layer, folder / name, encodings.get(name, ""))
        else:
            shutil.copyfile(file, folder / name)


def forget_photographs(layer: Sdf.Layer) -> bool:
    """Take out what says which the photographs and their masks are, and where; returns whether
    there was any."""
    gone: list[Sdf.PropertySpec] = []
    changed: list[Sdf.Path] = []

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PropertySpec) and spec.name.startswith(OF_PHOTOGRAPHS):
            gone.append(spec)
        elif isinstance(spec, Sdf.PrimSpec) and spec.HasInfo("apiSchemas"):
            schemas = spec.GetInfo("apiSchemas")
            if any(name.startswith(SCHEMAS_OF_PHOTOGRAPHS) for name in schemas.GetAppliedItems()):
                kept = [
                    name
                    for name in schemas.GetAppliedItems()
                    if not name.startswith(SCHEMAS_OF_PHOTOGRAPHS)
                ]
                make = Sdf.TokenListOp
                own = make.CreateExplicit(kept) if schemas.isExplicit else make.Create(kept)
                spec.SetInfo("apiSchemas", own)
                changed.append(spec.path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    for spec in gone:
        spec.owner.RemoveProperty(spec)
    return bool(gone or changed)


def _reached(start: Sequence[Path], stop: set[Path]) -> dict[Path, Sdf.Layer]:
    """Copies of the layers at ``start``, and of those that they name, directly or by others."""
    found: dict[Path, Sdf.Layer] = {}
    waiting = [*start]
    # As many as are known of at a time, for a child takes a second.
    while new := [file for file in dict.fromkeys(waiting) if file not in {*found, *stop}]:
        try_layers(new)
        found |= {file: _copy_of(file) for file in new}
        named = [(file, path) for file in new for path in sorted(named_files(found[file]))]
        targets = [target for file, path in named for target in _targets(file, path)]
        waiting = [t for t in targets if t.suffix.lower() in _LAYERS and t.is_file()]
    return found


def _copy_of(file: Path) -> Sdf.Layer:
    try:
        copy, why = Sdf.Layer.OpenAsAnonymous(str(file)), "it is not there"
    except Tf.ErrorException as error:
        copy, why = None, in_one_line(error)
    if not copy:
        raise InputRefused(
            f"{file}: USD cannot open it: {why}. Correct that layer, or bring back an earlier "
            "copy. [publish.layer]"
        )
    return copy


def _paths(layer: Sdf.Layer) -> Iterator[tuple[str, str]]:
    """Every path that a layer names, and the attribute that does; "" for arcs and metadata."""
    named: list[tuple[str, str]] = []

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.AttributeSpec):
            times = layer.ListTimeSamplesForPath(path)
            for value in (spec.default, *(layer.QueryTimeSample(path, time) for time in times)):
                items = value if isinstance(value, Sdf.AssetPathArray) else [value]
                named.extend((x.path, spec.name) for x in items if isinstance(x, Sdf.AssetPath))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    yield from sorted({each for each in named if each[0]})
    known = {path for path, _ in named}
    yield from ((path, "") for path in sorted(named_files(layer) - known))


def _targets(file: Path, path: str) -> list[Path]:
    """Files that a path in the layer at ``file`` names: none of a URI, several of tiles."""
    outer = _parts(path).file
    if ADDRESS.match(outer):
        return []
    target = canonical(file.parent / outer)
    if _UDIM in target.name:
        pattern = escape(target.name).replace(_UDIM, "[0-9][0-9][0-9][0-9]")
        return sorted(target.parent.glob(pattern)) or [target]
    return [target]


class _Parts(NamedTuple):
    """Of an asset path: the file, what is named inside of it if it is a package, and what its file
    format is told (SDF_FORMAT_ARGS)."""

    file: str
    inner: str
    arguments: dict[str, str]


def _parts(path: str) -> _Parts:
    plain, arguments = Sdf.Layer.SplitIdentifier(path)
    outer, inner = Ar.SplitPackageRelativePathOuter(plain)
    return _Parts(outer, inner, arguments)


def canonical(file: Path) -> Path:
    return Path(os.path.realpath(file.parent)) / file.name


def _place(found: Collection, file: Path, allowed: bool, elsewhere: str) -> None:
    """Choose where a file goes: where it is in the asset; a file from elsewhere into a folder."""
    if file in found.places:
        return
    home = Path(os.path.realpath(found.asset.folder))
    if file.is_relative_to(home) and Path(os.path.realpath(file)).is_relative_to(home):
        found.places[file] = file.relative_to(home).as_posix()
        return
    if not allowed:
        raise InputRefused(
            f"{file}: lies outside of the asset {found.asset.folder} and did not come with its "
            "capture. Copy it into the folder, or take it out of edits.usda. [publish.outside]"
        )
    taken, number, folder = {place.lower() for place in found.places.values()}, 2, elsewhere
    while f"{folder}/{file.name}".lower() in taken:
        folder, number = f"{elsewhere}/{number}", number + 1
    found.places[file] = f"{folder}/{file.name}"


def _refuse_what_is_not_followed(file: Path, layer: Sdf.Layer) -> None:
    """Raise where a layer names files in ways that a copy cannot be made to lead to copies."""
    for path in sorted(named_files(layer)):
        for target in _targets(file, path):
            # A document that names no file needs nothing else.
            if target.suffix.lower() == ".mtlx" and target.is_file():
                content = target.read_bytes()
                if any(word in content for word in _NAMES_FILES):
                    raise InputRefused(
                        f"{target}: this MaterialX document of {file} names other files, which "
                        "are not copied. Write its materials into USD, or take it out. "
                        "[publish.materialx]"
                    )

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec) and spec.HasInfo("clips"):
            for name, clips in dict(spec.GetInfo("clips")).items():
                if dict(clips).get("templateAssetPath"):
                    raise InputRefused(
                        f"{file}: the value clips {name!r} of <{path}> are named by a template, "
                        "whose files are not copied. Name them one by one (assetPaths), or bake "
                        "them into the layer. [publish.clips]"
                    )

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)


def _missing(asset: Asset, file: Path, layer: Path, is_photograph: bool) -> InputRefused:
    if is_photograph:
        return InputRefused(
            f"{file}: this photograph of {asset.folder} is not there. Put the capture back where "
            "it was, or publish with --no-photographs. [publish.photograph]"
        )
    if not layer.is_relative_to(os.path.realpath(asset.folder)):
        return InputRefused(
            f"{file}: {layer}, which came with the capture, names this file and it is not there. "
            "Put it back where it was, or take it out of that layer and convert again. "
            "[publish.missing]"
        )
    return InputRefused(
        f"{file}: the asset {asset.folder} names this file and it is not there. Run the steps "
        "again, or correct edits.usda. [publish.missing]"
    )


def _lead_to_copies(found: Collection, file: Path, layer: Sdf.Layer) -> bool:
    """Make a layer name the copies; returns whether it names anything otherwise then."""
    own, new_names = PurePosixPath(found.places[file]).parent, set[str]()

    def replaced(path: str) -> str:
        outer, inner, arguments = _parts(path)
        targets = _targets(file, path)
        if not targets:
            return path
        new = PurePosixPath(found.places[targets[0]])
        if _UDIM in outer:
            new = new.with_name(Path(outer).name)
        led = os.path.relpath(new, own).replace(os.sep, "/")
        led = led if led.startswith("../") else f"./{led}"
        led = Ar.JoinPackageRelativePath([led, inner]) if inner else led
        led = Sdf.Layer.CreateIdentifier(led, arguments) if arguments else led
        if led != path:
            new_names.add(led)
        return led

    UsdUtils.ModifyAssetPaths(layer, replaced)
    return bool(new_names)


def _export(layer: Sdf.Layer, path: Path, encoding: str) -> None:
    try:
        done = layer.Export(str(path), args={"format": encoding} if encoding else {})
        stored, why = Sdf.Layer.OpenAsAnonymous(str(path)) if done else None, ""
    except Tf.ErrorException as error:
        stored, why = None, f" ({in_one_line(error)})"
    if not stored or stored.defaultPrim != layer.defaultPrim:
        raise EnvironmentFailure(
            f"{path}: the layer could not be written completely{why}. {cure_of_writing(path)}, "
            "then run the same command again. [publish.write]"
        )


def refuse_incomplete(root: Path) -> None:
    """Raise where a folder that was written here does not compose by itself, for a defect."""
    stage = open_stage(root)
    folder = Path(os.path.realpath(root.parent))
    for layer in stage.GetUsedLayers():
        inside = layer.anonymous or Path(os.path.realpath(layer.realPath)).is_relative_to(folder)
        leading = [
            p for p in named_files(layer) if not (p.startswith(("./", "../")) or ADDRESS.match(p))
        ]
        if not inside or leading:
            raise UsdBrdfError(
                f"{layer.identifier}: {', '.join(leading) or 'this layer'} leads out of what is "
                "published. This is a defect of usdbrdf; please report it. [publish.defect]"
            )
