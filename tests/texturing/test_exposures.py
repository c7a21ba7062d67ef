"""Frames that contradict each other in brightness are found, and good ones are not."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.exposures import (
    Probes,
    doubts_about_exposures,
    gains_of_frames,
    probed_texels,
    surfaces_agree,
    with_estimated_exposures,
)
from usdbrdf.texturing.exposures import contradicting_frames as contradicting_frames_of

FRAMES, TEXELS = 40, 600


def _logarithm(
    factors: dict[int, float] | None = None, *, reach: int = 6, seed: int = 0
) -> np.ndarray:
    """(TEXELS, FRAMES): each texel is seen by 2 x ``reach`` frames in a row, with 8 % of noise, and
    every tenth sample is a highlight, up to 20 times as bright."""
    rng = np.random.default_rng(seed)
    found = np.full((TEXELS, FRAMES), np.nan)
    for t, middle in enumerate(rng.integers(FRAMES, size=TEXELS)):
        own = np.arange(max(0, middle - reach), min(FRAMES, middle + reach))
        noise = 0.08 * rng.standard_normal(len(own))
        highlight = np.where(rng.random(len(own)) < 0.1, rng.uniform(0, 3, len(own)), 0)
        found[t, own] = rng.uniform(-6, 2) + noise + highlight
    for frame, factor in (factors or {}).items():
        found[:, frame] += np.log(factor)
    return found.astype(np.float32)


def contradicting_frames(frames, logarithm, owner=None):
    """Of one surface, if nothing else is said."""
    return contradicting_frames_of(
        frames, logarithm, np.zeros(len(logarithm), int) if owner is None else owner
    )


def _frames(*, radiometric: bool = True) -> SimpleNamespace:
    return SimpleNamespace(
        image_paths=tuple(Path(f"{i:04d}.exr") for i in range(FRAMES)), radiometric=radiometric
    )


def test_gains_are_those_that_were_made_up():
    rng = np.random.default_rng(4)
    made = np.exp(0.5 * rng.standard_normal(FRAMES))
    gains = gains_of_frames(_logarithm(dict(enumerate(made))))
    expected = np.log(made) - np.median(np.log(made))
    np.testing.assert_allclose(gains.logarithm, expected, atol=0.06)
    assert (gains.samples > 50).all()


def test_the_unit_does_not_matter():
    one = gains_of_frames(_logarithm({3: 4.0})).logarithm
    other = gains_of_frames(_logarithm({3: 4.0}) + np.float32(np.log(1e5))).logarithm
    np.testing.assert_allclose(one, other, atol=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_good_frames_raise_no_alarm(seed, capsys):
    assert contradicting_frames(_frames(), _logarithm(seed=seed)) == {}
    assert capsys.readouterr().err == ""


@pytest.mark.fault("C8")
@pytest.mark.parametrize("factor", [4.0, 1.6, 0.5])
def test_a_few_wrong_exposures_are_named_with_their_gains(factor, capsys):
    wrong = {5: factor, 6: factor, 31: factor}
    found = contradicting_frames(_frames(), _logarithm(wrong))
    assert found.keys() == {"0005.exr", "0006.exr", "0031.exr"}
    np.testing.assert_allclose(list(found.values()), factor, rtol=0.1)
    printed = capsys.readouterr().err
    assert "3 of 40 frames" in printed
    assert "0031.exr (" in printed
    assert "exposure_time" in printed
    assert printed.endswith("[texturing.exposure]\n")


@pytest.mark.fault("C8")
@pytest.mark.parametrize(
    "wrong", [range(1, FRAMES, 2), range(FRAMES // 2), range(0, FRAMES, 3)], ids=str
)
def test_two_camps_are_refused_unless_they_are_photographs(wrong):
    logarithm = _logarithm(dict.fromkeys(wrong, 4.0))
    with pytest.raises(InputRefused, match=r"of 40 frames .*0\d+\.exr \(.*not linear.*exposure\]$"):
        contradicting_frames(_frames(), logarithm)
    assert contradicting_frames(_frames(radiometric=False), logarithm)


def test_gloss_of_one_surface_is_no_wrong_exposure():
    """Nearly all that one frame shows is a floor, which mirrors a window to all others."""
    owner = (np.arange(TEXELS) % 10 == 0).astype(int)
    logarithm = _logarithm()
    logarithm[owner == 0, 5] += np.log(0.7)
    assert contradicting_frames(_frames(), logarithm, owner) == {}
    assert contradicting_frames(_frames(), logarithm).keys() == {"0005.exr"}
    logarithm[owner == 1, 5] += np.log(0.7)
    assert contradicting_frames(_frames(), logarithm, owner).keys() == {"0005.exr"}


def test_many_small_things_are_asked_together():
    """Of the floor's neighbours none has enough samples of its own in a frame."""
    floor = np.arange(TEXELS) % 5 < 3
    owner = np.where(floor, 0, 1 + np.arange(TEXELS) % 60)
    logarithm = _logarithm()
    for frame in range(5, 35, 10):
        logarithm[floor, frame] += np.log(0.6)
    assert contradicting_frames(_frames(), logarithm, owner) == {}
    for frame in range(5, 35, 10):
        logarithm[~floor, frame] += np.log(0.6)
    assert len(contradicting_frames(_frames(), logarithm, owner)) == 3


