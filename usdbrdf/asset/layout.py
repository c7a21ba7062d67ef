"""The asset folder: which file lies where. Everything else asks here."""

from __future__ import annotations

import os
import posixpath
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf

from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.naming import identifier_from
from usdbrdf.job.stamp import read_stamp, stamp_path
from usdbrdf.job.versions import refuse_version

# The layers that the tasks write, weakest first; each sees only those before it.
ROLES = ("scan", "texturing", "shading", "material")
# What the tasks write into, but for files of the folder itself; and how many names a path to any of
# these files has, that of the asset among them: NAME/objects/OBJECT/OBJECT.usda.
_OWN_FOLDERS, _DEEPEST = ("layers", "objects", "textures", "previews"), 4
# What a layer's record says in tables of its own.
_TABLES = ("parameters", "inputs", "competing_bindings")
# The variant set that chooses among several lightings of a scene.
LIGHTING = "lighting"


@dataclass(frozen=True)
class Asset:
    """An asset folder and the name of its default prim, which is also its root layer's name.

    lighting  of an asset that shows its scene in several, the one whose layers and maps are meant:
              all but the scan, the texture coordinates and the materials lie once for each. ""
              means what all have in common, which is everything where there is but one.
    """

    folder: Path
    name: str
    lighting: str = ""

    @staticmethod
    def at(folder: Path) -> Asset:
        """The asset in a folder: its name is the one it was made with, else the folder's name. A
        folder that was renamed after its making keeps its files' names."""
        folder = Path(folder).absolute()
        if not is_storable(folder) or "\\" in str(folder):
            raise InputRefused(
                f"{str(folder)!r}: the name of the folder, or of one above it, holds characters "
                "that USD cannot store in a path. Choose another folder. [stage.asset_path]"
            )
        name = ""
        if (scan := folder / "layers" / "scan.usdc").is_file():
            with suppress(InputRefused):
                name = str(open_metadata(scan).defaultPrim)
        if not name:  # scan.usdc is damaged or gone: what ingest called the root layer
            stamp = read_stamp(stamp_path(folder, 1, "ingest"))
            roots = {Path(once) for once in (stamp.once if stamp else ())} - {Path("edits.usda")}
            name = next((path.stem for path in sorted(roots) if path.parent == Path()), "")
        return Asset(folder, name or identifier_from(folder.resolve().name, fallback="asset"))

    @staticmethod
    def made(place: Path) -> Asset:
        """The asset of a folder, or of the root layer in it; InputRefused where there is none."""
        place = Path(place)
        asset = Asset.at(place.parent if place.is_file() else place)
        root = asset.root_layer
        if not root.is_file() or (place.is_file() and not place.samefile(root)):
            raise InputRefused(
                f"{place}: there is no asset here. Name the folder that usdbrdf convert wrote, or "
                "its root layer. [asset.missing]"
            )
        return asset

    @staticmethod
    def around(place: Path) -> Asset | None:
        """The asset that a path leads to, or to a part of: its folder, its root layer, or what its
        own folders hold; None where there is none."""
        place = Path(place).absolute()
        for folder in (place, *place.parents)[:_DEEPEST]:
            with suppress(InputRefused):
                asset = Asset.at(folder)
                inside = place.relative_to(folder).parts[:1]
                parts = {(), (asset.root_layer.name,), *((name,) for name in _OWN_FOLDERS)}
                made = asset.layer("scan").is_file() or asset.contents_layer.is_file()
                if inside in parts and made and asset.root_layer.is_file():
                    return asset
        return None

    @property
    def lightings(self) -> tuple[str, ...]:
        """The lightings of the scene, as ingest recorded them; () where there is but one, or
        nobody can tell."""
        return self.recorded_lightings or ()

    @property
    def recorded_lightings(self) -> tuple[str, ...] | None:
        """The same; None where there is no scan, or none that can be read."""
        scan = self.layer("scan")
        if not scan.is_file():
            return None
        with suppress(InputRefused):
            names = record_of(open_metadata(scan)).get("lightings", ())
            told = not isinstance(names, str) and isinstance(names, Iterable)
            # They are parts of paths that steps write to.
            if told and all(isinstance(n, str) and Sdf.Path.IsValidIdentifier(n) for n in names):
                return tuple(names)
        return None

    @property
    def in_each_lighting(self) -> tuple[Asset, ...]:
        """Itself in each of its lightings; itself where there is but one."""
        return tuple(replace(self, lighting=name) for name in self.lightings) or (self,)

    def in_lighting(self, name: str | None) -> Asset:
        """Itself in the lighting of a name, which None leaves to the root layer's selection.
        UsageError where it has no such lighting."""
        known = self.lightings
        if name is not None and name not in known:
            has = f"the asset has {', '.join(known)}" if known else "the asset has but one lighting"
            raise UsageError(f"--lighting {name}: {has}. [asset.lighting]")
        return replace(self, lighting=name or "")

    @property
    def is_published(self) -> bool:
        """Whether it is a version that ``usdbrdf publish`` wrote: nothing in it changes again."""
        return self._published_root.is_file() and not self._own_root.is_file()

    @property
    def root_layer(self) -> Path:
        return self._published_root if self.is_published else self._own_root

    @property
    def _own_root(self) -> Path:
        return self.folder / f"{self.name}.usda"

    @property
    def _published_root(self) -> Path:
        return self.folder / f"{self.name}.usd"

    @property
    def edits_layer(self) -> Path:
        """The artist's; of a published version, what it was then."""
        return self.folder / ("layers/edits.usda" if self.is_published else "edits.usda")

    @property
    def contents_layer(self) -> Path:
        """What the root layer loads as its payload: all that the tasks wrote."""
        return self.folder / "layers" / "contents.usda"

    @property
    def photographs_layer(self) -> Path:
        """Where the photographs lie. No layer names it, so that the asset is whole without them;
        whoever wants to see them adds it as a sublayer."""
        return self.folder / "layers" / "photographs.usdc"

    @property
    def advice_layer(self) -> Path:
        """What to photograph next, where somebody asked. No layer names it, as with the
        photographs."""
        return self.folder / "layers" / f"advice{self._of_lighting}.usda"

    def interface(self, role: str) -> Path:
        """What applications see of a task's layer before they load the payload."""
        return self.folder / "layers" / f"{self.layer(role).stem}.interface.usda"

    def component(self, identifier: str) -> str:
        """Path of an object's own file, relative to the asset folder."""
        return f"objects/{identifier}/{identifier}.usda"

    @property
    def uv_layer(self) -> Path:
        """Texture coordinates: too big for text, hence a binary sublayer of texturing.usda."""
        return self.folder / "layers" / "texturing_uv.usdc"

    @property
    def lights_layer(self) -> Path:
        """Emitters, sky and sun as UsdLux lights: a sublayer of shading.usda that may be muted."""
        return self.folder / "layers" / f"lights{self._of_lighting}.usda"

    @property
    def materialx_layer(self) -> Path:
        """The materials as MaterialX networks: a sublayer of material.usda, where asked for."""
        return self.folder / "layers" / "materialx.usda"

    def layer(self, role: str) -> Path:
        """Path of a task's layer; ``role`` is one of ``ROLES``."""
        if role == "scan":
            return self.folder / "layers" / "scan.usdc"
        return self.folder / "layers" / f"{role}{self._of_lighting}.usda"

    @property
    def _of_lighting(self) -> str:
        return f".{self.lighting}" if self.lighting else ""

    def layers_of_payload(self, lightings: Iterable[str]) -> list[Path]:
        """The layers that loading the payload of an asset of these lightings opens, () being one,
        but for those that it has by the choice of whoever fits its materials."""
        common = [self.contents_layer, *map(self.layer, ROLES), self.uv_layer]
        each = [replace(self, lighting=name) for name in lightings]
        own = [one.layer(role) for one in each for role in ROLES[1:3]]
        return [*common, *own, *(one.lights_layer for one in each or [self])]

    def refuse_output(self, output: Path, rule: str) -> None:
        """UsageError for a place inside the folder: what reads an asset leaves it as it is.
        OwnershipConflict for one in a published version of any."""
        refuse_version(output)
        if output.resolve().is_relative_to(self.folder.resolve()):
            raise UsageError(
                f"{output}: lies inside the asset {self.folder}, which stays as it is. Name "
                f"another place. [{rule}]"
            )

    def texture(self, identifier: str, aov: str) -> str:
        """Path of an object's map, relative to the asset folder."""
        return f"{self._textures}/{identifier}.{aov}.exr"

    @property
    def _textures(self) -> str:
        return f"textures/{self.lighting}" if self.lighting else "textures"

    def preview(self, name: str) -> str:
        """Path of a picture for people, relative to the asset folder."""
        return f"previews/{self.lighting}/{name}.png" if self.lighting else f"previews/{name}.png"

    @property
    def sky(self) -> str:
        """Path of the picture of the surroundings, relative to the asset folder."""
        return f"{self._textures}/outside.sky.exr"

    @property
    def sky_confidence(self) -> str:
        """Path of the picture that tells how each direction of ``sky`` is known."""
        return f"{self._textures}/outside.sky_confidence.exr"

    def textures(self, *aovs: str) -> list[Path]:
        """All objects' maps of these AOVs that are there, in the order of their names."""
        endings = tuple(f".{aov}.exr" for aov in aovs)
        files = (self.folder / self._textures).glob("*.exr")
        return sorted(file for file in files if endings and file.name.endswith(endings))


