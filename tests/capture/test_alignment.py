"""Hand-held brackets of a camera whose path is made up are laid onto each other, or refused."""

from __future__ import annotations

import numpy as np
import pytest

from tests.capture.test_brackets import EXPOSURES, _against, _photograph, _shoot
from usdbrdf.capture import alignment
from usdbrdf.capture.alignment import aligned
from usdbrdf.capture.brackets import merge, response_from_brackets
from usdbrdf.errors import EnvironmentFailure, InputRefused

cv2 = pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")

MARGIN, SHAPE = 50, (300, 420)
NAMES = list("abcde")


def _paths(seed: int, *, degrees: float, pixels: float) -> np.ndarray:
    """(5, 3, 3): where each exposure has what the camera at rest has in its pixels."""
    rng = np.random.default_rng(seed)
    middle = np.array([[1, 0, SHAPE[1] / 2], [0, 1, SHAPE[0] / 2], [0, 0, 1.0]])
    found = []
    for _ in NAMES:
        angle = np.radians(rng.uniform(-degrees, degrees))
        moved = np.eye(3)
        moved[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        moved[:2, 2] = rng.uniform(-pixels, pixels, 2)
        moved[2, :2] = rng.uniform(-2e-5, 2e-5, 2)
        found.append(middle @ moved @ np.linalg.inv(middle))
    return np.array(found)


def _views(seed: int, paths: np.ndarray) -> list[np.ndarray]:
    """Radiance as each exposure sees it, of one large picture."""
    large = _photograph((SHAPE[0] + 2 * MARGIN, SHAPE[1] + 2 * MARGIN), decades=3, seed=seed)
    inside = np.array([[1, 0, MARGIN], [0, 1, MARGIN], [0, 0, 1.0]])
    flags = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
    return [
        np.exp(cv2.warpPerspective(np.log(large), inside @ path, SHAPE[::-1], flags=flags))
        for path in paths
    ]


def _bracket(seed: int, *, degrees: float, pixels: float):
    """Paths, the middle exposure's radiance, codes, exposures."""
    paths = _paths(seed, degrees=degrees, pixels=pixels)
    views, exposures = _views(seed, paths), EXPOSURES[2:7]
    shots = zip(views, exposures, strict=True)
    codes = [_shoot(v, e[None], seed=k)[0] for k, (v, e) in enumerate(shots)]
    return paths, views[2], np.array(codes), exposures


def _off(found: np.ndarray, paths: np.ndarray) -> float:
    """Pixels by which places in the exposures are off, at most, over the middle one."""
    row, column = np.mgrid[20 : SHAPE[0] - 20 : 10, 20 : SHAPE[1] - 20 : 10]
    places = np.stack([column.ravel(), row.ravel(), np.ones(row.size)])
    worst = 0.0
    for path, moved in zip(paths, found, strict=True):
        true, said = np.linalg.inv(path) @ paths[2] @ places, moved @ places
        worst = max(worst, np.hypot(*(true[:2] / true[2] - said[:2] / said[2])).max())
    return worst


@pytest.fixture(scope="module")
def response():
    """Of a shaken bracket too."""
    _, _, codes, exposures = _bracket(4, degrees=2, pixels=10)
    return response_from_brackets([aligned(codes, NAMES).stack], [exposures])


@pytest.mark.parametrize(("seed", "degrees", "pixels"), [(0, 0, 5), (1, 1, 8), (2, 3, 15)])
def test_shaken_brackets_are_laid_onto_each_other(response, seed, degrees, pixels):
    paths, true, codes, exposures = _bracket(seed, degrees=degrees, pixels=pixels)
    found = aligned(codes, NAMES)
    assert not found.unchecked.any()
    assert _off(found.moved, paths) < 0.2
    # Whole pixels would not do.
    assert _off(np.round(found.moved), paths) > 0.4
    merged = merge(found.stack, exposures, response, found.silent)
    known, ratio = _against(merged, true)
    assert known.mean() > 0.95
    assert np.nanmedian(np.abs(ratio - 1)) < 0.02
    assert merged.ghost < 0.03
    # The middle exposure shows what the others do not reach.
    assert found.silent[0].any()
    assert not found.silent[2].any()


@pytest.mark.parametrize(("degrees", "pixels"), [(0, 0), (1, 8)])
def test_who_walks_by_is_unknown_and_little_else_is(response, degrees, pixels):
    _, _, codes, exposures = _bracket(3, degrees=degrees, pixels=pixels)
    passer = np.full((50, 40, 3), 60 / exposures[1])
    codes[1, 120:170, 150:190] = _shoot(passer, exposures[1:2], seed=7)[0]
    found = aligned(codes, NAMES)
    merged = merge(found.stack, exposures, response, found.silent)
    unknown = np.isnan(merged.radiance).any(axis=2)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]].reshape(2, -1)
    there = found.moved[1] @ np.stack([column, row, np.ones(row.size)])
    right, down = (there[:2] / there[2]).reshape(2, *SHAPE)
    off = np.maximum(np.abs(right - 169.5) - 20, np.abs(down - 144.5) - 25)
    assert unknown[off < -3].mean() > 0.95
    assert unknown[off > 5].mean() < 0.03


