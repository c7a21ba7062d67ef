"""Which parts of the sky are asked for what they bring, and which texels for the sun."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf import calibration
from usdbrdf.shading import outside
from usdbrdf.shading.outside import _Look, light_from_outside
from usdbrdf.shading.outside_light import Asked, Sources
from usdbrdf.shading.surroundings import Surroundings
from usdbrdf.transport.environment import Sun

PATCHES, TEXELS = 6, 5


class Asking(Exception):
    """What is looked at, once sources are asked for."""


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch) -> Any:
    """From the mean share of the light's directions in each patch, (PATCHES,): those used, None
    where the scan is closed; and how many rays were sent to find out."""
    sent: list[int] = []

    def of(directions: Any, open_share: float) -> Any:
        # Of a texel what a patch of radiance 1 brings, pi from everywhere; half of them see twice.
        shares = np.pi * np.outer(directions, [0.0, 2.0, 1.0, 0.0, 2.0])

        def traced(look: _Look, _asked: Any) -> Any:
            sent.append(look.rays)
            return shares, open_share

        def asking(look: _Look, *_given: Any) -> Any:
            raise Asking(look.used)

        monkeypatch.setattr(_Look, "shares", traced)
        monkeypatch.setattr(outside, "_with_lamps", asking)
        monkeypatch.setattr(outside, "asked_texels", lambda *_given: SimpleNamespace())
        surface = SimpleNamespace(texels=None)
        sent.clear()
        given: Any = surface, None, None, Surroundings.unseen(), True, 0
        try:
            return light_from_outside(*given), sent
        except Asking as asked:
            return asked.args[0].tolist(), sent

    return of


def test_patches_that_hardly_light_the_scan_are_not_asked_for(used: Any) -> None:
    least = calibration.number("outside.least_share")
    directions = least * np.array([0.5, 2.0, 0.0, 0.9, 1.1, 1e4])
    assert used(directions, 0.5) == ([1, 4, 5], [32, 1024])


def test_of_a_closed_room_a_few_rays_tell_that_it_is(used: Any) -> None:
    least = calibration.number("outside.least_open")
    assert used(np.full(PATCHES, 0.1), 0.9 * least) == (None, [32])
    found, sent = used(np.full(PATCHES, 0.1), 1.1 * least)
    assert found == list(range(PATCHES))
    assert sent == [32, 8192]


def test_the_less_leaves_a_scan_the_more_rays_tell_what_it_meets(used: Any) -> None:
    def rays(open_share: float) -> int:
        return int(used(np.full(PATCHES, 0.1), open_share)[1][-1])

    assert rays(1.0) == rays(0.1) == 1024
    assert rays(0.05) == 2048
    assert rays(0.02) == 5120


def test_texels_in_the_sun_s_half_shadow_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that see all of its disc are, by their cosine, and those that see nothing of it."""
    towards = np.array([0.6, 0.0, 0.8])
    seen = np.array([0.0, 1.0, 0.5, 0.99, 0.97, 0.01, 0.03, 0.0])
    # The last one faces away.
    normal = np.array([*np.tile([[0.0, 0, 1], [1, 0, 0]], (4, 1))[:7], [-1.0, 0, 0]])
    share = (seen * np.maximum(normal @ towards, 0)).astype(np.float32)
    texel = np.arange(8) + 2
    normals = np.concatenate([np.zeros((2, 3)), normal])
    surface: Any = SimpleNamespace(texels=SimpleNamespace(normal=normals))
    light, number = np.full((8, 3), 0.25), np.zeros(8, np.int32)
    asked = Asked(texel, number, number, light, number > 0, light, 0 * light)
    none = np.zeros(0, np.int64)
    sky = Sources(
        np.ones((1, 8)) * np.arange(8), np.zeros((1, 3)), np.ones(1), none[:0], none, np.zeros(0)
    )
    sun = Sun(towards, np.array([3.0, 2.0, 1.0]))

    def shines(_surface: Any, which: Any, of: Sun, seed: int) -> Any:
        assert of is sun
        assert which.tolist() == texel.tolist()
        assert seed == 6
        return share

    monkeypatch.setattr(outside, "sunlit", shines)
    found, sources = outside._with_sun(surface, asked, sky, sun, 6)
    kept = [0, 1, 3, 5, 7]
    assert found.texel.tolist() == texel[kept].tolist()
    np.testing.assert_allclose(sources.share, [np.array(kept, float), share[kept]])
    # At first as strong as all that is known besides is on the mean.
    np.testing.assert_allclose(np.exp(sources.mean[1]), np.median(0.25 + np.arange(8)))
