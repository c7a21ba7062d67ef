"""A copy of an asset for others: complete in itself, all looks and lightings, its textures as
renderers read them, in the colour space that is asked for.

Textures get their smaller copies here and not when they are measured: the maps of the work folder,
which later steps read, stay as they are, and converting takes no longer."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from pxr import Sdf

from usdbrdf.asset.layers.lights_layer import LIGHTS
from usdbrdf.asset.layers.looks import VARIANT_SET as LOOKS
from usdbrdf.asset.layout import Asset, record_of
from usdbrdf.asset.readers.compose import open_edited
from usdbrdf.delivery.collection import (
    Collection,
    canonical,
    collected,
    refuse_incomplete,
    write_collection,
)
from usdbrdf.delivery.colours import ColourTextures, convert_layer, converted_texture
from usdbrdf.delivery.proxies import add_proxies
from usdbrdf.files.colour import ACESCG, WORKING_SPACE
from usdbrdf.files.images import needs_float, write_exr
from usdbrdf.files.published_images import (
    CLEANED,
    copy_without_metadata,
    misnamed,
    refuse_misnamed,
    write_texture,
)

SPACES = {"rec709": WORKING_SPACE, "acescg": ACESCG}
# Attributes that name textures which renderers look up on surfaces, from near and from afar.
_TEXTURES = re.compile(r"(inputs|usdBrdf:aov):(?!texture:).+")


def write_copy(
    asset: Asset,
    folder: Path,
    *,
    root: str,
    encoding: str,
    space: str,
    photographs: bool,
    proxies: int | None = None,
    describe: Callable[[Sdf.Layer], None],
    accept: Callable[[Path], object] = lambda file: None,
) -> Collection:
    """Write the copy into an empty folder; returns what the asset is made of, and where it went.

    root         name of the root layer
    encoding     "usda" or "usdc" for the root layer where its name does not say it, else ""
    space        linear space of all colours but those that were measured
    photographs  whether they are copied too, without EXIF, GPS and the like
    proxies      triangles of stand-ins for all meshes together, None for no stand-ins
    describe     changes the root layer after all else
    accept       raises for files that may not be copied

    Raises InputRefused as ``collected`` and ``ColourTextures.look_at`` do.
    """
    textures = ColourTextures()
    for one in asset.in_each_lighting:
        stage = open_edited(one)
        if space != WORKING_SPACE:
            # Lamps that glow and lights that shine are not there at once, nor are the looks.
            stage.SetEditTarget(stage.GetSessionLayer())
            textures.look_at(stage, space)
            for name in (LIGHTS, LOOKS):
                choice = stage.GetDefaultPrim().GetVariantSet(name)
                for chosen in choice.GetVariantNames():
                    choice.SetVariantSelection(chosen)
                    textures.look_at(stage, space)
    found = collected(asset, root, photographs=photographs)
    for file in found.named_by:
        accept(file)
        if file in found.own and not asset.is_published and file.suffix.lower() in CLEANED:
            refuse_misnamed(file)

    def edit(layer: Sdf.Layer, is_root: bool) -> bool:
        changed = space != WORKING_SPACE and convert_layer(layer, textures, space)
        changed |= _forget_places(layer)
        if record_of(layer).get("role") == "edits":
            layer.documentation = "What the artist's layer said when this copy was made."
            changed = True
        if is_root:
            describe(layer)
        return changed

    def write(file: Path, place: Path) -> None:
        named = found.named_by[file]
        converted = converted_texture(file, space) if file in textures.files else None
        sound = file.suffix.lower() == ".exr" and not misnamed(file)
        if sound and any(_TEXTURES.fullmatch(name) for name in named):
            write_texture(place, file, converted=converted, encoding=space)
        elif converted is not None:
            write_exr(place, converted, half=not needs_float(converted), encoding=space)
        else:
            copy_without_metadata(file, place)

    write_collection(found, folder, edit=edit, write=write, encodings={root: encoding})
    if proxies is not None:
        contents = folder / found.places[canonical(asset.contents_layer)]
        add_proxies(folder / root, contents, proxies, asset.folder)
    refuse_incomplete(folder / root)
    return found


def _forget_places(layer: Sdf.Layer) -> bool:
    """Take out where the capture lay, which the work folder is run again from: a copy has no way
    there, and names of folders are nobody else's. Returns whether anything said it."""
    if "places" not in record_of(layer).get("parameters", {}):
        return False
    about = layer.customLayerData
    del about["usdbrdf"]["parameters"]["places"]
    layer.customLayerData = about
    return True
