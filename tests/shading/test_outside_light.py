"""How well the strengths of sources are said to be known."""

from __future__ import annotations

import numpy as np

from usdbrdf.shading.outside_light import (
    Asked,
    Solution,
    Sources,
    jackknife,
    levelled,
    likeliest,
    pull_of_prior,
    solved,
)

WALLS, EACH = 12, 60
STRENGTH = np.array([40.0, 15.0])


def _walls(alone: bool) -> tuple[Asked, Sources, Solution]:
    """Twelve evenly lit walls and two lamps, which light the first wall only or all of them."""
    random = np.random.default_rng(2)
    segment = np.repeat(np.arange(WALLS, dtype=np.int32), EACH)
    share = random.uniform(0.005, 0.1, (2, len(segment)))
    share[:, segment > 0] *= 1e-4 if alone else 1
    albedo = random.uniform(0.2, 0.7, (WALLS, 1))[segment]
    light = 1 + (STRENGTH[:, None] * share).sum(axis=0)[:, None]
    texture = np.exp(0.1 * random.standard_normal((len(segment), 1)))
    asked = Asked(
        texel=np.arange(len(segment)),
        segment=segment,
        owner=segment,
        reflected=np.tile(albedo * light * texture, 3),
        clipped=np.zeros(len(segment), np.bool_),
        irradiance=np.ones((len(segment), 3)),
        mirrored=np.zeros((len(segment), 3)),
    )
    sources = Sources(
        share=share,
        mean=np.zeros((2, 3)),
        deviation=np.array([3.0, 3.0]),
        family=np.zeros(2, np.int64),
        pairs=np.zeros((0, 2), np.int64),
        apart=np.zeros(0),
    )
    return asked, sources, solved(asked, sources)


def test_only_of_a_lamp_for_certain_is_what_tells_it_alone_left_out_by_parts():
    asked, sources, found = _walls(alone=True)
    whole = jackknife(asked, sources, found)
    assert (whole > 1).all()
    error = jackknife(asked, sources, found, np.array([True, False]))
    assert (error[0] < 0.5).all()
    assert (error[0] > 0.15).all()
    assert (np.abs(found.log_radiance[0] - np.log(STRENGTH[0])) < 2 * error[0]).all()
    np.testing.assert_array_equal(error[1], whole[1])


def test_where_all_walls_tell_a_lamp_they_are_left_out_one_by_one():
    asked, sources, found = _walls(alone=False)
    whole = jackknife(asked, sources, found)
    assert (whole < 0.15).all()
    np.testing.assert_array_equal(jackknife(asked, sources, found, np.array([True, True])), whole)


def test_one_object_says_nothing_of_its_own_error():
    asked, sources, _ = _walls(alone=True)
    first = asked.segment == 0
    asked, sources = asked.of(first), sources._replace(share=sources.share[:, first])
    assert np.isinf(jackknife(asked, sources, solved(asked, sources))).all()


def test_a_wrong_prior_pulls_what_texels_do_not_tell():
    asked, sources, found = _walls(alone=False)
    assert (pull_of_prior(asked, sources, found) < 0.05).all()
    # The second lamp's light is as even as all the rest: only what is usual of albedos holds it.
    even = sources.share.copy()
    even[1] = 1e-3
    sources = sources._replace(share=even)
    assert (pull_of_prior(asked, sources, solved(asked, sources))[1] > 1).all()


def test_what_little_light_of_the_dark_is_not_known_does_not_dim_a_lamp():
    # Of each wall a part lies in the dark, another in the light of other walls, and the rest in the
    # lamp's as well; everywhere some light of which nobody knows, a fiftieth of all on the mean.
    random, number = np.random.default_rng(5), 90
    segment = np.repeat(np.arange(8, dtype=np.int32), number)
    place = np.tile(np.arange(number), 8)
    dark, lit = place < 30, place >= 60
    known = np.where(dark, 0.02, random.uniform(0.5, 1.5, len(segment)))
    share = np.where(lit, random.uniform(0.02, 0.06, len(segment)), 0)[None]
    light = known + 40 * share[0]
    stray = 0.02 * light.mean()
    albedo = random.uniform(0.2, 0.7, 8)[segment]
    texture = np.exp(0.1 * random.standard_normal(len(segment)))
    asked = Asked(
        texel=np.arange(len(segment)),
        segment=segment,
        owner=segment,
        reflected=np.repeat((albedo * (light + stray) * texture)[:, None], 3, axis=1),
        clipped=np.zeros(len(segment), np.bool_),
        irradiance=np.repeat(known[:, None], 3, axis=1),
        mirrored=np.zeros((len(segment), 3)),
    )
    sources = Sources(
        share=share,
        mean=np.zeros((1, 3)),
        deviation=np.array([3.0]),
        family=np.zeros(1, np.int64),
        pairs=np.zeros((0, 2), np.int64),
        apart=np.zeros(0),
    )

    def off(stray: float) -> float:
        found = solved(asked, sources._replace(stray=stray))
        return float(np.abs(found.log_radiance[0] - np.log(40)).max())

    assert off(0.04) < 0.1
    assert off(0.0) > 2 * off(0.04)


