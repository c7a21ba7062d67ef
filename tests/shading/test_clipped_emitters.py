"""Lamps of known radiance from the light that they cast, and how well that is said to be known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.shading import clipped_emitters as module
from usdbrdf.shading.clipped_emitters import (
    ERROR_ALONE,
    LAMP_PRIOR,
    EstimatedRadiance,
    Evidence,
    estimate_clipped_emitters,
)

ROOM = np.array([4.0, 3.0, 2.5])
LAMPS = np.array([[1.0, 1.0, 2.0], [3.2, 2.2, 1.6]])
MULTIPLIER = np.array([[6.0, 5.0, 4.0], [2.0, 2.5, 3.0]])
# What every surface mirrors of the surroundings, in the middle of what the estimator expects.
AMBIENT = 0.015


def _evidence(
    seed: int = 0,
    noise: float = 0.0,
    agreeing: float = 0.0,
    texture: float = 0.0,
    outliers: float = 0.0,
    lamps: np.ndarray = LAMPS,
) -> Evidence:
    """A box room with 60 texels on each wall, lit by small lamps and evenly by everything else.

    noise: of log L_d per texel; agreeing: over half a metre; texture: of half of the texels, a
    darker pattern; outliers: the share of the texels that highlights make three times as bright.
    """
    rng = np.random.default_rng(seed)
    position, normal = [], []
    for axis in range(3):
        for side in (0, 1):
            points = rng.uniform(0, ROOM, (60, 3))
            points[:, axis] = side * ROOM[axis]
            position.append(points)
            normal.append(np.broadcast_to((1 - 2 * side) * np.eye(3)[axis], (60, 3)))
    position, normal = np.concatenate(position), np.concatenate(normal)
    wall = np.repeat(np.arange(6, dtype=np.int32), 60)
    cast = []
    for lamp in lamps:
        way = lamp - position
        distance = np.linalg.norm(way, axis=1)
        cast.append(0.3 * (way * normal).sum(axis=1) / distance**3)
    lamp_irradiance = np.repeat(np.array(cast)[..., None], 3, axis=2)
    irradiance = np.repeat(0.6 + 0.1 * position[:, 2:], 3, axis=1)
    albedo = rng.uniform(0.2, 0.8, (6, 3))[wall]
    reflected = albedo * (
        irradiance + np.einsum("kc,knc->nc", MULTIPLIER[: len(lamps)], lamp_irradiance)
    )
    log_error = noise * rng.standard_normal(len(wall))
    log_error -= texture * (rng.random(len(wall)) < 0.5)
    distance = np.linalg.norm(position[:, None] - position, axis=-1)
    covariance = np.where(wall[:, None] == wall, np.exp(-distance / 0.5), 0)
    root = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(wall)))
    log_error += agreeing * (root @ rng.standard_normal(len(wall)))
    log_error += np.log(3) * (rng.random(len(wall)) < outliers)
    radiance = (reflected + AMBIENT * irradiance) / np.pi * np.exp(log_error)[:, None]
    return Evidence(
        radiance=radiance.astype(np.float32),
        irradiance=irradiance.astype(np.float32),
        lamp_irradiance=lamp_irradiance.astype(np.float32),
        position=position.astype(np.float32),
        segment=wall,
        object=wall,
        doubt=np.ones(len(wall)),
        prior=np.array([LAMP_PRIOR] * len(lamps)),
        shines=np.ones(len(lamps), np.bool_),
    )


def test_exact_light_gives_the_exact_lamps():
    found = estimate_clipped_emitters(_evidence())
    np.testing.assert_allclose(found.multiplier, MULTIPLIER, rtol=0.005)
    assert found.determined.all()
    # One wall tells most of the first one; nothing but the stated error of such a lamp is left.
    assert found.standard_error.max() < ERROR_ALONE + 0.01
    assert found.standard_error.min() < 0.06


def _with_mirror(evidence: Evidence, doubt: float) -> Evidence:
    """And the metal body of the first lamp, which receives most of its light from it and shows what
    it mirrors."""
    rng, count = np.random.default_rng(7), 60
    receives = np.exp(rng.normal(1, 1, (count, 1)))
    added = {
        "radiance": 0.3 * np.exp(rng.normal(0, 0.4, (count, 1))) * np.ones(3),
        "irradiance": np.full((count, 3), 0.6),
        "position": rng.uniform(1, 1.2, (count, 3)),
        "segment": np.full(count, 6),
        "object": np.full(count, 6),
        "doubt": np.full(count, doubt),
        "lamp_irradiance": np.stack([5 * receives, 0.02 * receives]) * np.ones(3),
    }
    both = {}
    for name, values in added.items():
        before = getattr(evidence, name)
        axis = 1 if name == "lamp_irradiance" else 0
        both[name] = np.concatenate([before, values], axis=axis).astype(before.dtype)
    return replace(evidence, **both)


def test_a_mirror_beside_a_lamp_outweighs_no_walls():
    evidence = _evidence(noise=0.03)
    found = estimate_clipped_emitters(_with_mirror(evidence, doubt=6))
    assert found.determined.all()
    np.testing.assert_allclose(found.multiplier, MULTIPLIER, rtol=0.05)
    # Taken for a plain reflector it says that the lamp is as dark as may be.
    plain = estimate_clipped_emitters(_with_mirror(evidence, doubt=1))
    assert not plain.determined[0]


@pytest.mark.parametrize(
    "fault",
    [
        {"noise": 0.1},
        {"agreeing": 0.1, "noise": 0.02},
        {"texture": 0.5, "noise": 0.02},
        {"outliers": 0.05, "noise": 0.05},
    ],
    ids=lambda fault: next(iter(fault)),
)
def test_the_stated_error_is_honest(fault: dict[str, float]):
    scores, errors = [], []
    for seed in range(4):
        found = estimate_clipped_emitters(_evidence(seed, **fault))
        # The channels share their texels' errors: one of them counts.
        error = found.standard_error[:, 1]
        scores.append(np.log(found.multiplier / MULTIPLIER)[:, 1] / error)
        errors.append(error)
        assert found.determined.all()
    # 8 scores of at most unit variance: a root mean square over 1.8 has p < 1e-3.
    assert np.sqrt(np.mean(np.square(scores))) < 1.8
    # And it is not honest by saying nothing.
    assert np.median(errors) < 0.25


def test_outliers_do_not_pull():
    clean = estimate_clipped_emitters(_evidence(3, noise=0.03))
    spoilt = estimate_clipped_emitters(_evidence(3, noise=0.03, outliers=0.05))
    np.testing.assert_allclose(spoilt.multiplier, clean.multiplier, rtol=0.08)


def test_light_that_falls_like_the_other_light_tells_nothing():
    evidence = _evidence(1, noise=0.03, lamps=LAMPS[:1])
    even = 0.7 * evidence.irradiance[None]
    found = estimate_clipped_emitters(replace(evidence, lamp_irradiance=even))
    assert not found.determined.any()
    assert (found.standard_error > 0.5).all()


def test_lamps_at_one_place_are_not_told_apart():
    evidence = _evidence(2, noise=0.03, lamps=LAMPS[[0, 0]])
    found = estimate_clipped_emitters(evidence)
    assert not found.determined.any()
    # Their sum is known all the same.
    np.testing.assert_allclose(found.multiplier.sum(axis=0), MULTIPLIER.sum(axis=0), rtol=0.15)


@pytest.mark.parametrize("seed", range(4))
def test_one_wall_alone_tells_a_spot_lamp(seed):
    """That without this wall nothing is known is no error of it; a surface that may be lit so is
    held to what the others say."""
    evidence = _evidence(seed, noise=0.03, lamps=LAMPS[:1])
    of_wall = (evidence.object == 0)[None, :, None]
    cast = np.where(of_wall, evidence.lamp_irradiance, 1e-4 * evidence.lamp_irradiance)
    before = evidence.irradiance + MULTIPLIER[0] * evidence.lamp_irradiance[0]
    radiance = evidence.radiance * (evidence.irradiance + 60 * cast[0]) / before
    spot = replace(evidence, lamp_irradiance=np.float32(cast), radiance=np.float32(radiance))
    found = estimate_clipped_emitters(spot)
    assert found.determined.all()
    assert (np.abs(np.log(found.multiplier / 60)) < 2 * found.standard_error).all()
    assert (found.standard_error > 0.9 * ERROR_ALONE).all()
    wall = estimate_clipped_emitters(replace(spot, shines=np.zeros(1, np.bool_)))
    assert not wall.determined.any()


def test_what_tells_a_spot_alone_is_left_out_as_a_whole_for_others():
    """Of a surface beside it that may be lit to be as bright, or of a lamp that others tell too."""
    evidence = _evidence(1, noise=0.03)
    of_wall = (evidence.object == 0)[None, :, None]
    cast = np.where(of_wall, evidence.lamp_irradiance, 1e-4 * evidence.lamp_irradiance)
    strength = np.array([60, 20])
    before = evidence.irradiance + np.einsum(
        "kc,knc->nc", MULTIPLIER, evidence.lamp_irradiance, dtype=np.float64
    )
    now = evidence.irradiance + np.einsum("k,knc->nc", strength, cast)
    both = replace(
        evidence,
        lamp_irradiance=np.float32(cast),
        radiance=np.float32(evidence.radiance * now / before),
        shines=np.array([True, False]),
    )
    found = estimate_clipped_emitters(both)
    np.testing.assert_array_equal(found.determined, [True, False])
    assert found.standard_error[1].min() > 2 * found.standard_error[0].max()


def test_an_uncertain_lamp_exceeds_what_is_two_errors_below():
    found = EstimatedRadiance(
        multiplier=np.array([[80.0, 60.0, 40.0], [4.0, 3.0, 2.0], [5.0, 5.0, 5.0]]),
        standard_error=np.array([[1.0, 1.0, 1.0], [1.5, 1.5, 1.5], [np.inf] * 3]),
        determined=np.zeros(3, np.bool_),
    )
    expected = np.array([np.array([80, 60, 40]) * np.exp(-2), [1, 1, 1], [1, 1, 1]])
    np.testing.assert_allclose(found.least(), expected)


def test_a_lamp_darker_than_its_bound_is_not_believed():
    evidence = _evidence(4, noise=0.03)
    bounds = evidence.lamp_irradiance * np.array([20, 1])[:, None, None]
    found = estimate_clipped_emitters(replace(evidence, lamp_irradiance=bounds))
    np.testing.assert_array_equal(found.determined, [False, True])
    assert found.multiplier[0].max() >= 1


def test_one_channel_may_lie_below_the_bound():
    # Where red clips at 4, blue need not: the bound is one number for all three.
    evidence = _evidence(5, noise=0.03)
    bounds = evidence.lamp_irradiance * np.array([5, 1])[:, None, None]
    found = estimate_clipped_emitters(replace(evidence, lamp_irradiance=bounds))
    assert found.determined.all()
    np.testing.assert_allclose(found.multiplier[0], MULTIPLIER[0] / 5, rtol=0.15)


def test_without_texels_nothing_is_known():
    evidence = _evidence()
    few = np.arange(3)
    found = estimate_clipped_emitters(
        replace(
            evidence,
            radiance=evidence.radiance[few],
            irradiance=evidence.irradiance[few],
            lamp_irradiance=evidence.lamp_irradiance[:, few],
            position=evidence.position[few],
            segment=evidence.segment[few],
            object=evidence.object[few],
        )
    )
    assert not found.determined.any()
    np.testing.assert_array_equal(found.multiplier, 1)


@pytest.mark.parametrize("misfit", [0.5, 3.0])
def test_texels_that_fit_worse_than_their_errors_say_make_lamps_less_certain(
    monkeypatch: pytest.MonkeyPatch, misfit: float
):
    """By the root of their mean square over the degrees of freedom, which each segment's albedo and
    each lamp take one of; texels that fit better do not make them more certain."""
    curvature, sizes, prior = np.diag([400.0, 100.0]), (9, 6, 7), np.array([[0.0, 2.0], [0, 0.5]])
    segments = [SimpleNamespace(index=np.arange(n), object=k) for k, n in enumerate(sizes)]
    for segment in segments:
        segment.ambient = np.zeros(len(segment.index))
    freedom = sum(sizes) - len(sizes) - 2
    square = misfit * freedom * np.array([1.0, 1.0, 2.0]) / 3

    def equations(*_given: Any) -> Any:
        return np.tile(curvature, (3, 1, 1)) / 3, np.zeros((3, 2)), square

    monkeypatch.setattr(module, "normal_equations", equations)
    monkeypatch.setattr(module, "lamp_share", lambda _e, item, _g: np.ones((2, len(item.index), 3)))
    weighed: Any = [(segment, np.eye(len(segment.index))) for segment in segments]
    evidence: Any = SimpleNamespace(prior=prior, shines=np.zeros(2, np.bool_))
    found = module._standard_error(evidence, weighed, np.zeros(2), np.zeros(3))
    told = 1 / (np.diag(curvature) + prior[:, 1] ** -2)
    wanted = told[:, None] * np.maximum(misfit * np.array([1.0, 1.0, 2.0]), 1)
    np.testing.assert_allclose(found, np.sqrt(wanted + module.LEAST_ERROR**2))