def test_what_one_exposure_alone_reaches_has_its_limits_alone(response):
    """Where the shortest exposure shows nothing, who clips in the others may be of any radiance."""
    exposures = EXPOSURES[3:5]
    scene = np.full((12, 12, 3), 30 / exposures[0])
    scene[:, :6] = 200 / exposures[0]
    codes, silent = _shoot(scene, exposures), np.zeros((2, 12, 12, 3), bool)
    assert (codes[0, :, :6] > 250).all()
    codes[1, :, 2:6], silent[1, :, 2:6] = 0, True
    merged = merge(codes, exposures, response, silent)
    assert np.isnan(merged.radiance[:, 2:6]).all()
    assert np.isfinite(merged.radiance[:, :2]).all()
    assert np.isfinite(merged.radiance[:, 6:]).all()


def test_another_view_is_refused():
    here, there = (_photograph(SHAPE, decades=3, seed=seed) for seed in (0, 9))
    codes = np.array([_shoot(here, EXPOSURES[3:4])[0], _shoot(there, EXPOSURES[4:5])[0]])
    with pytest.raises(InputRefused, match=r"^a: shows another view than b.*\[brackets.moved\]$"):
        aligned(codes, NAMES)


def test_what_moved_too_far_is_refused():
    scene = _photograph(SHAPE, decades=3)
    far = np.roll(scene, 220, axis=1)
    codes = np.array([_shoot(scene, EXPOSURES[3:4])[0], _shoot(far, EXPOSURES[4:5])[0]])
    with pytest.raises(InputRefused, match=r"\[brackets.moved\]$"):
        aligned(codes, NAMES)


@pytest.mark.parametrize("stops", [8, -8])
def test_exposures_that_share_no_clear_code_are_said_to_be_unchecked(stops):
    """Of which nobody knows whether the camera moved; they stay as they are."""
    light, dark = _photograph(SHAPE, decades=0.5), np.roll(_photograph(SHAPE, decades=0.5), 9, 1)
    codes = [_shoot(view, EXPOSURES[3:4] * 2.0**by)[0] for view, by in ((light, 4), (dark, -5))]
    codes = np.array(codes if stops > 0 else codes[::-1])
    found = aligned(codes, NAMES)
    assert found.unchecked.tolist() == [True, False]
    np.testing.assert_array_equal(found.stack, codes)


def test_parallax_is_refused():
    scene = _photograph(SHAPE, decades=3)
    near = scene.copy()
    near[150:, 210:] = np.roll(scene, 12, axis=1)[150:, 210:]
    codes = np.array([_shoot(scene, EXPOSURES[3:4])[0], _shoot(near, EXPOSURES[4:5])[0]])
    with pytest.raises(InputRefused, match=r"^a: its parts .* against b.*\[brackets.moved\]$"):
        aligned(codes, NAMES)


def test_without_opencv_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(alignment, "find_spec", lambda name: None)
    codes = _shoot(_photograph((80, 80), decades=2), EXPOSURES[3:5])
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[brackets\].*\[environment.cv2\]"):
        aligned(codes, NAMES)
