"""A lamp above all pictures, from the light that it casts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.physics.surfaces import Sampling, box, quad, world_of
from tests.scenes import frames_at, look_at
from usdbrdf.job.task import TaskRun
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading import clipped_light, shaded
from usdbrdf.shading.clipped_groups import clipped_groups
from usdbrdf.shading.clipped_light import estimate_clipped_light
from usdbrdf.shading.hidden_light import KnownLamps, light_of_hidden
from usdbrdf.shading.lamp_light import known_well, looked_at_closely
from usdbrdf.shading.outside_light import Asked, Sources, gloss_of_scene, solved
from usdbrdf.shading.shaded import find_emitters
from usdbrdf.shading.unseen_lamps import UnseenLamps, lamps_that_explain
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import independent_tiles, irradiance_at
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.lit_scene import TexturedScene

DARK = black_environment()
RADIANCE = np.array([20.0, 16.0, 11.0])
LAMP, SHELF = 5, 6
# From one corner to the others.
FRAMES = frames_at(
    [
        look_at(np.array([0.5, 0.5, 1.7]), np.array([x, y, 1.0]))
        for x, y in ((5, 1), (5, 4), (1, 4), (3, 3))
    ]
)

# One of the blocks that stand in the room.
BLOCK = 8


@pytest.fixture(scope="module")
def hall():
    """A room of 6 x 5 x 4 m with two blocks; a panel under the ceiling, and a shelf beside it."""
    return _hall(1.2)


def _hall(panel: float, below: int = 0):
    """With so many things of 8 cm below the panel, each by itself."""
    return world_of([
        quad((0, 0, 0), (6, 0, 0), (0, 5, 0), (60, 50)),
        quad((0, 5, 0), (6, 0, 0), (0, 0, 4), (48, 32)),
        quad((0, 0, 0), (0, 5, 0), (0, 0, 4), (40, 32)),
        quad((6, 0, 0), (0, 0, 4), (0, 5, 0), (32, 40)),
        quad((0, 0, 0), (0, 0, 4), (6, 0, 0), (32, 48)),
        quad((2, 2, 3.95), (0, panel, 0), (panel, 0, 0), (8, 8)),
        quad((4.5, 3.5, 3.0), (0, 1.2, 0), (1.2, 0, 0), (8, 8)),
        quad((0, 0, 4), (0, 5, 0), (6, 0, 0), (30, 36)),
        *box((1, 1, 0.01), (2, 2, 1.2), (20, 20)),
        *box((3.5, 2.5, 0.01), (4.5, 3.5, 2.0), (20, 20)),
        *(quad((2.2 + k / 10, 2.5, 3.8), (0, 0.08, 0), (0.08, 0, 0), (4, 4)) for k in range(below)),
    ])  # fmt: skip


def _photographed(hall, radiance: np.ndarray, index: int):
    """The surface, L_d with an object that shines, light going to and fro four times, and what is
    seen: all but panel and shelf, whose L_d is filled in with what is usual."""
    surface, texels = TexturedScene(hall.scene, hall.texels, hall.rays), hall.texels
    random, owner = np.random.default_rng(3), texels.object_index()
    albedo = random.uniform(0.2, 0.7, (len(texels.resolution), 3))[owner]
    albedo = albedo * np.exp(0.15 * random.standard_normal((len(texels), 1)))
    lit = np.zeros((len(texels), 3), np.float32)
    for _ in range(4):
        lit[owner == index] = radiance
        arriving = irradiance_at(
            surface.rays, surface.texture(lit), lights_from_radiance(hall.scene, texels, lit),
            black_environment(), texels.position, texels.normal, independent_tiles(len(texels)),
            Sampling(standard_error=0.03, max_rays=256), surface.diagonal_m,
        ).mean  # fmt: skip
        lit = (albedo / np.pi * arriving).astype(np.float32)
    lit[owner == index] = radiance
    unseen = np.isin(owner, (LAMP, SHELF))
    shown = lit.copy()
    shown[unseen] = np.median(lit[~unseen], axis=0)
    if index not in (LAMP, SHELF):
        shown = np.where(unseen[:, None], shown, lit)
    return surface, shown, CoverageMap.of(~unseen, np.zeros(len(texels), np.bool_))


def _hidden_above(hall, height: float):
    """The same, of which no frame shows what is higher, and what is known of lamps: nothing."""
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    seen = coverage.observed & (surface.texels.position[:, 2] < height)
    lit = np.where(seen[:, None], lit, np.median(lit[seen], axis=0))
    none = np.zeros(len(seen), np.bool_)
    return surface, lit, CoverageMap.of(seen, none), KnownLamps(none, {})


def test_the_lamp_that_no_frame_shows_is_found_with_its_radiance(hall):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    found = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0)
    assert found.object.tolist() == [LAMP]
    np.testing.assert_allclose(found.radiance[0], RADIANCE, rtol=0.2)
    assert found.error[0] < 0.2
    # It shines as a whole, and with an error that is said.
    with_it = found.with_light(surface.texels, lit)
    own = surface.texels.of_object(LAMP)
    np.testing.assert_array_equal(with_it[own], np.tile(found.radiance[0], (64, 1)))
    rest = np.arange(len(lit))[own.stop :]
    np.testing.assert_array_equal(with_it[rest], lit[rest])
    emitters = find_emitters(
        surface.texels, with_it, np.full_like(lit, 100), coverage.measured, coverage.clipped,
        unseen_lamps=found.object,
    )  # fmt: skip
    assert np.flatnonzero(emitters.is_lamp).tolist() == [LAMP]
    assert emitters.lower_bound[LAMP]
    np.testing.assert_allclose(emitters.radiance[LAMP], found.radiance[0], rtol=1e-5)
    assert found.error_of(LAMP) == pytest.approx(float(found.error[0]))
    assert np.isnan(found.error_of(SHELF))


def test_what_hidden_walls_send_on_of_its_light_is_not_taken_for_its_own(hall, tmp_path: Path):
    surface, lit, coverage, known = _hidden_above(hall, 2.5)
    given = surface, lit, coverage, DARK, 0, known
    first = lamps_that_explain(surface, light_of_hidden(*given), coverage, FRAMES, DARK, 0)
    run = TaskRun(tmp_path, "shade", tmp_path)
    with_it, found = shaded._lit_by_unseen_lamps(run, *given, FRAMES, {})
    assert first.object.tolist() == found.object.tolist() == [LAMP]
    off, off_at_first = (np.abs(lamps.radiance[0] / RADIANCE - 1).max() for lamps in (found, first))
    assert off < 0.1
    assert off < 0.6 * off_at_first
    np.testing.assert_array_equal(with_it, found.with_light(surface.texels, with_it))


def test_a_lamp_that_is_none_in_the_others_light_is_off(hall, tmp_path: Path, monkeypatch):
    surface, lit, coverage, known = _hidden_above(hall, 2.5)
    both = UnseenLamps(
        object=np.array([LAMP, SHELF], np.int32),
        radiance=np.array([RADIANCE, 100 * RADIANCE], np.float32),
        error=np.full(2, 0.2, np.float32),
    )
    told = iter([both, *2 * [UnseenLamps(**{k: v[:1] for k, v in vars(both).items()})]])
    monkeypatch.setattr(shaded, "estimate_unseen_lamps", lambda *_: next(told))
    run = TaskRun(tmp_path, "shade", tmp_path)
    given = surface, lit, coverage, DARK, 0, known
    with_it, found = shaded._lit_by_unseen_lamps(run, *given, FRAMES, {})
    assert found.object.tolist() == [LAMP]
    assert not list(told)
    shelf = with_it[surface.texels.of_object(SHELF)]
    assert (shelf < np.max(lit[~np.isin(surface.texels.object_index(), LAMP)])).all()


def test_so_is_one_that_is_as_small_as_it_is_bright():
    # A thumb's width: one of a million rays that look around would meet it.
    bright = RADIANCE * (1.2 / 0.02) ** 2
    surface, lit, coverage = _photographed(_hall(0.02), bright, LAMP)
    found = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0)
    assert found.object.tolist() == [LAMP]
    np.testing.assert_allclose(found.radiance[0], bright, rtol=0.2)


def test_what_hangs_below_a_lamp_is_not_taken_for_it():
    # A point there explains nearly as much.
    hall = _hall(1.2, below=6)
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    small = surface.texels.object_index() >= len(hall.texels.resolution) - 6
    lit = np.where(small[:, None], np.median(lit[~small], axis=0), lit).astype(np.float32)
    coverage = CoverageMap.of(coverage.observed & ~small, np.zeros(len(small), np.bool_))
    found = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0)
    assert found.object.tolist() == [LAMP]
    np.testing.assert_allclose(found.radiance[0], RADIANCE, rtol=0.2)


def test_a_lamp_is_told_by_what_lies_evenly_in_its_light(hall, monkeypatch):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    shown = _blurred(surface.texels, lit)

    def off() -> float:
        found = lamps_that_explain(surface, shown, coverage, FRAMES, DARK, 0)
        return float(np.abs(found.radiance[0] / RADIANCE - 1).max())

    even = off()
    monkeypatch.setattr("usdbrdf.shading.lamp_light._LEAST_EVEN", 2.0)
    every = off()
    assert even < 0.1
    assert every > 2 * even


def _blurred(texels: Texels, lit: np.ndarray) -> np.ndarray:
    """Pixels blur shadows: beside an edge there is light of a lamp where none falls."""
    shown = lit.copy()
    for i in range(len(texels.resolution)):
        if i not in (LAMP, SHELF):
            picture = gaussian_filter(texels.image(i, lit), (1.5, 1.5, 0), mode="nearest")
            shown[texels.of_object(i)] = texels.from_image(i, picture)
    return shown


def test_so_is_a_lamp_that_clips(hall, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    texels, shown = surface.texels, _blurred(surface.texels, lit)
    clipped = texels.object_index() == LAMP
    shown[clipped] = 5.0
    coverage = CoverageMap.of(coverage.observed & ~clipped, clipped)

    def off(name: str) -> float:
        run = TaskRun(tmp_path, "shade", tmp_path / name)
        light = estimate_clipped_light(run, surface, shown, coverage, FRAMES, DARK, 0)
        assert light.estimate.determined.all()
        return float(np.abs(light.lit[clipped][0] / RADIANCE - 1).max())

    closely = off("closely")
    monkeypatch.setattr("usdbrdf.shading.clipped_light._CLOSELY", 0)
    every = off("every")
    assert closely < 0.1
    assert every > 2 * closely


def test_a_lamp_that_clips_is_unknown_meanwhile(hall):
    # Both shine; of the shelf, which frames show, a quarter of its radiance is known.
    surface, lit, _ = _photographed(hall, RADIANCE, LAMP)
    _, by_shelf, _ = _photographed(hall, RADIANCE, SHELF)
    owner = surface.texels.object_index()
    seen, clipped = ~np.isin(owner, (LAMP, SHELF)), owner == SHELF
    shown = np.where(seen[:, None], lit + by_shelf, lit)
    shown[clipped] = RADIANCE.max() / 4
    found = lamps_that_explain(surface, shown, CoverageMap.of(seen, clipped), FRAMES, DARK, 0)
    assert found.object.tolist() == [LAMP]
    np.testing.assert_allclose(found.radiance[0], RADIANCE, rtol=0.25)


def test_what_clips_in_the_light_of_a_lamp_that_no_frame_shows_is_none(hall, tmp_path, monkeypatch):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    lit[surface.texels.of_object(LAMP)] = RADIANCE
    block = surface.texels.object_index() == BLOCK
    limit = np.quantile(lit[block].max(axis=1), 0.3)
    clipped = block & (lit.max(axis=1) > limit)
    shown = np.where(clipped[:, None], np.minimum(lit, limit), lit)
    seen = CoverageMap.of(coverage.observed & ~clipped, clipped)

    def is_lamp(name: str, **given: np.ndarray) -> list[bool]:
        run = TaskRun(tmp_path, "shade", tmp_path / name)
        light = estimate_clipped_light(run, surface, shown, seen, FRAMES, DARK, 0, **given)
        return light.groups.lamp.tolist()

    unseen = surface.texels.object_index() == LAMP
    assert is_lamp("nothing else") == [True]
    assert is_lamp("lit", unseen=unseen) == [False]

    # That light is on while it is reckoned what the block sends on.
    known = []

    def hidden(surface, lit, coverage, environment, seed, lamps):
        known.append(lamps.texel[unseen].all())
        return lit

    monkeypatch.setattr(clipped_light, "light_of_hidden", hidden)
    is_lamp("again", unseen=unseen)
    assert known == [True]


def test_what_a_person_says_of_an_object_holds(hall):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    assert not len(
        lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0, {LAMP: False}).object
    )
    said = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0, {LAMP: True})
    assert said.object.tolist() == [LAMP]
    clipped = surface.texels.object_index() == SHELF
    coverage = CoverageMap.of(coverage.observed & ~clipped, clipped)
    for shines in (True, False):
        groups = clipped_groups(surface.texels, lit, coverage, {SHELF: shines})
        assert groups.lamp.tolist() == [shines]


def test_what_a_person_says_of_one_says_nothing_of_another(hall, monkeypatch):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)
    monkeypatch.setattr("usdbrdf.shading.unseen_lamps._MOST_ERROR", 0.0)
    found = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0, {SHELF: True})
    assert LAMP not in found.object
    # What hardly anything is known of is no lamp all the same.
    assert (found.error < 1).all()


def test_what_brings_most_of_the_light_need_not_be_known_as_well_as_what_brings_little():
    # At the same error of 0.4: with half of the light S errs by 0.2 in place of log 2 without it.
    part, error = np.array([1e-3, 0.2, 0.5, 0.73, 0.9]), 0.4
    with_it, without = part * error, np.log(1 / (1 - part))
    np.testing.assert_allclose((with_it / without)[[0, 2]], [0.4, 0.2 / np.log(2)], rtol=1e-3)
    known = known_well(np.full(5, error), part, 0.3)
    np.testing.assert_array_equal(known, with_it / without < 0.3)
    assert known.tolist() == [False, False, True, True, True]
    assert known_well(np.array([0.25, 3.0]), np.array([0.0, 1.0]), 0.3).all()
    assert not known_well(np.array([np.inf]), np.array([1.0]), 0.3).any()


@pytest.mark.parametrize(("part", "error", "shines"), [(0.8, 0.5, True), (0.2, 0.5, False)])
def test_a_lamp_is_believed_by_how_much_of_the_light_is_its_own(
    hall, monkeypatch, part, error, shines
):
    surface, lit, coverage = _photographed(hall, RADIANCE, LAMP)

    def badly_known(*given):
        found = looked_at_closely(*given)
        number = len(found.error)
        return found._replace(error=np.full(number, error), part=np.full(number, part))

    monkeypatch.setattr("usdbrdf.shading.unseen_lamps.looked_at_closely", badly_known)
    found = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0)
    assert (LAMP in found.object) == shines


def test_what_only_reflects_is_none(hall):
    # The lamp is a wall that frames show.
    surface, lit, coverage = _photographed(hall, RADIANCE / 4, 1)
    found = lamps_that_explain(surface, lit, coverage, FRAMES, DARK, 0)
    assert not len(found.object)
    assert found.with_light(surface.texels, lit) is lit
    assert not len(UnseenLamps.none().error)


def test_dark_surfaces_that_mirror_their_surroundings_do_not_dim_a_lamp():
    # Segments of any albedo, half of whose texels the lamp lights; all mirror what is around them
    # to the frames, which is less brown than that, and send some of the lamp's light on.
    random = np.random.default_rng(4)
    count, each = 40, 60
    segment = np.repeat(np.arange(count, dtype=np.int32), each)
    albedo = np.exp(random.uniform(np.log(0.03), np.log(0.8), (count, 3)))
    albedo[:, 2] *= 0.4  # browns
    around = random.uniform(0.5, 1.5, (count * each, 1)) * [1.0, 0.8, 0.6]
    mirrored = 0.08 * random.uniform(0.2, 2, (count * each, 1)) * [1.0, 0.9, 0.8]
    share = random.uniform(0.02, 0.2, count * each) * (random.random(count * each) < 0.5)
    sent_on = random.uniform(0.001, 0.01, count * each)
    lamp, texture = np.array([20.0, 18.0, 16.0]), np.exp(0.1 * random.standard_normal((2400, 1)))

    def found(gloss: float) -> tuple[float, np.ndarray, np.ndarray]:
        brought = (share + gloss * sent_on)[:, None] * lamp
        reflected = albedo[segment] * (around + brought) + gloss * mirrored
        asked = Asked(
            texel=np.arange(count * each),
            segment=segment,
            owner=segment,
            reflected=reflected * texture,
            clipped=np.zeros(count * each, np.bool_),
            irradiance=around,
            mirrored=mirrored,
        )
        sources = Sources(
            share=share[None],
            mean=np.zeros((1, 3)),
            deviation=np.array([3.0]),
            family=np.zeros(1, np.int64),
            pairs=np.zeros((0, 2), np.int64),
            apart=np.zeros(0),
        )
        glossy = gloss_of_scene(asked, sources, sent_on[None])
        lamps = (np.exp(solved(asked, one).log_radiance[0]) for one in (sources, glossy))
        return glossy.gloss[0], *lamps

    told, without, with_it = found(0.6)
    assert told in (0.5, 0.75)
    np.testing.assert_allclose(with_it, lamp, rtol=0.06)
    assert (without < 0.85 * lamp)[2]
    # And of surfaces that mirror nothing, little changes.
    told, without, with_it = found(0.0)
    assert told == 0
    np.testing.assert_allclose(without, lamp, rtol=0.03)
    np.testing.assert_allclose(with_it, without, rtol=0.03)