def _spots(strength: float, mean: list[float]) -> tuple[Asked, Sources]:
    """A lamp that lights a tenth of the texels of twelve walls, of which a fifth are in a shadow
    of which nobody knows; its strength is thought to be ``mean`` (3,), a logarithm."""
    random = np.random.default_rng(2)
    segment = np.repeat(np.arange(WALLS, dtype=np.int32), EACH)
    share = np.where(random.random(len(segment)) < 0.1, random.uniform(0.01, 0.02, len(segment)), 0)
    albedo = random.uniform(0.2, 0.7, WALLS)[segment]
    shines = random.random(len(segment)) < 0.8
    texture = np.exp(0.1 * random.standard_normal(len(segment)))
    reflected = albedo * texture * (1 + strength * share * shines)
    asked = Asked(
        texel=np.arange(len(segment)),
        segment=segment,
        owner=segment,
        reflected=np.tile(reflected[:, None], 3),
        clipped=np.zeros(len(segment), np.bool_),
        irradiance=np.ones((len(segment), 3)),
        mirrored=np.zeros((len(segment), 3)),
    )
    no_pairs = np.zeros((0, 2), np.int64), np.zeros(0)
    family = np.zeros(1, np.int64)
    return asked, Sources(share[None], np.array([mean]), np.array([3.0]), family, *no_pairs)


def test_a_lamp_is_looked_for_from_what_was_told_of_it_too():
    asked, sources = _spots(1500.0, [0.0, 0.0, 0.0])
    # From far away all texels that it lights are outliers.
    assert (solved(asked, sources).log_radiance[0] < np.log(100)).all()
    found = likeliest(asked, sources, np.full((1, 3), np.log(400.0)))
    np.testing.assert_allclose(found.log_radiance[0], np.log(1500), atol=0.05)


def test_what_one_channel_misses_the_others_tell():
    asked, sources = _spots(1500.0, [0.0, 0.0, np.log(1500)])
    assert (solved(asked, sources).log_radiance[0, :2] < np.log(100)).all()
    np.testing.assert_allclose(likeliest(asked, sources).log_radiance[0], np.log(1500), atol=0.05)


def test_a_start_from_which_less_is_explained_changes_nothing():
    asked, sources = _spots(1500.0, [np.log(1500)] * 3)
    far = np.zeros((1, 3))
    assert (solved(asked, sources._replace(mean=far)).log_radiance < np.log(100)).all()
    np.testing.assert_allclose(
        likeliest(asked, sources, far).log_radiance[0], np.log(1500), atol=0.05
    )


def test_the_level_of_light_that_nobody_saw_follows_what_looks_alike_from_all_sides():
    """In light of 1 four things reflect 0.2 to 1.2 of it: it is raised until the brightest would be
    white. Metals beside them, three times as bright where they mirror a window, tell less."""
    albedo = np.array([0.2, 0.4, 0.6, 1.2, 3, 3])
    owner = np.repeat(np.arange(6, dtype=np.int32), EACH)
    reflected = np.repeat(albedo[owner][:, None], 3, axis=1)
    asked = Asked(
        texel=np.arange(len(owner)),
        segment=owner,
        owner=owner,
        reflected=reflected,
        clipped=np.zeros(len(owner), np.bool_),
        irradiance=np.full((len(owner), 3), 1e-9),
        mirrored=0 * reflected,
    )
    sources = Sources(
        share=np.ones((1, len(owner))),
        mean=np.zeros((1, 3)),
        deviation=np.ones(1),
        family=np.zeros(1, np.int64),
        pairs=np.zeros((0, 2), np.int64),
        apart=np.zeros(0),
    )
    logs = np.log(albedo)[:, None] * np.ones(3)
    found = Solution(np.zeros((1, 3)), logs, np.zeros(3), np.zeros((6, 3)))

    def level(differing=None) -> float:
        return float(np.exp(levelled(asked, sources, found, differing).log_radiance).mean())

    mirrors = np.array([0.05] * 4 + [0.6] * 2)
    assert abs(level(lambda: mirrors) - 1.2) < 0.05
    assert abs(level() - 3) < 0.1
    assert level(lambda: np.full(6, np.nan)) == level()
