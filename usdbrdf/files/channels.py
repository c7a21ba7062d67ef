"""Which channels of an image are its colours: R, G and B, or those of one layer of several.

Renderers put their passes into one file, as layers ``beauty.R`` or ``ViewLayer.Combined.R``, or as
parts of it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

_MAX_PARTS = 64  # of one file, which are searched
# What renderers call the pass that shows what a camera would.
_BEAUTY = frozenset(("beauty", "combined", "rgba"))
# And what those are called that show something else: parts of names, and whole ones.
_OTHERWISE = re.compile(
    "albedo|ambientocc|basecolou?r|bump|crypto|curvature|denoising|depth|diff|emission|emit|fresnel"
    "|gloss|indirect|index(ob|ma)|motion|mask|metal|normal|objectid|materialid|occlusion|opacity"
    "|position|reflection|refraction|rough|selfillum|shadow|sheen|specular|subsurface|tangent"
    "|trans(col|dir|ind|mission|lucency)|vector|velocity|worldpos"
    "|^(ao|coat|direct|env|flow|gi|height|ids?|lighting|matte|mist|mv|n|ng|nn|p|pn|pos|pref|spec|sss|"
    "st|uvw?s?|volume(dir|ind|direct|indirect)?|z)$"
)
# And what a picture is called beside such.
_PICTURE = re.compile(
    "^(cam|camera|colou?r|default|final|frame|hdr|image|img|main|master|photo|picture|radiance"
    "|render|rgb)$"
)
_LETTERS = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}


def layers_with_colours(names: Sequence[str]) -> dict[str, dict[str, int]]:
    """Of each layer with R, G and B the numbers of these, and of its A, by small letters; "" is the
    layer of those that have no other name."""
    layers: dict[str, dict[str, int]] = {}
    for i, name in enumerate(names):
        layer, _, letter = name.rpartition(".")
        layers.setdefault(layer, {}).setdefault(_LETTERS.get(letter.lower(), letter.lower()), i)
    return {layer: found for layer, found in layers.items() if found.keys() >= {*"rgb"}}


def colours_of(source: Any) -> dict[str, int] | list[str]:
    """The channels of the layer that is shown in an OpenImageIO reader's image, which then is at
    the part with it; else the layers of which each might be.

    R, G and B come first; then the only layer that is called as renderers call their whole picture,
    or the only one, unless it is called as something that is none; or of several the only one that
    is not, if it is called as a picture. RuntimeError where the parts cannot be read.
    """
    found: list[tuple[int, str, dict[str, int]]] = []
    part = 0
    if source.current_subimage() and not source.seek_subimage(0, 0):
        raise RuntimeError
    for part in range(_MAX_PARTS):
        if part and not source.seek_subimage(part, 0):
            break
        layers = layers_with_colours(source.spec().channelnames)
        if "" in layers:
            name = str(source.spec().getattribute("oiio:subimagename") or "")
            if not _shows_otherwise(name):
                return layers[""]
            layers[name] = layers.pop("")
        found += [(part, layer, channels) for layer, channels in layers.items()]
    beauty = [one for one in found if one[1].lower().rpartition(".")[2] in _BEAUTY]
    left = [one for one in found if not _shows_otherwise(one[1])]
    # Beside passes it must be called as a picture: there are more of these than names known here.
    alone = left if len(found) == 1 else [one for one in left if _PICTURE.search(_word(one[1]))]
    sure = alone if len(alone) == len(left) else []
    chosen = next((some[0] for some in (beauty, sure) if len(some) == 1), None)
    if part:
        source.geterror()  # that there is no such part
        if not source.seek_subimage(chosen[0] if chosen else 0, 0):
            raise RuntimeError
    return chosen[2] if chosen else [layer for _, layer, _ in found]


def _shows_otherwise(layer: str) -> bool:
    """Whether a layer is called as a pass that is no picture, as normals or an object's numbers."""
    return bool(_OTHERWISE.search(_word(layer)))


def _word(layer: str) -> str:
    """The letters of a layer's last name."""
    return re.sub(r"[\W\d_]", "", layer.lower().rpartition(".")[2])