def is_storable(path: Path) -> bool:
    """False if USD cannot hold the path: control characters, undecodable bytes, its own marks."""
    try:
        Sdf.AssetPath(str(path))
    except (Tf.ErrorException, UnicodeEncodeError):
        return False
    return ":SDF_FORMAT_ARGS:" not in str(path)


def relative_path(target: Path, folder: Path) -> str:
    """Path from ``folder`` to a file, anchored and with forward slashes. Folders are resolved
    first: ``..`` above a symbolic link would lead elsewhere. The file itself may be a link and
    stays one."""
    target = Path(os.path.realpath(target.parent)) / target.name
    relative = os.path.relpath(target, os.path.realpath(folder)).replace(os.sep, "/")
    return relative if relative.startswith("../") else f"./{relative}"


def storable_path(target: Path, folder: Path) -> str:
    """The same; refuses names that USD cannot hold."""
    if not is_storable(target):
        raise InputRefused(
            f"{str(target)!r}: the name holds characters that USD cannot store in a path. "
            "Rename the file. [stage.asset_path]"
        )
    return relative_path(target, folder)


def path_in_layer(asset_relative: str) -> str:
    """A path relative to the asset folder, as the files in layers/ must spell it."""
    return f"../{asset_relative}"


def path_in_asset(layer_relative: str) -> str:
    """The inverse of ``path_in_layer``."""
    return posixpath.normpath(posixpath.join("layers", layer_relative))


def open_metadata(layer: Path) -> Sdf.Layer:
    """A private copy of a layer's metadata, read from the file as it is now."""
    # What lies beside the folder of layers is written once: no run replaces it while it is there.
    cure = "Correct it, or remove it and run" if (layer.parent / "layers").is_dir() else "Run"
    refused = InputRefused(
        f"{layer}: this is not a readable USD layer. {cure} `usdbrdf convert` again, which makes "
        "it anew. [stage.unreadable]"
    )
    try:
        opened = Sdf.Layer.OpenAsAnonymous(str(layer), metadataOnly=True)
    except Tf.ErrorException as error:
        raise refused from error
    if not opened:
        raise refused
    return opened


def record_of(layer: Sdf.Layer) -> dict[str, Any]:
    """``customLayerData.usdbrdf`` of a layer; empty where it has none, without what is no table
    where one is to be: others may have written it."""
    record = layer.customLayerData.get("usdbrdf", {})
    said = record if isinstance(record, dict) else {}
    return {k: v for k, v in said.items() if k not in _TABLES or isinstance(v, dict)}
