"""Which channels of an image are its colours: R, G and B, or those of one layer of several.

Renderers put their passes into one file, as layers ``beauty.R`` or ``ViewLayer.Combined.R``, or as
parts of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

_MAX_PARTS = 64  # of one file, which are searched
# What renderers call the pass that shows what a camera would.
_BEAUTY = frozenset(("beauty", "combined", "rgba"))
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

    R, G and B come first; then the only layer with such, or the only one that is called as
    renderers call their whole picture. RuntimeError where the parts cannot be read.
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
            return layers[""]
        found += [(part, layer, channels) for layer, channels in layers.items()]
    beauty = [one for one in found if one[1].lower().rpartition(".")[2] in _BEAUTY]
    chosen = next((some[0] for some in (found, beauty) if len(some) == 1), None)
    if part:
        source.geterror()  # that there is no such part
        if not source.seek_subimage(chosen[0] if chosen else 0, 0):
            raise RuntimeError
    return chosen[2] if chosen else [layer for _, layer, _ in found]
