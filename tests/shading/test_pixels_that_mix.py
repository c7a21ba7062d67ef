"""Sun and shade that pixels mix: texels tell of the sun by the means over what lies around them."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.shading import outside
from usdbrdf.shading.asked import LEAST_OF_SEGMENT
from usdbrdf.shading.outside import _Look, _Told
from usdbrdf.shading.outside_light import Asked, Sources
from usdbrdf.shading.surroundings import Surroundings

OFFSETS = [*product((-4, -2, 0, 2, 4), repeat=2)]
# Of the texels asked: those with a wall around them, in the sun and in the shade; those at an edge
# of it, so; those beside texels that no frame shows, so; those that clip.
KINDS = ("sun", "shade", "edge sun", "edge shade", "unseen sun", "unseen shade", "clips")
EACH = 12


class World:
    """(N,) texels asked, around each 25 others: what those reflect, and how much sun they get."""

    def __init__(self, in_the_sun: int) -> None:
        random = np.random.default_rng(4)
        counts = (in_the_sun, EACH, EACH, EACH, EACH, EACH, EACH)
        self.kind = np.repeat(KINDS, counts)
        self.count = count = len(self.kind)
        self.number = np.arange(count * len(OFFSETS)).reshape(count, len(OFFSETS))
        self.lit = random.uniform(0.1, 2, (self.number.size, 3))
        self.sun = random.uniform(0.1, 1, self.number.size)
        shady = np.char.endswith(self.kind, "shade")
        self.sun[self.number[shady]] = 0
        self.there = np.ones(self.number.shape, bool)
        self.there[np.char.startswith(self.kind, "edge"), 3] = False
        self.measured = np.ones(self.number.size, bool)
        self.measured[self.number[np.char.startswith(self.kind, "unseen"), 20]] = False
        self.texel = self.number[:, OFFSETS.index((0, 0))]

    def beside(self, centre: Any, right: int, down: int) -> tuple[Any, Any]:
        assert (centre == self.texel).all()
        place = OFFSETS.index((right, down))
        return self.number[:, place], self.there[:, place]

    def mixed(self, monkeypatch: pytest.MonkeyPatch) -> Any:
        """What is asked with the sun, and its share; None where too few tell."""
        count, sun = self.count, SimpleNamespace()
        surface: Any = SimpleNamespace(texels=SimpleNamespace(beside_on_surface=self.beside))
        number = np.arange(count)
        light = np.full((count, 3), 0.5)
        asked = Asked(self.texel, number, number, light, self.kind == "clips", light, 0 * light)
        self.asked = asked
        none = np.zeros(0, np.int64)
        one = np.ones((1, count))
        sky = Sources(one, np.zeros((1, 3)), np.ones(1), none, none, np.zeros(0))
        seen: Any = SimpleNamespace(spec=Surroundings)
        coverage: Any = SimpleNamespace(measured=self.measured)
        look = _Look(surface, self.lit, coverage, seen, none, none, True, 6, None)
        told = _Told(asked, sky, sun, (asked, sky), None)  # type: ignore[arg-type]

        def shines(_surface: Any, which: Any, of: Any, seed: int) -> Any:
            assert (of is sun, seed) == (True, 6)
            return self.sun[which]

        monkeypatch.setattr(outside, "sunlit", shines)
        monkeypatch.setattr(outside, "solved", lambda *given: given)
        monkeypatch.setattr(outside, "jackknife", lambda *given: given)
        made = outside._as_pixels_mix(look, told)
        if made is None:
            return None
        now, error = made
        assert now.found == now.with_sun
        assert error == (*now.with_sun, now.found)
        return now.with_sun


def test_means_over_a_wall_stand_for_its_texels(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(LEAST_OF_SEGMENT)
    asked, sources = world.mixed(monkeypatch)
    # At an edge in the sun nothing is known of what a pixel mixes.
    kept = ~np.isin(world.kind, ("edge sun", "unseen sun"))
    assert asked.texel.tolist() == world.texel[kept].tolist()
    whole = np.isin(world.kind, ("sun", "shade"))
    around = np.pi * world.lit[world.number].mean(axis=1)
    reflected = np.where(whole[:, None], around, world.asked.reflected)
    share = np.where(whole, world.sun[world.number].mean(axis=1), world.sun[world.texel])
    np.testing.assert_allclose(asked.reflected, reflected[kept])
    np.testing.assert_allclose(sources.share, [np.ones(kept.sum()), share[kept]])


@pytest.mark.parametrize("fewer", [0, 1])
def test_too_few_walls_in_the_sun_tell_nothing(monkeypatch: pytest.MonkeyPatch, fewer: int) -> None:
    assert (World(LEAST_OF_SEGMENT - fewer).mixed(monkeypatch) is None) == bool(fewer)
