"""What the page says of a night, of metals and of what is not known, in words."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.page.conftest import data_of, fit_of
from usdbrdf.evaluation.evaluate_views import measured_atlas
from usdbrdf.page.capture import findings
from usdbrdf.page.daylight import is_dark
from usdbrdf.page.objects import _numbers, why
from usdbrdf.page.pictures import status_of
from usdbrdf.transport.environment import NO_SUN, Environment, Sun


def test_the_findings_say_what_is_known_of_the_light_from_outside():
    def told(dark=False, **outside):
        shade = {"escaped_fraction": 0.25, **outside}
        return findings({"texture": {}, "shade": shade}, ["undetermined"], True, dark_outside=dark)[
            -1
        ]

    begins = "25.0% of the directions in which surfaces look leave the scan."
    assert told() == f"{begins} What is out there counts as dark."
    found = {
        "source": "estimated",
        "sky_error": 0.52,
        "sun_error": 0.11,
        "sun_direction": [0, 0, 1],
    }
    estimated = "The light from there was estimated: sky to \u00b1 52%, sun to \u00b1 11%."
    assert told(outside=found) == f"{begins} {estimated}"
    seen = {"source": "estimated"}
    assert (
        told(outside=seen) == f"{begins} The light from there is known: sky as photographs show it."
    )
    assert told(dark=True, outside=seen) == (
        f"{begins} It is dark out there, as by night: next to no light comes in."
    )
    given = {"source": "given", "sky_error": 0.0}
    assert told(outside=given) == f"{begins} A file told the light from there: sky."


def test_a_night_is_dark_though_photographs_show_a_little_of_it(room):
    _, atlas = measured_atlas(room.asset)
    usual = float(np.median(atlas.irradiance))

    def sky(radiance, sun=NO_SUN):
        image = np.full((8, 16, 3), radiance, np.float32)
        return Environment(image, True).under(sun)

    assert is_dark(sky(0), atlas)
    assert is_dark(sky(1e-4 * usual), atlas)
    assert not is_dark(sky(0.1 * usual), atlas)
    sun = Sun(np.array([0.0, 0.0, 1.0]), np.ones(3), 0.00465)
    assert not is_dark(sky(0, sun), atlas)


def test_metals_and_parts_that_shine_are_named():
    steps = {"texture": {}, "shade": {}}
    (said,) = findings(steps, ["measured"], True, metals=["tap"])[1:]
    assert said == "1 is a metal: tap."
    (said,) = findings(steps, ["measured"] * 2, True, metals=["tap", "pan"])[1:]
    assert said == "2 are metals: tap, pan."
    (said,) = findings(steps, ["measured"], True, (), ["table"])[1:]
    assert said == "A part of table shines, too."


@pytest.mark.parametrize(
    ("numbers", "in_sight", "because"),
    [
        ({"status": "measured"}, True, "measured"),
        ({}, True, "undetermined"),
        ({"model": "transparent"}, True, "pane"),
        ({"contradiction": 0.45}, True, "contradicted"),
        ({"evidence": math.nan}, True, "sparse"),
        ({"directive": "ignore"}, True, "told"),
        ({"status": "unseen"}, True, "glimpsed"),
        ({"status": "unseen"}, False, "unseen"),
    ],
)
def test_the_table_says_of_an_object_why_it_is_not_known(room, numbers, in_sight, because):
    _, atlas = measured_atlas(room.asset)
    known = [status_of(atlas, i, None) for i in range(len(atlas.scene.objects))]
    index = known.index("unseen")
    fit = fit_of(**numbers)
    row = _numbers(atlas, index, atlas.scene.objects[index], fit, in_sight)
    assert (row["status"], row["because"]) == (fit.status, because)
    lamp = known.index("lamp")
    row = _numbers(atlas, lamp, atlas.scene.objects[lamp], fit, in_sight)
    assert row["status"] == row["because"] == "lamp"


def test_the_page_carries_these_words(page_file):
    rows = data_of(page_file.read_text("utf-8"))["objects"]
    assert {row["because"] for row in rows} >= {"lamp"}


def test_what_is_bounded_is_told_as_weak_highlights():
    """Whoever judges knows no bound of psi by heart: below what is usual is what it says."""
    assert findings({"texture": {}, "shade": {}}, ["bounded"], True)[1].startswith(
        "1 is bounded: photographs do not determine both numbers, but tell that highlights are "
        "weaker than usual, if there are any."
    )
    fit = fit_of(status="bounded", evidence=0.0, psi_upper=0.117)
    assert why(fit, "bounded", None).endswith(
        "Its highlights, if it has any, are weaker than usual: psi is below 0.12 with 95 %."
    )
    known = fit_of(status="undetermined", evidence=0.0, psi_upper=0.9)
    assert why(known, "undetermined", None).endswith("determined. psi is below 0.90 with 95 %.")
