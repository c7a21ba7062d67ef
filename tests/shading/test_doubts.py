"""What a person is told of light that was found badly, or not at all."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from usdbrdf.shading.doubt import doubt_of_irradiance, doubt_of_outside
from usdbrdf.shading.outside import Outside
from usdbrdf.shading.shaded import Shaded
from usdbrdf.transport.environment import NO_SUN, Environment, Sun


def _shaded(
    *, emits=False, outside=None, error=0.01, over_one=0.0, escaped=0.0, albedo=0.5
) -> Shaded:
    """Of one object that reflects, and as much of the light as the sentences speak of."""
    nothing = SimpleNamespace()
    return Shaded(
        measured=np.ones(4, np.bool_),
        light=nothing,
        unseen=nothing,
        traced=SimpleNamespace(escaped=np.full(4, escaped)),
        relative_error=np.array([0, error, error, 1], np.float32),
        irradiance=np.ones((4, 3), np.float32),
        emitters=SimpleNamespace(
            emissive=np.array([emits, False, False, False]), lower_bound=np.zeros(1, np.bool_)
        ),
        albedo=np.full((4, 3), albedo, np.float32),
        unexplained=np.zeros(4, np.bool_),
        over_one=over_one,
        outside=outside,
    )


def test_good_light_leaves_no_doubt():
    assert list(_shaded(emits=True).doubts(["box"])) == []


@pytest.mark.parametrize(
    ("found", "rule", "word"),
    [
        pytest.param({}, "no-light", "dark", marks=pytest.mark.fault("L1")),
        pytest.param(
            {"emits": True, "over_one": 0.06}, "albedo", "6 %", marks=pytest.mark.fault("L5")
        ),
        pytest.param(
            {"emits": True, "escaped": 0.6}, "open", "60 %", marks=pytest.mark.fault("G13")
        ),
        pytest.param({"emits": True, "error": 0.3}, "noise", "30 %", marks=pytest.mark.fault("L7")),
        pytest.param(
            {"emits": True, "albedo": 0.02}, "dark", "0.02", marks=pytest.mark.fault("L8")
        ),
    ],
)
def test_each_doubt_is_told_and_no_other(found, rule, word):
    (doubt,) = _shaded(**found).doubts(["box"])
    assert doubt.endswith(f"[shading.{rule}]")
    assert word in doubt


@pytest.mark.parametrize(
    "found", [{"over_one": 0.05}, {"escaped": 0.5}, {"error": 0.19}, {"albedo": 0.031}], ids=str
)
def test_at_the_limit_there_is_none(found):
    assert list(_shaded(emits=True, **found).doubts(["box"])) == []


@pytest.mark.parametrize("estimated", [True, False])
def test_an_open_scan_whose_surroundings_are_given_is_no_doubt(estimated):
    outside = SimpleNamespace(is_estimated=estimated)
    doubts = list(_shaded(outside=outside, escaped=0.9).doubts(["box"]))
    assert len(doubts) == estimated
    assert all("--environment to measure it" in doubt for doubt in doubts)


SUN = Sun(np.array([0.0, 0.0, 1.0]), np.full(3, 10.0))


def _outside(sun: Sun, **known: float) -> Outside:
    """Of a sky of radiance 2."""
    sky, confidence = np.full((4, 8, 3), 2, np.float32), np.zeros((4, 8), np.float32)
    return Outside(environment=Environment(sky, True).under(sun), confidence=confidence, **known)


def test_a_sky_is_doubted_as_far_as_it_lights_the_room():
    """Through a crack comes next to nothing, however badly the sky behind it is known."""
    lit, seen = np.float32([[0.5] * 3, [0.5] * 3, [9] * 3]), np.array([True, True, False])
    crack = _outside(NO_SUN, open_share=0.01, sky_error=4.0)
    assert doubt_of_outside(crack, lit, seen) == pytest.approx(4 * 0.01 * 2 / 0.5)
    window = replace(crack, open_share=0.4)
    assert doubt_of_outside(window, lit, seen) == 4
    # All the light of a patch may be the sun's.
    assert doubt_of_outside(_outside(SUN, open_share=0.01, sun_error=0.3), lit, seen) == 0.3
    assert doubt_of_outside(Outside.given(crack.environment), lit, seen) == 0
    assert doubt_of_outside(window, lit, ~np.ones(3, np.bool_)) == 0
    assert doubt_of_outside(None, lit, seen) == 0


def test_light_is_doubted_as_the_lamps_that_bring_most_of_it():
    """Two lamps that clip, the second undetermined, and one that no frame shows."""
    texels = SimpleNamespace(
        area=np.full(8, 0.5, np.float32), object_index=lambda: np.repeat(np.arange(4), 2)
    )
    clipped = SimpleNamespace(
        lit=np.repeat(np.float32([[1, 1, 1], [3, 3, 3], [9, 9, 9], [1, 1, 1]]), 2, axis=0),
        groups=SimpleNamespace(
            group=np.array([-1, -1, 0, 0, 1, 1, -1, -1]), lamp=np.ones(2, np.bool_)
        ),
        estimate=SimpleNamespace(
            determined=np.array([True, False]), standard_error=np.array([[0.1, 0.2, 0.1], [9] * 3])
        ),
    )
    none = SimpleNamespace(object=np.zeros(0, np.int32), error=np.zeros(0, np.float32))
    unseen = SimpleNamespace(object=np.array([3], np.int32), error=np.array([0.4], np.float32))
    outside = _outside(SUN, open_share=0.5, sky_error=0.15)
    dark, seen = np.zeros((8, 3), np.float32), np.repeat([True, False, False, True], 2)
    assert doubt_of_irradiance(texels, clipped, none, None, seen, dark) == pytest.approx(0.2)
    assert doubt_of_irradiance(texels, clipped, none, outside, seen, dark) == pytest.approx(0.25)
    # The one weighs three times as much as the other.
    both = np.hypot(0.75 * 0.2, 0.25 * 0.4)
    assert doubt_of_irradiance(texels, clipped, unseen, None, seen, dark) == pytest.approx(both)
    # Walls keep less than the lamp sends, or much more: then there is other light. What falls on
    # what nobody saw, as the outside of walls, is none of theirs.
    for level, share in ((2, 1), (11, 3 / 20)):
        light = np.full((8, 3), level * np.pi, np.float32)
        light[~seen] *= 100
        assert doubt_of_irradiance(texels, clipped, none, None, seen, light) == pytest.approx(
            0.2 * share
        )
    clipped.estimate.determined[:] = False
    assert doubt_of_irradiance(texels, clipped, none, None, seen, dark) == 0


@pytest.mark.parametrize("hidden", [True, False])
def test_a_lamp_that_no_frame_shows_wants_a_photograph_and_no_shorter_exposure(hidden):
    found = replace(
        _shaded(emits=True),
        unseen=SimpleNamespace(object=[0] if hidden else [], error_of=lambda _: 0.07),
        emitters=SimpleNamespace(
            emissive=np.ones(4, np.bool_), lower_bound=[True], radiance=np.ones((1, 3))
        ),
    )
    (doubt,) = found.doubts(["bulb"])
    wanted = "Photograph it to measure it." if hidden else "Capture a shorter exposure to measure"
    assert wanted in doubt
    assert ("exposure" in doubt) != hidden
