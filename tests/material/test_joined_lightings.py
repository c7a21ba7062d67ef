"""What several lightings tell of one object, and what is left to doubt where light was inferred."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from usdbrdf.material import doubt_of_light
from usdbrdf.material.conductor import Conductor
from usdbrdf.material.doubt_of_light import with_doubts_of_light
from usdbrdf.material.fit_views import MIXTURE, SampledObject, joined_object
from usdbrdf.material.verdict import MAX_PSI_ERROR, NOTHING_KNOWN, SOME_EVIDENCE, LobeEstimate
from usdbrdf.material.view_model import ViewSamples
from usdbrdf.transport.brdf import CONDUCTOR, DIELECTRIC, F0_OF_PSI

FOUND = LobeEstimate(
    phi=0.2, psi=0.5, phi_error=0.02, psi_error=0.03, unresolved=0.0, cost=1.0, evidence=1.0,
    phi_median=0.3, psi_median=0.5, psi_upper=0.55,
)  # fmt: skip


def _seen(texels: int, views: int, cell: float, widths: tuple[float, ...], likely: list[float]):
    """An object in one lighting: what identifies its samples, by a number of their own."""
    count = texels * views
    number = 1000 * texels + np.arange(count, dtype=np.float32)
    samples = ViewSamples(
        texel=np.repeat(np.arange(texels), views),
        frame=100 * texels + np.tile(np.arange(views), texels),
        position=np.repeat(number[:, None], 3, axis=1),
        radiance=np.repeat(number[:, None], 3, axis=1) + 0.25,
        noise=np.repeat(number[:, None], 3, axis=1) + 0.5,
        cell=cell,
    )
    part: Any = SimpleNamespace(irradiance=None, name=texels)
    return SampledObject([part], samples, widths, likely, MIXTURE)


def test_a_texel_is_another_in_each_lighting():
    """Its diffuse light is, and so are the errors that its samples share."""
    several = [
        _seen(3, 2, 0.1, (1.0,), [1.0]), _seen(4, 6, 0.2, (1.0, 2.0), [0.75, 0.25]),
        _seen(2, 3, 0.5, (1.0, 2.0, 4.0), [0.5, 0.25, 0.25]),
    ]  # fmt: skip
    found = joined_object(several)
    assert found is not None
    # The first allows fewer footprints than the one of most samples.
    assert [part.name for part in found.parts] == [4, 2]
    samples = found.samples
    assert samples.texel.tolist() == [*np.repeat(range(4), 6).tolist(), 4, 4, 4, 5, 5, 5]
    kept = [one.samples for one in several[1:]]
    for name in ("frame", "position", "radiance", "noise"):
        wanted = np.concatenate([getattr(one, name) for one in kept])
        np.testing.assert_array_equal(getattr(samples, name), wanted)
    # By their samples, 24 and 6; of the footprints those that all have.
    assert samples.cell == pytest.approx((24 * 0.2 + 6 * 0.5) / 30)
    assert found.widths == (1.0, 2.0)
    assert found.likely == pytest.approx([(24 * 0.75 + 6 * 0.5) / 30, 0.25])


def test_one_lighting_is_as_it_is_and_none_is_none():
    one = _seen(3, 2, 0.1, (1.0,), [1.0])
    assert joined_object([one]) is one
    assert joined_object([]) is None


@pytest.fixture
def doubted(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What comes of a doubt of ``off`` in psi, and for which lobes it was asked."""
    asked: list[Any] = []

    def of(off: float, found: LobeEstimate, metal: Conductor | None = None) -> Any:
        asked.clear()

        def error(_sampled: Any, *lobe: Any) -> float:
            *kind, tint = lobe
            asked.append((*kind, *tint.ravel().tolist()))
            return off

        monkeypatch.setattr(doubt_of_light, "error_by_doubt", error)
        return *with_doubts_of_light(DIELECTRIC, lambda: None, 7, found, metal), asked  # type: ignore[arg-type, return-value]

    return of


def test_doubts_of_light_add_to_the_error_of_psi_up_to_where_nothing_is_known(doubted: Any):
    found, metal, asked = doubted(0.04, FOUND)
    assert metal is None
    assert asked == [(DIELECTRIC, 0.2, 0.5, 7, 1, 1, 1)]
    # 1.645 standard deviations of that beside what the samples left.
    upper = 0.5 + math.hypot(0.05, 1.645 * 0.04)
    assert found == FOUND._replace(psi_error=pytest.approx(0.05), psi_upper=pytest.approx(upper))
    found, _, _ = doubted(40.0, FOUND)
    assert found.psi_error == NOTHING_KNOWN
    assert found.psi_upper == 1
    assert doubted(0.0, FOUND)[0] == FOUND


def test_where_psi_is_badly_known_anyway_nothing_is_traced(doubted: Any):
    for least, traced in ((0.99, False), (1.01, True)):
        found, _, asked = doubted(0.04, FOUND._replace(evidence=least * SOME_EVIDENCE))
        assert bool(asked) == traced
        assert (found.psi_error > 0.03) == traced
    for share, traced in ((0.99, True), (1.01, False)):
        _, _, asked = doubted(0.04, FOUND._replace(psi_error=share * MAX_PSI_ERROR))
        assert bool(asked) == traced
    # But of a metal F0 is.
    metal = Conductor(0.1, (0.9, 0.8, 0.7), 0.02, 0.03, 1.0)
    badly = FOUND._replace(psi_error=1.2 * MAX_PSI_ERROR)
    found, doubtful, asked = doubted(0.3, badly, metal)
    psi = 0.9 / F0_OF_PSI
    assert asked == [(CONDUCTOR, 0.1, *map(pytest.approx, (psi, 7, 1, 8 / 9, 7 / 9)))]
    assert doubtful == metal._replace(f0_error=pytest.approx(math.hypot(0.03, F0_OF_PSI * 0.3)))
    # As much as that is of the metal's own psi.
    assert found.psi_error == pytest.approx(math.hypot(badly.psi_error, 0.3 * 0.5 / psi))
