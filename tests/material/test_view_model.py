"""The mixed model of many views against its covariance matrix, written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from usdbrdf.material.view_model import ViewModel, ViewSamples, _effects

FIRST_GUESS, INDEPENDENT, OF_SPECULAR = 0.02, 0.012, 0.25
CELL, FREEDOM_OF_STUDENT = 0.1, 15


def _samples(
    rng: np.random.Generator, texels: int, frames: int, *, area: float = 0.4
) -> ViewSamples:
    """Every texel in every frame, on a square of side ``area``; radiance yet without errors."""
    position = np.zeros((texels, 3), np.float32)
    position[:, :2] = area * rng.random((texels, 2))
    diffuse = rng.uniform(0.2, 1.0, (texels, 3))
    texel, frame = (a.ravel() for a in np.mgrid[0:texels, 0:frames])
    return ViewSamples(
        texel=texel,
        frame=frame,
        position=position[texel],
        radiance=diffuse[texel].astype(np.float32),
        noise=np.full((len(texel), 3), 1e-3, np.float32),
        cell=CELL,
    )


def _with_errors(
    samples: ViewSamples, rng: np.random.Generator, deviation: dict[str, float]
) -> ViewSamples:
    """The same with relative errors shared as the model has it, and independent ones."""
    count = len(samples.texel)

    def drawn(kind: str, number: np.ndarray, channels: int) -> np.ndarray:
        which = np.unique(number, return_inverse=True)[1]
        values = deviation[kind] * rng.standard_normal((which.max() + 1, channels))
        return np.broadcast_to(values[which], (count, 3))

    small, large = _cells(samples, CELL), _cells(samples, 2.5 * CELL)
    error = drawn("frame", samples.frame, 1) + drawn("frame of channel", samples.frame, 3)
    error = error + drawn("small", small, 1) + drawn("large", large, 1)
    error = error + drawn("large of channel", large, 3) + drawn("own", np.arange(count), 1)
    error = error + INDEPENDENT * rng.standard_normal((count, 3))
    return replace(samples, radiance=(samples.radiance * (1 + error)).astype(np.float32))


def _cells(samples: ViewSamples, size: float) -> np.ndarray:
    """One number for the samples of a frame in a cube of that size."""
    cell = np.floor((samples.position - samples.position.min(axis=0)) / size).astype(int)
    rows = np.column_stack([samples.frame, cell])
    return np.unique(rows, axis=0, return_inverse=True)[1].ravel()


def _shared_columns(samples: ViewSamples, level: np.ndarray) -> list[np.ndarray]:
    """Z of each kind of shared error, (3 P, n): level where a sample has it, groups of one left
    out. Frame, small cells, large ones, then per channel of frame and of large cells."""
    small, large = _cells(samples, CELL), _cells(samples, 2.5 * CELL)
    every = [(samples.frame, None), (small, None), (large, None)]
    every += [(group, c) for group in (samples.frame, large) for c in range(3)]
    result = []
    for group, channel in every:
        columns = []
        for number in np.unique(group):
            has = group == number
            if has.sum() < 2:
                continue
            column = np.zeros_like(level)
            channels = range(3) if channel is None else [channel]
            for c in channels:
                column[has, c] = level[has, c]
            columns.append(column.reshape(-1))
        result.append(np.array(columns).reshape(len(columns), -1).T)
    return result


def _covariance(samples: ViewSamples, model: ViewModel) -> np.ndarray:
    """(3 P, 3 P) with nothing eliminated, from the model's present variances."""
    level, specular, trust = model._level, model._specular, model._robust_weight
    variance = (INDEPENDENT * (level + specular)) ** 2 + (OF_SPECULAR * specular) ** 2
    variance = (variance + samples.noise.astype(float) ** 2) * model._scale / trust[:, None]
    covariance = np.diag(variance.ravel())
    for p, own in enumerate(level):
        block = slice(3 * p, 3 * p + 3)
        covariance[block, block] += model._own_deviation**2 / trust[p] * np.outer(own, own)
    for columns, deviation in zip(_shared_columns(samples, level), model._deviation, strict=True):
        covariance += deviation**2 * columns @ columns.T
    return covariance


