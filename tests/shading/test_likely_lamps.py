"""Which objects may be lamps though no frame shows them: by the light that they would cast."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.physics.surfaces import quad, world_of
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading import likely_lamps as module
from usdbrdf.shading.lamp_light import Lamps
from usdbrdf.shading.likely_lamps import (
    Likely,
    _alone,
    _likeliest,
    _shares,
    likely_lamps,
    strongest,
    unseen_objects,
)
from usdbrdf.shading.outside_light import Asked
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import TexturedScene

TEXELS = 48


def _asked(reflected, light, segment=None, clipped=None) -> Asked:
    number = len(light)
    return Asked(
        texel=np.arange(number),
        segment=np.zeros(number, np.int32) if segment is None else segment,
        owner=np.zeros(number, np.int32),
        reflected=np.repeat(np.asarray(reflected)[:, None], 3, axis=1),
        clipped=np.zeros(number, bool) if clipped is None else clipped,
        irradiance=np.repeat(np.asarray(light)[:, None], 3, axis=1),
        mirrored=np.zeros((number, 3)),
    )


def test_unseen_is_what_frames_show_next_to_nothing_of_by_area():
    few = module._UNSEEN
    area = np.array([few * 1.9, 2 - few * 1.9, few * 2.1, 2 - few * 2.1, 1, 1, 1, 1])
    texels = SimpleNamespace(
        area=area, resolution=np.ones((4, 2)), object_index=lambda: np.arange(8) // 2
    )
    observed = np.array([1, 0, 1, 0, 0, 0, 0, 0], bool)
    coverage = CoverageMap.of(observed, np.zeros(8, bool))
    assert unseen_objects(texels, coverage, {}).tolist() == [0, 2, 3]
    # One that is said to be a lamp may be, one that is said to be none is not.
    assert unseen_objects(texels, coverage, {2: False, 3: True}).tolist() == [0, 3]


def test_the_others_are_told_of_the_first_lamps_that_clip():
    lamp = np.array([1, 0, 1, 1, 0, 1, 1, 1], bool)
    found = strongest(SimpleNamespace(lamp=lamp))
    assert found.tolist() == [0, 2, 3, 5, 6, 7][: module._CLIPPED]


def test_lamps_are_the_objects_and_after_them_what_clips():
    texels = SimpleNamespace(resolution=np.ones((4, 2)), object_index=lambda: np.arange(8) // 2)
    parts = Lamps(
        np.array([-1, -1, 0, -1, 1, -1, -1, -1]), np.full((2, 3), 5.0), np.array([0.3, 0.4]),
        np.array([True, False]),
    )  # fmt: skip
    groups = SimpleNamespace(as_lamps=lambda which: parts)
    likely = Likely(np.array([3, 0]), np.array([[1.0] * 3, [2.0] * 3]), np.array([4, 6]))
    found = likely.as_lamps(texels, groups, {0: True, 3: False})
    assert found.of.tolist() == [1, 1, 2, -1, 3, -1, 0, 0]
    assert found.mean[:, 0].tolist() == [1, 2, 5, 5]
    assert found.deviation.tolist() == [module._DEVIATION] * 2 + [0.3, 0.4]
    assert found.certain.tolist() == [False, True, True, False]
    assert likely.of(np.array([1])).object.tolist() == [0]
    assert likely.of(np.array([1])).usual[0, 0] == 2
    assert likely.of(np.array([1])).clipped.tolist() == [4, 6]


def _plain(strength: float, seed: int = 0):
    """Texels of two segments, each plain in the light of a lamp of a ``strength``: what they
    reflect, the light without it, its share, and segments."""
    random = np.random.default_rng(seed)
    share = random.uniform(0.1, 0.5, TEXELS)
    light = random.uniform(0.8, 1.2, TEXELS)
    segment = (np.arange(TEXELS) >= 20).astype(np.int32)
    albedo = np.where(segment, 0.2, 0.7)
    return albedo * (light + strength * share), light, share, segment


def test_a_lamp_makes_plain_surfaces_plain():
    _, light, share, segment = _plain(1.0)
    usual = float(np.median(light / share))
    strength = usual * module._TRIED[6]
    reflected = np.log(_plain(strength)[0])
    gain, radiance = _alone(reflected, segment, light, share)
    assert radiance == pytest.approx(strength)
    # Without it each segment errs by the mean distance from its median, with it by the least.
    rest, gained = reflected - np.log(light), 0.0
    for own in (segment == 0, segment == 1):
        mean = np.abs(rest[own] - np.median(rest[own])).mean()
        gained += own.sum() * np.log(mean / module._LEAST_OFF)
    assert gain == pytest.approx(gained)
    # Where there is none it makes nothing likelier, and half of the texels may see nothing of it.
    assert _alone(np.log(_plain(0.0)[0]), segment, light, share)[0] <= 0
    half = np.where(np.arange(TEXELS) % 2, share, 0)
    reflected = np.log(np.where(segment, 0.2, 0.7) * (light + strength * half))
    seen = half > 0
    usual = float(np.median(light[seen] / share[seen]))
    found = _alone(reflected, segment, light, half)
    assert found[1] / usual == pytest.approx(module._TRIED[np.abs(
        np.log(module._TRIED * usual / strength)).argmin()])  # fmt: skip
    assert found[0] > 10


def test_the_likeliest_come_one_after_the_other_each_beside_those_before():
    random = np.random.default_rng(5)
    light = random.uniform(0.8, 1.2, TEXELS)
    share = np.zeros((5, TEXELS))
    share[1, :40] = random.uniform(0.1, 0.5, 40)
    share[3] = random.uniform(0.1, 0.5, TEXELS)
    share[0] = share[3] * np.exp(0.3 * random.standard_normal(TEXELS))  # nearly as good as another
    share[2] = random.uniform(0.1, 0.5, TEXELS)  # brings nothing
    share[4, : module._FEW_OF_SEGMENT // 2 - 1] = 50  # seen by too few
    usual = [np.median(light[s > 0] / s[s > 0]) for s in share]
    strong, weak = usual[3] * module._TRIED[6], usual[1] * module._TRIED[3]
    reflected = 0.4 * (light + strong * share[3] + weak * share[1])
    found = _likeliest(_asked(reflected, light), share)
    assert found[:2] == [3, 1]
    assert 2 not in found
    assert 4 not in found
    # What clips tells nothing.
    spoilt, clipped = reflected.copy(), np.arange(TEXELS) % 8 == 0
    spoilt[clipped] *= 50
    assert _likeliest(_asked(spoilt, light, clipped=clipped), share)[:2] == [3, 1]
    assert _likeliest(_asked(0.4 * light, light), share) == []


def test_no_more_are_followed_than_candidates():
    random = np.random.default_rng(2)
    many, light = module._CANDIDATES + 3, np.ones(60 * (module._CANDIDATES + 3))
    share = np.zeros((many, len(light)))
    for k in range(many):
        share[k, 60 * k : 60 * k + 60] = random.uniform(0.1, 0.9, 60)
    segment = (np.arange(len(light)) // 60).astype(np.int32)
    reflected = 0.3 * (light + 4 * share.sum(axis=0))
    found = _likeliest(_asked(reflected, light, segment), share)
    assert len(found) == len(set(found)) == module._CANDIDATES


@pytest.fixture(scope="module")
def hall():
    """A floor; two small panels that face it from 2 m above, one to the side; between the second
    and the floor a board, and a panel that faces away."""
    return world_of([
        quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), (8, 8)),
        quad((0.2, -0.05, 2), (0, 0.1, 0), (0.1, 0, 0), (4, 4)),
        quad((-0.9, -0.05, 2), (0, 0.1, 0), (0.1, 0, 0), (4, 4)),
        quad((-1.1, -0.3, 1.8), (0, 0.6, 0), (0.35, 0, 0), (4, 4)),
        quad((0.5, 0.5, 2), (0.1, 0, 0), (0, 0.1, 0), (4, 4)),
    ])  # fmt: skip


def _surface(world) -> TexturedScene:
    return TexturedScene(world.scene, world.texels, world.rays)


def _form_factor(point, centre, area) -> float:
    """To a small panel that looks down: what of its radiance arrives, W/m^2."""
    way = np.asarray(centre) - point
    return area * way[2] ** 2 / (way @ way) ** 2


def test_what_a_panel_brings_is_its_solid_angle_by_the_cosine(hall):
    texels = hall.texels
    floor = np.arange(64)
    asked = _asked(np.ones(64), np.ones(64))._replace(texel=floor)
    number = np.array([-1, 0, 1, -1, 2])
    lamps = Lamps(
        number[texels.object_index()], np.zeros((3, 3)), np.ones(3), np.zeros(3, np.bool_)
    )
    found = _shares(_surface(hall), asked, lamps, [0, 1, 2], 64, 3)
    wanted = [_form_factor(p, (0.25, 0, 2), 0.01) for p in texels.position[floor]]
    np.testing.assert_allclose(found[0], wanted, rtol=0.02)
    # Behind the board nothing arrives, beside it what does without it.
    wanted = np.array([_form_factor(p, (-0.85, 0, 2), 0.01) for p in texels.position[floor]])
    x = texels.position[floor, 0]
    assert (found[1][x < -0.4] == 0).all()
    np.testing.assert_allclose(found[1][x > 0.7], wanted[x > 0.7], rtol=0.02)
    part = np.abs(x - 0.125) < 0.1
    assert (found[1][part] > 0.1 * wanted[part]).all()
    assert (found[1][part] < 0.9 * wanted[part]).all()
    assert (found[2] == 0).all()
    # Some of them, in the order in which they are asked for.
    some = _shares(_surface(hall), asked, lamps, [2, 0], 64, 3)
    assert (some[0] == 0).all()
    np.testing.assert_allclose(some[1], found[0], rtol=0.02)


def test_no_source_brings_more_than_a_whole_sky():
    near = world_of([
        quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), (8, 8)),
        quad((-1, -1, 1e-3), (0, 2, 0), (2, 0, 0), (8, 8)),
    ])  # fmt: skip
    asked = _asked(np.ones(64), np.ones(64))
    lamps = Lamps(near.texels.object_index() - 1, np.zeros((1, 3)), np.ones(1), np.zeros(1, bool))
    found = _shares(_surface(near), asked, lamps, [0], 8, 0)[0]
    assert (found <= np.pi).all()
    assert found.max() > 0.3


def test_the_level_is_that_at_which_a_lamp_brings_as_much_as_all_else(hall, monkeypatch):
    """Of a floor that nothing else than panel 1 lights unevenly."""
    texels, surface = hall.texels, _surface(hall)
    floor = np.arange(64)
    share = np.array([_form_factor(p, (0.25, 0, 2), 0.01) for p in texels.position[floor]])
    light = np.full(64, 0.5)
    radiance = 4 * np.median(light / share)
    asked = _asked(0.4 * (light + radiance * share), light)._replace(texel=floor)
    monkeypatch.setattr(module, "beside_lamps", lambda _s, _l, _e, few, *_: few)
    nothing = np.zeros(len(texels), bool)
    groups = SimpleNamespace(
        lamp=np.zeros(0, bool),
        as_lamps=lambda which: Lamps(np.full(len(texels), -1), np.zeros((0, 3)), np.zeros(0),
                                     nothing[:0]),
    )  # fmt: skip
    lit = np.zeros((len(texels), 3), np.float32)

    def found(unseen, said=(), asked=asked) -> Likely:
        given = surface, lit, black_environment(), asked, np.array(unseen), groups, dict(said), 0
        return likely_lamps(*given)

    one = found([2, 1, 4])
    assert one.object.tolist() == [1]
    # A few of the floor's texels tell it.
    assert np.exp(one.usual[0, 0]) == pytest.approx(np.median(light / share), rel=0.1)
    assert not len(one.clipped)
    # One that is said to shine comes first, if it brings anything.
    assert found([2, 1, 4], {2: True, 4: True}).object.tolist() == [2, 1]
    assert not len(found([]).object)
    assert not len(found([1], asked=asked.of(np.zeros(64, bool))).object)
    assert not len(found([4]).object)


def test_a_part_that_clips_is_among_those_that_may_shine(hall, monkeypatch):
    """Panel 1 as the second of three parts, with numbers of their own: no object is likely."""
    texels, surface, numbers = hall.texels, _surface(hall), np.array([3, 5, 8])
    floor, owner = np.arange(64), texels.object_index()
    share = np.array([_form_factor(p, (0.25, 0, 2), 0.01) for p in texels.position[floor]])
    light = np.full(64, 0.5)
    reflected = 0.4 * (light + 4 * np.median(light / share) * share)
    asked = _asked(reflected, light)._replace(texel=floor)
    parts = {3: 4, 5: 1, 8: 3}  # numbers of parts, and the objects that they are here

    def as_lamps(which) -> Lamps:
        of = np.full(len(owner), -1)
        for k, number in enumerate(which):
            of[owner == parts[number]] = k
        count = len(which)
        return Lamps(of, np.zeros((count, 3)), np.ones(count), np.ones(count, np.bool_))

    monkeypatch.setattr(module, "beside_lamps", lambda _s, _l, _e, few, *_: few)
    monkeypatch.setattr(module, "strongest", lambda _groups: numbers)
    lit = np.zeros((len(texels), 3), np.float32)
    given = surface, lit, black_environment(), asked
    found = likely_lamps(*given, np.array([2]), SimpleNamespace(as_lamps=as_lamps), {}, 0)
    assert found.clipped.tolist() == [5]
    assert not len(found.object)
    assert found.usual.shape == (0, 3)
