"""Which light a scene gets: the captured emitters, or others in their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from usdbrdf.relighting.surfaces import Light, RelitScene, Surface

# Two bounding boxes are of one object if their corners differ by less than this share of their
# diagonal, or by a millimetre.
_SAME_SHARE, _SAME_M = 0.02, 1e-3


def lit_by_others(
    captured: RelitScene,
    surfaces: Sequence[Surface],
    lights: Sequence[Light],
    *,
    keep_emitters: bool,
) -> RelitScene:
    """The captured surfaces in other light; their own, and the lights of their stage, are
    switched off unless kept.

    surfaces  of the file that brings the light: those that glow are lights. One that stands where
              a captured object is takes its place.
    """
    glowing = [surface for surface in surfaces if surface.material.emits]
    own = captured.surfaces
    if not keep_emitters:
        own = tuple(replace(s, material=s.material.unlit) if s.material.emits else s for s in own)
    own = tuple(s for s in own if not any(_same_place(s, light) for light in glowing))
    kept = captured.lights if keep_emitters else ()
    return RelitScene(surfaces=(*own, *glowing), lights=(*kept, *lights))


def emits_light(scene: RelitScene) -> bool:
    return bool(scene.lights) or any(surface.material.emits for surface in scene.surfaces)


def _same_place(a: Surface, b: Surface) -> bool:
    diagonal = float(np.linalg.norm(b.bounds[1] - b.bounds[0]))
    return bool(np.abs(a.bounds - b.bounds).max() <= max(_SAME_SHARE * diagonal, _SAME_M))
