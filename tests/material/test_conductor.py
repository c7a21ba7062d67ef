"""Metals are told from dielectrics by what explains the samples better."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.job.task import TaskRun
from usdbrdf.job.units import HERE
from usdbrdf.material import doubt_of_light, fit_objects, fit_views
from usdbrdf.material.conductor import Conductor, conductor_of
from usdbrdf.material.fit_lobe import FittedKind
from usdbrdf.material.fit_objects import (
    FirstLook,
    Lighting,
    ObjectFit,
    fitted_by_likelier_lobe,
    have_lobe_of_paper,
    judged,
)
from usdbrdf.material.fit_views import SampledObject
from usdbrdf.material.verdict import LobeEstimate, usual_lobe
from usdbrdf.model.scene import SceneObject
from usdbrdf.options import FitOptions
from usdbrdf.transport.brdf import BECKMANN, DIELECTRIC, F0_OF_PSI, PAPER
from usdbrdf.transport.lit_scene import LitScene

TEXELS, VIEWS, PHI = 60, 10, 0.1
TEXEL = np.repeat(np.arange(TEXELS), VIEWS)
F0 = np.array([0.95, 0.75, 0.35])


def _incident(seed: int) -> np.ndarray:
    """(P, 3): what a mirror would show, a few lamps among dim walls."""
    rng = np.random.default_rng(seed)
    dim = rng.uniform(0.2, 0.6, (len(TEXEL), 1)) * [1.0, 0.9, 0.8]
    return np.where(rng.random((len(TEXEL), 1)) < 0.2, 8.0, 1.0) * dim


def _basis(seed: int, phi: float = PHI):
    """(base, slope) of roughnesses: sharp where phi is small, evened out where it is large."""
    light, noise = _incident(1), np.random.default_rng(seed)

    def basis(phis: Any) -> tuple[np.ndarray, np.ndarray]:
        blur = np.exp(-np.abs(np.log(np.maximum(np.asarray(phis), 1e-3) / phi)))
        seen = light[..., None] * blur + light.mean() * (1 - blur)
        seen = seen * (1 + 0.03 * noise.standard_normal(seen.shape))
        return (0.01 * seen).astype(np.float32), (F0_OF_PSI * seen).astype(np.float32)

    return basis


def _found(radiance: np.ndarray, psi: float, *, certain: bool = False, phi: float = PHI):
    noisy = radiance * (1 + 0.02 * np.random.default_rng(9).standard_normal(radiance.shape))
    dielectric = LobeEstimate(PHI, psi, 0.02, 0.1, 0.0, 1.0, 0.9)
    irradiance = np.full((len(TEXEL), 3), 1.5, np.float32)
    bases = _basis(2, phi), _basis(3, phi)
    noisy = noisy.astype(np.float32)
    return conductor_of(noisy, TEXEL, irradiance, bases, dielectric, certain=certain)


def test_a_metal_is_found_with_its_colour():
    metal = _found((0.01 + F0) * _incident(1), 1.0)
    assert metal is not None
    assert metal.phi == PHI
    np.testing.assert_allclose(metal.f0, F0, atol=0.03)
    assert metal.clearer > 0.5
    assert metal.f0_error < 0.05


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_the_unit_of_radiance_plays_no_part(unit: float):
    """Though texels that next to no light comes to count as if they showed a thousandth of the
    usual."""
    dark = np.where(TEXEL < 3, 1e-5, 1.0)[:, None]
    radiance = ((0.01 + F0) * _incident(1) * dark).astype(np.float32)
    light = np.full((len(TEXEL), 3), 1.5, np.float32)
    dielectric = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)

    def found(unit: float):
        def basis(seed: int) -> Any:
            lit = np.float32(unit * dark)[..., None]
            return lambda phis: tuple(one * lit for one in _basis(seed)(phis))

        samples = (radiance * np.float32(unit), TEXEL, light * np.float32(unit))
        return conductor_of(*samples, (basis(2), basis(3)), dielectric, certain=True)

    usual, other = found(1.0), found(unit)
    assert other.phi == usual.phi
    np.testing.assert_allclose(other.f0, usual.f0, rtol=1e-4)
    np.testing.assert_allclose(usual.f0, F0, atol=0.1)


def test_to_see_everything_twice_tells_of_the_same_metal():
    """What is far off, as glare is, is cut back by what a texel shows, not by how often it does."""
    rng = np.random.default_rng(4)
    glare = np.where(rng.random((len(TEXEL), 1)) < 0.05, 6.0, 1.0)
    radiance = ((0.01 + F0) * _incident(1) * glare).astype(np.float32)
    light = np.full((len(TEXEL), 3), 1.5, np.float32)
    dielectric = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)

    def found(times: int):
        def basis(seed: int) -> Any:
            return lambda phis: tuple(np.tile(one, (times, 1, 1)) for one in _basis(seed)(phis))

        samples = (np.tile(radiance, (times, 1)), np.tile(TEXEL, times), np.tile(light, (times, 1)))
        return conductor_of(*samples, (basis(2), basis(3)), dielectric, certain=True)

    once, twice = found(1), found(2)
    assert twice.phi == once.phi == PHI
    np.testing.assert_allclose(twice.f0, once.f0, rtol=1e-5)
    np.testing.assert_allclose(once.f0, F0, atol=0.1)


def test_a_metal_in_light_that_is_known_badly_is_found_by_what_changes_with_the_view():
    """A texel's own error of what it mirrors is no more against a metal than a diffuse part of the
    texel's own is for a dielectric."""
    rng = np.random.default_rng(5)
    known = np.exp(0.5 * rng.standard_normal(TEXELS))[TEXEL][:, None]
    shown = 0.5 + 0.2 * _incident(1)
    dim = np.where(rng.random((len(TEXEL), 1)) < 0.1, 1.3, 1.0) * shown
    radiance = (0.6 * dim * known).astype(np.float32)

    def basis(seed: int) -> Any:
        def of_phis(phis: Any) -> tuple[np.ndarray, np.ndarray]:
            _, slope = _basis(seed)(phis)
            blur = slope / F0_OF_PSI - _incident(1)[..., None]
            slope = F0_OF_PSI * (dim[..., None] + 0.2 * blur)
            return np.zeros_like(slope), slope.astype(np.float32)

        return of_phis

    light = np.full((len(TEXEL), 3), 1.5, np.float32)
    dielectric = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)
    metal = conductor_of(radiance, TEXEL, light, (basis(2), basis(3)), dielectric)
    assert metal is not None
    np.testing.assert_allclose(metal.f0, 0.6, atol=0.08)
    # What does not change with the view as a metal's does is none, however bright.
    still = np.bincount(TEXEL, radiance.mean(axis=1)) / np.bincount(TEXEL)
    plain = np.repeat(still[TEXEL][:, None], 3, axis=1).astype(np.float32)
    assert conductor_of(plain, TEXEL, light, (basis(2), basis(3)), dielectric) is None


