"""What photographs are expected to tell, against least squares written out."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.advice.knowledge import (
    Exposure,
    Products,
    contrast,
    likely_lobes,
    lobes,
    outlook,
    share_found,
    view_of,
)

KNOWN = lobes()
BASIS = KNOWN.combination.shape[1]
EVEN = likely_lobes(KNOWN, *[np.nan] * 5)


def test_contrast_is_what_a_free_diffuse_part_cannot_explain():
    """Of one view after the other against the weighted regression on a constant per texel."""
    rng = np.random.default_rng(4)
    texels, views = 9, 5
    products = Products.none(texels, BASIS)
    basis = rng.normal(size=(views, texels, BASIS))
    weight = rng.uniform(0.5, 2, (views, texels))
    for v in range(views):
        products.add(np.arange(texels), weight[v], basis[v])
    d = rng.normal(size=BASIS)
    left = 0.0
    for t in range(texels):
        root = np.sqrt(weight[:, t])
        signal = root * (basis[:, t] @ d)
        fitted = np.linalg.lstsq(root[:, None], signal, rcond=None)[1]
        left += float(fitted[0])
    # With so few texels all are chosen for their highlights, too.
    per_freedom = left / (texels * (views - 1))
    found = contrast(products, d)
    eight = d @ found @ d
    assert eight == pytest.approx(per_freedom, rel=0.25)
    assert np.linalg.eigvalsh(found).min() > -1e-12


def test_without_views_nothing_is_known_and_with_clear_ones_everything():
    nothing = outlook(KNOWN, EVEN, np.zeros((BASIS, BASIS)))
    assert nothing.measured == 0
    assert nothing.phi_error > 0.28
    assert nothing.psi_error > 0.28
    all_apart = outlook(KNOWN, EVEN, 1e4 * np.eye(BASIS))
    assert all_apart.measured > 0.99
    assert max(all_apart.phi_error, all_apart.psi_error) < 0.01
    assert all_apart.worth > 0.9 > 0.1 > nothing.worth


def test_what_shows_psi_alone_leaves_phi_unknown():
    """A lobe that looks the same for each roughness tells how strong it is."""
    slope = np.concatenate([np.zeros(BASIS // 2), np.ones(BASIS // 2)])
    found = outlook(KNOWN, EVEN, 20 * np.outer(slope, slope))
    assert found.psi_error < 0.1
    assert found.phi_error > 0.25
    assert found.measured == 0


def test_more_light_in_the_highlight_tells_more():
    worth = [outlook(KNOWN, EVEN, scale * np.eye(BASIS)).worth for scale in (0.01, 0.1, 1, 10, 100)]
    assert worth == sorted(worth)


def test_a_stated_posterior_is_kept_to():
    likely = likely_lobes(KNOWN, 0.2, 0.6, 0.05, 0.1, 0.8)
    assert likely @ KNOWN.phi == pytest.approx(0.2, abs=0.05)
    assert likely @ KNOWN.psi == pytest.approx(0.6, abs=0.1)
    assert likely[KNOWN.psi > 0.8].sum() < 0.01
    assert EVEN @ KNOWN.phi == pytest.approx(0.5, abs=0.03)


def test_where_no_lobe_is_likelier_less_is_to_be_had():
    none = likely_lobes(KNOWN, 0.7, 0.0, 0.29, 0.29, 0.9)
    assert 0 < none.sum() < 0.45
    clear = 1e4 * np.eye(BASIS)
    assert outlook(KNOWN, none, clear).measured == pytest.approx(none.sum())
    assert outlook(KNOWN, none, clear).psi_error > 0.15


def test_what_clips_or_is_noise_weighs_nothing():
    level = np.array([0.0004, 0.5, 3.0])
    exposure = Exposure(0.02, 2.0, 0.001)
    weight, _ = view_of(level, np.zeros((3, BASIS)), np.zeros(BASIS), exposure)
    assert (weight > 0).tolist() == [False, True, False]
    assert 1 / np.sqrt(weight[1]) == pytest.approx(0.03 * 0.5, rel=0.01)


def test_a_change_that_all_of_a_frame_shares_tells_little():
    level, typical = np.ones(200), np.zeros(BASIS)
    exposure = Exposure(0.02, 100.0, 1e-6)
    alike = np.full((200, BASIS), 0.1)
    one = np.zeros((200, BASIS))
    one[:10] = 0.1
    for basis, kept in ((alike, 0.01), (one, 0.9)):
        weight, free = view_of(level, basis, typical, exposure)
        before = (weight[:, None] * basis**2).sum()
        after = (weight[:, None] * free**2).sum()
        assert (after > kept * before) == (kept > 0.5)


def test_a_fit_that_found_less_than_was_reckoned_lowers_what_is_reckoned():
    contrasts = np.eye(BASIS)
    own = EVEN @ np.einsum("hk,hk->h", KNOWN.combination, KNOWN.combination)
    assert share_found(KNOWN, EVEN, contrasts, own / (1 + own)) == pytest.approx(1)
    found = [share_found(KNOWN, EVEN, scale * contrasts, 0.3) for scale in (0.1, 1, 10, 100)]
    assert found == sorted(found, reverse=True)
    assert found[0] == 1 > 0.1 > found[-1]
    # Where next to nothing was to be found, finding nothing is no news.
    assert share_found(KNOWN, EVEN, 0.01 * contrasts, 0.0) > 0.9
    assert share_found(KNOWN, EVEN, contrasts, np.nan) == 1