def _product(samples: ViewSamples, covariance: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """a' (C^-1 - C^-1 X (X' C^-1 X)^-1 X' C^-1) b, X having one column per texel and channel."""
    free = np.kron(samples.texel[:, None] == np.arange(samples.texel.max() + 1), np.eye(3))
    weight = np.linalg.inv(covariance)
    inner = np.linalg.inv(free.T @ weight @ free)
    projected = weight - weight @ free @ inner @ free.T @ weight
    return float(a.ravel() @ projected @ b.ravel())


def _found(model: ViewModel, a: np.ndarray, b: np.ndarray) -> float:
    """The model's product of two sets of values (P, 3)."""
    return float(model.product(model.reduced(a[..., None]), model.reduced(b[..., None]))[0])


@pytest.mark.parametrize("updates", [0, 3])
def test_costs_are_those_of_generalised_least_squares(updates: int):
    rng = np.random.default_rng(3)
    samples = _samples(rng, 9, 5)
    strong = {"frame": 0.05, "frame of channel": 0.02, "small": 0.04, "large": 0.05,
              "large of channel": 0.02, "own": 0.03}  # fmt: skip
    samples = _with_errors(samples, rng, strong)
    radiance = samples.radiance.copy()
    radiance[7] *= 1.5  # an outlier loses weight
    samples = replace(samples, radiance=radiance)
    # Not every texel is in every frame.
    kept = np.sort(rng.choice(45, 38, replace=False))
    samples = ViewSamples(
        **{name: value[kept] for name, value in vars(samples).items() if name != "cell"}, cell=CELL
    )
    samples = replace(samples, texel=np.unique(samples.texel, return_inverse=True)[1])
    model = ViewModel(samples)
    lobe = 0.1 * rng.random((len(samples.texel), 3))
    for _ in range(updates):
        model.update(lobe)
    if updates:
        assert model._robust_weight.min() < 0.8 < 1 < model._robust_weight.max()
    else:
        np.testing.assert_array_equal(model._deviation, FIRST_GUESS)
    covariance = _covariance(samples, model)
    a, b = rng.standard_normal((2, len(samples.texel), 3))
    for x, y in ((a, a), (a, b), (samples.radiance.astype(float), b)):
        wanted = _product(samples, covariance, x, y)
        assert _found(model, x, y) == pytest.approx(wanted, rel=1e-8, abs=1e-8)
        solved = model.solved(y[..., None])[..., 0]
        assert float((x * solved).sum()) == pytest.approx(wanted, rel=1e-8, abs=1e-8)


def test_what_a_texel_shows_in_all_frames_costs_nothing():
    rng = np.random.default_rng(0)
    samples = _samples(rng, 12, 6)
    model = ViewModel(samples)
    free = rng.standard_normal((12, 3))[samples.texel]
    other = rng.standard_normal(free.shape)
    scale = _found(model, other, other)
    assert abs(_found(model, free, other)) < 1e-9 * scale
    # A factor common to a frame's samples is cheap, not free: it may be its exposure.
    exposed = (samples.frame == 2)[:, None] * samples.radiance.astype(float)
    exposed *= np.linalg.norm(other) / np.linalg.norm(exposed)
    cost = _found(model, exposed, exposed)
    assert 0 < cost < 0.05 * scale


def test_the_samples_tell_how_large_their_errors_are():
    # 25 frames, 100 texels in four large cells and 25 small ones.
    true = {"frame": 0.06, "frame of channel": 0.03, "small": 0.03, "large": 0.05,
            "large of channel": 0.015, "own": 0.01}  # fmt: skip
    rng = np.random.default_rng(1)
    samples = _with_errors(_samples(rng, 100, 25, area=0.499), rng, true)
    model = ViewModel(samples)
    for _ in range(25):
        model.update(np.zeros_like(samples.radiance))
    frame, small, large, *of_channels = model._deviation
    assert frame == pytest.approx(true["frame"], rel=0.35)
    assert small == pytest.approx(true["small"], rel=0.15)
    assert large == pytest.approx(true["large"], rel=0.25)
    assert np.mean(of_channels[:3]) == pytest.approx(true["frame of channel"], rel=0.35)
    assert np.mean(of_channels[3:]) == pytest.approx(true["large of channel"], rel=0.25)
    # A little low: of four samples in a small cell the cell's error takes a share.
    assert model._own_deviation == pytest.approx(true["own"], rel=0.35)
    assert model._scale == pytest.approx(1, rel=0.25)
    # With the right covariance each degree of freedom costs about one.
    whole = samples.radiance
    assert _found(model, whole, whole) / model.degrees_of_freedom == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("own", [0.01, 0.06])
def test_what_all_channels_of_a_sample_share_is_told_from_what_they_do_not(own: float):
    """Where no frame shows two texels, each sample has an error of its own, of all channels alike,
    and one of each channel, which is as large as it was said to be."""
    rng, count = np.random.default_rng(5), 60 * 20
    samples = replace(_samples(rng, 60, 20, area=100.0), frame=np.arange(count))
    error = own * rng.standard_normal((count, 1)) + INDEPENDENT * rng.standard_normal((count, 3))
    # Of Student's distribution, as the model has it.
    error /= np.sqrt(rng.chisquare(FREEDOM_OF_STUDENT, (count, 1)) / FREEDOM_OF_STUDENT)
    samples = replace(samples, radiance=(samples.radiance * (1 + error)).astype(np.float32))
    model = ViewModel(samples)
    for _ in range(30):
        model.update(np.zeros((count, 3)))
    assert model._own_deviation == pytest.approx(own, rel=0.08)
    assert model._scale == pytest.approx(1, rel=0.1)


def _shared_errors(model: ViewModel) -> int:
    return sum(len(frame.kind) for frame in model._effects)


def test_a_group_of_a_single_sample_has_no_error_of_its_own():
    # 30 texels, far apart, each in three of 90 frames: nothing is shared.
    rng = np.random.default_rng(2)
    samples = _samples(rng, 30, 3, area=100.0)
    samples = replace(samples, frame=np.arange(90))
    alone = ViewModel(samples)
    assert _shared_errors(alone) == 0
    values = rng.standard_normal((90, 3))
    alone.update(np.zeros((90, 3)))
    assert _found(alone, values, values) > 0
    # The first two texels meet in one frame: that frame has a column, and one per channel.
    samples.frame[3] = samples.frame[0]
    together = ViewModel(samples)
    assert _shared_errors(together) == 4


def test_more_frames_than_shared_errors_are_wanted_come_to_an_end():
    # Nine for each frame, however large the cells: more than the most that there may be.
    few = _samples(np.random.default_rng(6), 3, 300)
    model = ViewModel(few)
    assert model.degrees_of_freedom > 0


@pytest.mark.parametrize("along", [(1, 0, 0), (1, 1, 1), (0, 0.1, 1)])
def test_cells_grow_until_their_errors_are_few_enough_however_the_object_lies(
    along: tuple[float, float, float],
):
    """50 frames of 60 places in a row ten metres away: more than 2500 small cells of a metre's
    thousandth, and no more than 2500 errors in all once cells hold several places each."""
    texel, frame = (a.ravel() for a in np.mgrid[0:60, 0:50])
    row = np.linspace(0, 1, 60)[:, None] * np.array(along)
    samples = ViewSamples(
        texel=texel,
        frame=frame,
        position=np.float32(10 + row)[texel],
        radiance=np.ones((3000, 3), np.float32),
        noise=np.ones((3000, 3), np.float32),
        cell=0.02,
    )
    every = _effects(samples)
    number = sum(int(which.max(initial=-1)) + 1 for which, _ in every)
    # Nine for each frame if cells are as large as all of it, which they need not be here.
    assert 9 * 50 < number <= 2500
    assert [channel for _, channel in every] == [None, None, None, 0, 1, 2, 0, 1, 2]


def test_what_no_lobe_explains_is_told_beside_what_one_does():
    # Of something that is seen through, views differ alike over places of it.
    rng = np.random.default_rng(2)
    surface = {"frame": 0.01, "frame of channel": 0.01, "small": 0.02, "large": 0.02,
               "large of channel": 0.01, "own": 0.01}  # fmt: skip
    pane = surface | {"frame": 0.2, "small": 0.3, "large": 0.3}
    for true, specular in ((surface, 0.0), (surface, 0.4), (pane, 0.0), (pane, 0.4)):
        samples = _with_errors(_samples(rng, 100, 25, area=0.499), rng, true)
        lobe = specular * samples.radiance.astype(float)
        samples = replace(samples, radiance=(samples.radiance + lobe).astype(np.float32))
        model = ViewModel(samples)
        for _ in range(6):
            model.update(lobe)
        alike = np.linalg.norm([true[name] for name in ("frame", "small", "large")])
        assert model.contradiction == pytest.approx(alike / (1 + specular), rel=0.25)


def test_places_are_six_across_up_to_the_very_end():
    along = np.linspace(0, 1, 61, dtype=np.float32)
    samples = ViewSamples(
        texel=np.arange(61),
        frame=np.zeros(61, np.int64),
        position=np.stack([3 + 0.7 * along, 0 * along, 0 * along], axis=1),
        radiance=np.ones((61, 3), np.float32),
        noise=np.ones((61, 3), np.float32),
        cell=0.1,
    )
    count = np.bincount(samples.places)
    assert len(count) == 6
    assert count.min() >= 9
