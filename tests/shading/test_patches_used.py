"""Which parts of the sky are asked for what they bring, before anything is traced."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf import calibration
from usdbrdf.shading import outside
from usdbrdf.shading.outside import _Look, light_from_outside
from usdbrdf.shading.surroundings import Surroundings

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

        def traced(_look: _Look, _asked: Any, rays: int) -> Any:
            sent.append(rays)
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
    assert sent == [32, 1024]