@pytest.mark.parametrize("dark", [1.5, 2.0])
def test_a_varnished_pattern_in_light_that_is_told_too_dark_is_no_metal(dark: float):
    """A diffuse part of each texel passes for what a metal's mirrors that is not known, but does
    not change with the view."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pattern = np.exp(0.5 * rng.standard_normal((TEXELS, 1)))[TEXEL] * [1.0, 1.0, 0.9]
        radiance = 0.25 * pattern + 0.05 * dark * _incident(1)
        assert _found(radiance.astype(np.float32), 1.0) is None


def test_a_lamp_that_rays_find_and_the_frame_does_not_show_is_no_evidence():
    """Its ray outweighs all others of the mirror in a sum of squares."""
    radiance = ((0.01 + F0) * _incident(1)).astype(np.float32)
    light = np.full((len(TEXEL), 3), 1.5, np.float32)
    dielectric = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)

    def basis(seed: int) -> Any:
        def of_phis(phis: Any) -> tuple[np.ndarray, np.ndarray]:
            base, slope = _basis(seed)(phis)
            slope[7] += 500 * F0_OF_PSI
            return base, slope

        return of_phis

    metal = conductor_of(radiance, TEXEL, light, (basis(2), basis(3)), dielectric)
    assert metal is not None
    assert metal.phi == PHI
    np.testing.assert_allclose(metal.f0, F0, atol=0.03)


@pytest.mark.parametrize("f0", [(0.95, 0.75, 0.35), (0.95, 0.6, 0.05), (0.05, 0.6, 0.95)])
def test_each_channel_has_a_reflectance_of_its_own_beside_lamps_of_a_hundred_times(f0):
    """Rays to lamps are noisy; what one channel settles at from a start another does not."""
    rng = np.random.default_rng(5)
    mirrored = rng.uniform(0.2, 0.6, (len(TEXEL), 3)) * np.where(
        rng.random((len(TEXEL), 1)) < 0.3, 100.0, 1.0
    )

    def basis(seed: int):
        noise = np.random.default_rng(seed).standard_normal((len(TEXEL), 3))

        def of_phis(phis: Any) -> tuple[np.ndarray, np.ndarray]:
            sharp = np.exp(-np.abs(np.log(np.maximum(np.asarray(phis), 1e-3) / PHI)))
            seen = (mirrored * (1 + 0.2 * noise))[..., None] * sharp + mirrored.mean() * (1 - sharp)
            return np.zeros_like(seen, np.float32), (F0_OF_PSI * seen).astype(np.float32)

        return of_phis

    light = np.full((len(TEXEL), 3), 1.5, np.float32)
    dielectric = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)
    radiance = (np.array(f0) * mirrored).astype(np.float32)
    metal = conductor_of(radiance, TEXEL, light, (basis(2), basis(3)), dielectric, certain=True)
    assert metal is not None
    np.testing.assert_allclose(metal.f0, f0, atol=0.08)


def test_the_roughest_metal_is_told_by_nobody_but_a_person():
    rough = (0.01 + F0) * _incident(1)
    assert _found(rough, 1.0, phi=0.67) is not None
    assert _found(rough, 1.0, phi=0.8) is None
    assert _found(rough, 1.0, phi=0.8, certain=True) is not None


@pytest.mark.parametrize(
    ("psi", "noise", "evidence", "asked"),
    [
        (1.0, 0.0, 0.16, True),
        (1.0, 0.0, 0.02, False),
        (0.9, 0.0, 0.16, False),
        (0.95, 0.1, 0.16, True),
        (0.6, 0.4, 0.16, False),
        (0.9, 0.0, 0.5, True),
        (0.3, 0.4, 0.5, False),
    ],
)
def test_a_mirror_is_looked_for_though_a_dielectric_explains_next_to_nothing_of_it(
    psi: float, noise: float, evidence: float, asked: bool, monkeypatch
):
    """1 - (1 - 0.08 / 0.95)^2 = 0.16 of what a silver mirror shows."""
    first = LobeEstimate(0.0, psi, 0.01, 0.1, 0.0, 1.0, evidence, (0.0, noise))
    seen = []
    monkeypatch.setattr(fit_views, "repeated_where_noisy", lambda first, *_: first)
    monkeypatch.setattr(fit_views, "conductor_of", lambda *_, **__: seen.append(1))
    zeros = np.zeros((1, 3), np.float32)
    samples = SimpleNamespace(radiance=zeros, texel=np.zeros(1, np.int64))
    sampled = SimpleNamespace(samples=samples, irradiance=zeros, basis=lambda *_: _basis(2))
    fit_views.fit_views(DIELECTRIC, lambda: sampled, 0, first)
    assert bool(seen) == asked


def test_of_a_metal_in_light_that_nobody_knows_f0_is_unknown_and_no_more_than_that(monkeypatch):
    metal = _found((0.01 + F0) * _incident(1), 1.0)
    assert metal is not None
    monkeypatch.setattr(doubt_of_light, "error_by_doubt", lambda *_: 60.0)
    mirror = LobeEstimate(0.0, 1.0, 0.01, 0.1, 0.0, 1.0, 0.1)
    found, doubted = doubt_of_light.with_doubts_of_light(DIELECTRIC, lambda: None, 0, mirror, metal)
    assert doubted.f0_error == found.psi_error == pytest.approx(1 / math.sqrt(12))
    assert (
        doubt_of_light.with_doubts_of_light(DIELECTRIC, lambda: None, 0, mirror, None)[0] is mirror
    )


@pytest.mark.parametrize("texture", [0.0, 0.4])
def test_a_dielectric_is_none(texture: float):
    # psi = 0.9 under a diffuse part, plain or patterned.
    pattern = 1 + texture * np.random.default_rng(4).uniform(-1, 1, TEXELS)[TEXEL][:, None]
    diffuse = 0.5 * pattern * 1.5 / np.pi * np.array([1.0, 0.9, 0.7])
    assert _found(diffuse + (0.01 + F0_OF_PSI * 0.9) * _incident(1), 0.9) is None


def test_a_black_dielectric_is_none():
    # All that it shows is its lobe, as of a metal; but no metal reflects so little.
    assert _found((0.01 + F0_OF_PSI * 0.6) * _incident(1), 0.6) is None


def test_who_says_that_it_is_a_metal_gets_one_and_no_measurement_of_what_contradicts():
    diffuse = 0.5 * 1.5 / np.pi * np.array([1.0, 0.9, 0.7])
    metal = _found(diffuse + (0.01 + F0_OF_PSI * 0.9) * _incident(1), 0.9, certain=True)
    assert metal is not None
    assert metal.clearer < 0
    errors = {"metal_phi_error": 0.01, "f0_error": 0.02}
    found = ObjectFit(0.1, 0.9, 0.01, 0.05, num_samples=500)._replace(
        metal_phi=metal.phi, red=metal.f0[0], green=metal.f0[1], blue=metal.f0[2],
        clearer=metal.clearer, **errors,
    )  # fmt: skip
    verdict = judged(found, _object(), FitOptions(), True, "metal")
    assert (verdict.model, verdict.status) == ("conductor", "undetermined")
    assert judged(found._replace(clearer=0.4), _object(), FitOptions(), True).status == "measured"


def _object() -> SceneObject:
    return SceneObject(
        prim_path="/a/b", identifier="b", label="b", class_name="", first_face=0, num_faces=1
    )


def test_a_metal_is_published_as_one():
    found = ObjectFit(
        0.1, 1.0, 0.01, 0.05, 0.0, 1.0, 0.9, 0.1, 1.0, 1.0, 0.05, 0.12, 0.9, 0.7, 0.3, 0.01, 0.02,
        0.4, 500, 3,
    )  # fmt: skip
    verdict = judged(found, _object(), FitOptions(), True)
    assert (verdict.model, verdict.status, verdict.phi) == ("conductor", "measured", 0.12)
    assert verdict.f0 == (0.9, 0.7, 0.3)
    assert (
        judged(found._replace(f0_error=0.2), _object(), FitOptions(), True).status == "undetermined"
    )
    plain = judged(found._replace(clearer=math.nan), _object(), FitOptions(), True)
    assert plain.model == "dielectric"


def test_what_is_usual_is_shown_only_where_frames_tell_nothing():
    options = FitOptions(unmeasured="class")
    table = replace(_object(), class_name="table")
    usual = usual_lobe("table", "")
    assert usual is not None
    nothing = ObjectFit(0.4, 0.5, 0.28, 0.28, evidence=0.05, psi_upper=0.9, num_samples=500)
    shown = judged(nothing, table, options, True)
    assert (shown.status, shown.shown_phi, shown.shown_psi) == ("undetermined", *usual)
    # All that is known of this psi is that it is no less than 1.
    bounded = ObjectFit(0.1, 1.0, 0.01, 0.02, evidence=0.9, psi_upper=1.0, num_samples=500)
    verdict = judged(bounded, table, options, True)
    assert verdict.status == "undetermined"
    assert math.isnan(verdict.shown_psi)


EVIDENCE = {PAPER: 0.7, DIELECTRIC: 0.6, BECKMANN: 0.65}


class _Run(TaskRun):
    """Three objects that show a lobe, and one between them with too few samples."""

    def __init__(self, *clearer: float) -> None:
        self._workers, self._for_workers = HERE, Path()
        self.clearer = clearer

    def checkpoint_if(self, name: str, index: int | None = None) -> dict[str, np.ndarray] | None:
        if "look" not in name:
            return None
        if name.endswith("1"):
            return FirstLook({}, 40).arrays()
        shows = {kind: _lobe(evidence) for kind, evidence in EVIDENCE.items()}
        return FirstLook(shows, 40, *self.clearer).arrays()

    def save(self, name: str, found: dict[str, np.ndarray], index: int | None = None) -> None:
        assert name.startswith("object")


def _lobe(evidence: float) -> LobeEstimate:
    return LobeEstimate(0.1, 0.5, 0.02, 0.06, 0.01, 1.0, evidence, (0.001, 0.002), 0.12, 0.45, 0.6)


@pytest.mark.parametrize(("clearer", "of_beckmann", "chosen", "of_object"), [
    (0.9, 0.0, PAPER, PAPER),
    (0.9, -0.1, PAPER, PAPER),
    (0.9, -0.9, DIELECTRIC, BECKMANN),  # whose facets explain as much
    (-0.9, 0.1, DIELECTRIC, DIELECTRIC),
    (0.09, -0.1, DIELECTRIC, DIELECTRIC),  # hardly clearer: the lobe of renderers
    (-0.9, -0.4, DIELECTRIC, BECKMANN),
])  # fmt: skip
def test_the_scene_has_the_lobe_that_explains_its_views(
    monkeypatch: pytest.MonkeyPatch, clearer: float, of_beckmann: float, chosen: int, of_object: int
):
    # There are no samples that something could show through.
    monkeypatch.setattr(fit_objects, "with_what_shows_through", lambda *args: args[-1])
    names = ("rays", "radiance", "lights", "emission", "environment")
    lit = LitScene(
        scene=SimpleNamespace(objects=range(4)),  # type: ignore[arg-type]
        texels=SimpleNamespace(object_index=lambda: np.arange(4), resolution=np.ones((4, 2))),  # type: ignore[arg-type]
        **dict.fromkeys(names),  # type: ignore[arg-type]
    )
    shown = SimpleNamespace(texel=np.array([1, 0, 0, 2, 3]))
    survey = SimpleNamespace(target=np.array([3, -1, -1, -1]), shown=np.ones(4), observations=shown)
    lightings, run = [Lighting(lit, survey)], _Run(clearer, of_beckmann)  # type: ignore[arg-type]

    def fitted(options: FitOptions) -> tuple[int, list[ObjectFit]]:
        return fitted_by_likelier_lobe(run, lightings, None, options)  # type: ignore[arg-type]

    lobe, found = fitted(FitOptions())
    assert lobe == chosen
    assert found[0].evidence == EVIDENCE[of_object]
    has = of_object == BECKMANN
    assert [one.beckmann for one in found] == [has, 0, has, has]
    assert found[0][:2] == (0.1, 0.5)
    assert found[0][7:10] == (0.12, 0.45, 0.6)
    assert (found[0].target, found[0].num_samples) == (3, 40)
    assert np.isnan(found[1].phi)
    assert fitted(FitOptions(lobe="paper"))[0] == PAPER


@pytest.mark.parametrize(("ratios", "paper"), [
    ([0.2, 0.15, 0.1, -0.05], True),
    ([36.0], False),  # noise, or one odd thing
    ([36.0, -0.1, -0.1, -0.1], False),
    ([36.0, 0.14], False),
    ([36.0, 0.1, 0.1], True),
    ([-36.0, 0.3, 0.3, 0.3, 0.1], True),
    ([], False),
])  # fmt: skip
def test_no_one_or_two_objects_tell_which_lobe_a_scene_has(ratios: list[float], paper: bool):
    assert have_lobe_of_paper([None, *(FirstLook({}, 200, one) for one in ratios)]) is paper


def test_the_other_lobe_is_tried_only_where_one_shows(monkeypatch: pytest.MonkeyPatch):
    tried = []

    def fit_lobe(samples: Any, candidates: Any, repeats: int, known: Any) -> Any:
        tried.append(known)
        return FittedKind(_lobe(0.05), 0.0, None, [])  # type: ignore[arg-type]

    monkeypatch.setattr(fit_views, "fit_lobe", fit_lobe)
    sampled = SampledObject([], None, (), [], None)  # type: ignore[arg-type]
    assert list(fit_views.fit_kinds(sampled, [PAPER, DIELECTRIC], 0)) == [PAPER]
    assert tried == [None]


@pytest.mark.parametrize("lobe", [PAPER, DIELECTRIC, BECKMANN])
def test_a_metal_competes_with_the_dielectric_of_the_fit(lobe: int, monkeypatch):
    """Whose diffuse light does not come through at grazing angles: without that every dark thing
    seen so would be a metal."""
    asked = {}

    def basis(kind: int, phis: Any) -> int:
        return kind

    def of_all(*_: Any, of_dielectric: Any = None, **__: Any) -> None:
        asked["kinds"] = None if of_dielectric is None else [b([0.1]) for b in of_dielectric]

    monkeypatch.setattr(fit_views, "conductor_of", of_all)
    samples = SimpleNamespace(radiance=None, texel=None)
    sampled = SimpleNamespace(irradiance=1, samples=samples, basis=lambda width, seed: basis)
    first = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)
    fit_views.fit_views(lobe, lambda: sampled, 0, first)  # type: ignore[arg-type]
    assert asked["kinds"] == (None if lobe == PAPER else [lobe, lobe])


def test_a_metal_that_is_found_is_held_against_more_rays(monkeypatch: pytest.MonkeyPatch):
    """The product of what two noisy bases leave may by chance be next to nothing."""
    metal, seeds, asked = Conductor(0.1, (0.5, 0.4, 0.3), 0.02, 0.03, 0.2), [], []

    def basis(width: int, seed: int) -> Any:
        seeds.append(seed)
        return lambda kind, phis: (np.full((4, 3, 1), float(seed)), np.ones((4, 3, 1)))

    def by_chance(*given: Any, **_: Any) -> Conductor | None:
        asked.append([float(one([0.1])[0].mean()) for one in given[3]])
        return metal if len(asked) == 1 else None

    monkeypatch.setattr(fit_views, "conductor_of", by_chance)
    samples = SimpleNamespace(radiance=None, texel=None)
    sampled = SimpleNamespace(irradiance=1, samples=samples, basis=basis)
    first = LobeEstimate(PHI, 1.0, 0.02, 0.1, 0.0, 1.0, 0.9)
    assert fit_views.fit_views(DIELECTRIC, lambda: sampled, 7, first)[1] is None  # type: ignore[arg-type, return-value]
    found, more = seeds[:2], seeds[2:]
    assert found == [21, 22]
    assert len(set(more)) == len(more) == 8
    assert not set(more) & set(found)
    assert asked[0] == found
    assert asked[1] == pytest.approx([np.mean(more[:4]), np.mean(more[4:])])

    asked.clear()
    assert fit_views.fit_views(DIELECTRIC, lambda: sampled, 7, first, metal=True)[1] is metal  # type: ignore[arg-type, return-value]
    assert len(asked) == 1