def test_what_two_frames_show_takes_no_share_of_another_surfaces_gloss():
    """Beside the floor, texels that one other frame shows, which are as bright in both."""
    rng = np.random.default_rng(3)
    owner = np.maximum(np.arange(TEXELS) % 10 - 5, 0)
    logarithm = _logarithm()
    logarithm[owner == 0, 5] += np.log(0.6)
    for texel in np.flatnonzero(owner):
        level = np.nanmedian(logarithm[texel])
        logarithm[texel] = np.nan
        pair = [5 if texel // 10 % 5 == 0 else rng.integers(0, 20), rng.integers(20, FRAMES)]
        logarithm[texel, pair] = level + 0.03 * rng.standard_normal(2)
    gains = gains_of_frames(logarithm)
    assert gains.logarithm[5] < -0.2
    of_others = gains.brighter[owner > 0, 5]
    assert np.isfinite(of_others).sum() > 30
    assert abs(np.nanmedian(of_others)) < 0.05
    assert contradicting_frames(_frames(), logarithm, owner) == {}


def test_a_screen_that_shows_something_else_hides_no_wrong_exposure():
    owner = (np.arange(TEXELS) % 8 == 0).astype(int)
    logarithm = _logarithm({5: 1.6})
    logarithm[owner == 1, 5] -= 2
    assert contradicting_frames(_frames(), logarithm, owner).keys() == {"0005.exr"}


def test_frames_that_share_nothing_are_not_judged():
    logarithm = _logarithm()
    logarithm[:, 7] = np.nan
    logarithm[:10, 7] = 30
    assert contradicting_frames(_frames(), logarithm) == {}
    assert contradicting_frames(_frames(), np.full((0, FRAMES), np.nan, np.float32)) == {}


def test_probes_are_the_same_however_the_texels_are_grouped():
    rng = np.random.default_rng(1)
    texel = rng.permutation(10_000)[:7000].astype(np.int32)
    radiance = rng.random((7000, 3), np.float32)
    radiance[::50] = 0
    whole = Probes.empty(10_000, 3)
    whole.add(1, texel, radiance)
    assert len(whole.logarithm) <= 4096
    assert np.isnan(whole.logarithm[:, [0, 2]]).all()
    parts = []
    for part in (slice(0, 1), slice(1, 4321), slice(4321, 10_000)):
        own = Probes.empty(10_000, 3, part)
        inside = (texel >= part.start) & (texel < part.stop)
        own.add(1, texel[inside], radiance[inside])
        parts.append(own.logarithm)
    np.testing.assert_array_equal(np.concatenate(parts), whole.logarithm)
    shown = texel % whole.every == 0
    lit = shown & radiance.any(axis=1)
    assert lit.sum() > 2000
    found = whole.logarithm[texel[lit] // whole.every, 1]
    np.testing.assert_array_equal(found, np.log(radiance[lit].mean(axis=1)))
    assert np.isfinite(whole.logarithm).sum() == lit.sum()


def test_many_frames_take_no_more_memory():
    assert Probes.empty(1_000_000, 50_000).logarithm.nbytes <= 9 << 20


def _same_for_all(gains: list[float]) -> np.ndarray:
    """Logarithms of 30 texels that as many frames show, by their gains."""
    level = np.linspace(-1, 3, 30)
    return (level[:, None] + np.log(gains)).astype(np.float32)


def test_exact_gains_are_found_exactly_and_samples_are_held_against_the_others():
    logarithm = _same_for_all([1, 2, 0.5, 1, 1])
    logarithm[:5, 4] = np.nan
    logarithm[29] = np.nan
    logarithm[29, 0] = 7  # of one frame alone
    gains = gains_of_frames(logarithm)
    np.testing.assert_allclose(np.exp(gains.logarithm), [1, 2, 0.5, 1, 1], rtol=2e-3)
    np.testing.assert_allclose(gains.scatter, 0, atol=2e-3)
    assert gains.samples.tolist() == [29, 29, 29, 29, 24]
    wanted = np.broadcast_to(np.log([1, 2, 0.5, 1, 1]), (30, 5)).copy()
    wanted[:5, 4] = wanted[29] = np.nan
    np.testing.assert_allclose(gains.brighter, wanted, atol=4e-3)
    # Frames that are not compared with enough others say nothing of what is usual.
    logarithm[:6, 1:] = np.nan
    few = gains_of_frames(logarithm)
    assert few.samples.max() == 23
    assert few.logarithm[1] - few.logarithm[0] == pytest.approx(np.log(2), abs=3e-3)


def test_scatter_is_that_of_the_middle_half_and_a_highlight_changes_nothing():
    logarithm = _same_for_all([1, 1, 1, 1, 1])
    logarithm[:, 2] += np.where(np.arange(30) % 2, 0.05, -0.05)
    logarithm[7, 1] += 3
    gains = gains_of_frames(logarithm)
    np.testing.assert_allclose(gains.logarithm, 0, atol=6e-3)
    # The texel's mean takes a fifth of what is off.
    assert gains.scatter[2] == pytest.approx(1.4826 * 0.05 * 4 / 5, rel=0.05)
    assert gains.scatter[0] == pytest.approx(1.4826 * 0.05 / 5, rel=0.15)
    assert gains.brighter[7, 1] == pytest.approx(3, rel=0.02)
    assert gains.brighter[3, 2] == pytest.approx(0.05, rel=0.1)


def _five(radiometric: bool, gain=None) -> Frames:
    return Frames(
        image_paths=tuple(Path(f"{i}.exr") for i in range(5)),
        world_from_camera=np.tile(np.eye(4), (5, 1, 1)),
        intrinsics=np.full((5, 4), 8.0),
        resolution=np.full((5, 2), 16, np.int32),
        exposure_time=np.array([1.0, 2, 3, 4, 5]),
        saturation_radiance=np.full(5, 10.0),
        noise_floor_radiance=np.full(5, 0.1),
        gain=gain,
        radiometric=radiometric,
    )


@pytest.mark.parametrize("radiometric", [True, False])
def test_frames_are_taken_as_exposed_as_their_pixels_say(radiometric: bool):
    logarithm = _same_for_all([1, 2, 0.5, 1, 4])
    logarithm[:7, 4] = np.nan  # shares too little with the others
    before = np.array([1.0, 1, 3, 1, 1]) if radiometric else None
    changed, off = with_estimated_exposures(_five(radiometric, before), logarithm)
    gain = np.array([1, 2, 0.5, 1, 1])
    np.testing.assert_allclose(changed.exposure_time, np.array([1, 2, 3, 4, 5]) * gain, rtol=3e-3)
    np.testing.assert_allclose(changed.saturation_radiance, 10 / gain, rtol=3e-3)
    np.testing.assert_allclose(changed.noise_floor_radiance, 0.1 / gain, rtol=3e-3)
    if radiometric:
        np.testing.assert_allclose(changed.gain, gain * [1, 1, 3, 1, 1], rtol=3e-3)
    else:
        assert changed.gain is None
    assert off == {"1.exr": 2.0, "2.exr": 0.5}
    (said,) = doubts_about_exposures(off, 5, Path("a/room"))
    assert said.startswith("room: 2 of 5 frames contradicted the others, 1.exr (2.00 x), 2.exr (0.")
    assert not [*doubts_about_exposures({}, 5, Path("a/room"))]


def test_surfaces_agree_where_two_thirds_of_them_are_off_by_half():
    """Of 30 points on four surfaces, of which the last two are small: together they count as one,
    and the first one that is off the other way not at all."""
    owner = np.array([7] * 8 + [2] * 8 + [4] * 7 + [5] * 7)
    gain = np.array([0.4, -0.4, 0.4, 0.4, 0.0, 0.4])
    brighter = np.zeros((30, 6))
    brighter[:, 0] = np.where(owner == 7, 0.05, 0.21)  # two of three
    brighter[:, 1] = np.where(owner == 7, 0.3, -0.21)  # two of two
    brighter[:, 2] = np.where(owner == 2, 0.21, 0.19)  # one of three
    brighter[:, 3] = 0.4
    brighter[:7, 3] = np.nan  # 23 points are too few
    brighter[:, 4] = 0.4
    brighter[:, 5] = -0.3  # none says anything
    found = surfaces_agree(brighter, gain, owner)
    assert found.tolist() == [True, True, False, False, False, False]
    brighter[6, 3] = 0.4
    assert surfaces_agree(brighter, gain, owner)[3]


def test_every_so_many_texels_are_probed():
    assert probed_texels(4096, 10).tolist() == list(range(4096))
    assert probed_texels(4097, 10).tolist() == list(range(0, 4097, 2))
    assert len(probed_texels(100, 1 << 15)) == 50  # 64 samples of as many frames each
    probes = Probes.empty(4097, 3, slice(5, 12))
    assert (probes.every, probes.first, probes.logarithm.shape) == (2, 3, (3, 3))
    radiance = np.array([[1.0, 2, 3], [4, 4, 4], [0, 0, 0], [9, 9, 9]], np.float32)
    probes.add(1, np.array([6, 7, 8, 10], np.int32), radiance)
    np.testing.assert_allclose(probes.logarithm[:, 1], np.log([2, np.nan, 9]), rtol=1e-6)
    assert np.isnan(probes.logarithm[:, [0, 2]]).all()
    some = probes.of(slice(7, 11))
    assert (some.every, some.first) == (2, 4)
    np.testing.assert_array_equal(some.logarithm, probes.logarithm[1:3])
