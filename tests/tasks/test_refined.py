"""What is published of fits."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from usdbrdf.material.fit_objects import ObjectFit
from usdbrdf.model.scene import SceneObject
from usdbrdf.options import FitOptions
from usdbrdf.tasks.refined import fitted_objects

_DIELECTRIC = ObjectFit(
    0.1, 0.5, 0.01, 0.05, 0.0, 1.0, 0.9, 0.1, 0.5, 0.6, num_samples=500, beckmann=1
)
_METAL = _DIELECTRIC._replace(
    metal_phi=0.1, red=0.9, green=0.7, blue=0.3, metal_phi_error=0.01, f0_error=0.02, clearer=0.4
)


def published(fit: ObjectFit, *, microfacet: bool = True):
    thing = SceneObject(
        prim_path="/a/b", identifier="b", label="b", class_name="", first_face=0, num_faces=1
    )
    maps = SimpleNamespace(scene=SimpleNamespace(objects=[thing]), is_observed=lambda _: True)
    [found] = fitted_objects([maps], [fit], FitOptions(), {}, said={}, microfacet=microfacet)  # type: ignore[list-item]
    return found


@pytest.mark.parametrize(
    ("fit", "microfacet", "lobe"),
    [
        (_DIELECTRIC, True, "beckmann"),
        (_DIELECTRIC._replace(beckmann=0), True, "microfacet"),
        (_METAL, True, "microfacet"),  # whose numbers are of the facets of renderers
        (_DIELECTRIC._replace(beckmann=0), False, "paper"),
    ],
)
def test_the_lobe_that_is_named_is_the_one_that_numbers_are_of(
    fit: ObjectFit, microfacet: bool, lobe: str
):
    found = published(fit, microfacet=microfacet)
    assert found.lobe == lobe
    assert found.status == "measured"
    assert found.is_metal == math.isfinite(fit.clearer)


@pytest.mark.parametrize("cost", [-0.0025, 0.0, 1.5])
def test_rays_that_were_noisier_than_the_samples_leave_no_cost_below_nothing(cost: float):
    """Else the asset that was just made is found wrong."""
    assert published(_DIELECTRIC._replace(cost=cost)).cost == max(cost, 0.0)
    assert math.isnan(published(ObjectFit()).cost)
