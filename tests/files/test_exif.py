"""Settings of a camera, from whatever its header tells of them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from usdbrdf.errors import ImageRefused
from usdbrdf.files import exif
from usdbrdf.files.exif import Settings, exif_exposure, exif_exposures, exif_settings

TIME, STOPS, NUMBER, APERTURE = (
    "ExposureTime", "Exif:ShutterSpeedValue", "FNumber", "Exif:ApertureValue",
)  # fmt: skip
SPEED, ISO, INDEX, OUTPUT = (
    "Exif:PhotographicSensitivity", "Exif:ISOSpeed", "Exif:RecommendedExposureIndex",
    "Exif:StandardOutputSensitivity",
)  # fmt: skip


@pytest.fixture
def photographs(monkeypatch):
    """Files by name -> what their headers say; None: cannot be read."""
    written: dict[str, dict[str, object] | None] = {}

    def header_of(path, names):
        said = written[path.name]
        if said is None:
            raise ImageRefused(f"{path}: damaged")
        return [said.get(name) for name in names]

    monkeypatch.setattr(exif, "header_of", header_of)
    return written


@pytest.mark.parametrize(
    ("said", "settings"),
    [
        ({}, (None, None, None)),
        ({TIME: 0.5, NUMBER: 4.0, SPEED: 200}, (0.5, 4.0, 200)),
        # In stops, where numbers are not told or are none.
        ({STOPS: 3.0, APERTURE: 4.0}, (1 / 8, 4.0, None)),
        ({STOPS: -2.0, APERTURE: 5.0}, (4.0, 2**2.5, None)),
        ({TIME: 0.0, STOPS: 3.0, NUMBER: -1.0, APERTURE: 2.0}, (1 / 8, 2.0, None)),
        ({TIME: math.nan, STOPS: math.inf, NUMBER: "4", APERTURE: math.nan}, (None, None, None)),
        ({TIME: True, NUMBER: True, SPEED: True}, (None, None, None)),
        # Zeros of what is not known, and the second that zero stops are where no time is told.
        ({TIME: 0.0, STOPS: 0.0, NUMBER: 0.0, APERTURE: 0.0}, (None, None, None)),
        ({STOPS: 0.0}, (1.0, None, None)),
        ({TIME: 2.0, STOPS: 0.0}, (2.0, None, None)),
        # No camera means these.
        ({STOPS: 63.0, APERTURE: 127.0}, (2.0**-63, 2**63.5, None)),
        ({STOPS: 64.0, APERTURE: 128.0}, (None, None, None)),
        ({STOPS: -64.0}, (None, None, None)),
    ],
)
def test_numbers_come_before_stops(photographs, said, settings):
    photographs["a"] = said
    found = exif_settings(Path("a"))
    assert [one is None for one in found] == [one is None for one in settings]
    for one, other in zip(found, settings, strict=True):
        assert one is None or one == pytest.approx(other)


@pytest.mark.parametrize(
    ("said", "speed"),
    [
        ({SPEED: (400, 0)}, 400),
        ({SPEED: (), ISO: 320}, 320),
        ({SPEED: 0, ISO: 125}, 125),
        ({SPEED: 100, ISO: 125, INDEX: 160, OUTPUT: 200}, 100),
        ({SPEED: 65535, INDEX: 102400, OUTPUT: 51200}, 102400),  # more than two bytes hold
        ({SPEED: 65535, OUTPUT: 80000.0}, 80000),
        ({SPEED: 65535}, None),
        ({SPEED: 65534}, 65534),
    ],
)
def test_the_first_speed_that_can_be_right_counts(photographs, said, speed):
    photographs["a"] = said
    assert exif_settings(Path("a")).speed == speed


@pytest.mark.parametrize(
    ("time", "stops", "open_for"),
    [
        (1 / 30, 5.0, 1 / 32),
        (1 / 125, 7.0, 1 / 128),
        (1 / 60, 5.97, 1 / 64),
        (1 / 20, 4.3219, 1 / 20),  # exact in either
        (1 / 50, 5.65, 2 ** -(17 / 3)),  # a third
        (1 / 45, 5.5, 2**-5.5),  # a half
        (1 / 30, 5.3, 1 / 30),  # one of them is wrong
        (1 / 30, 4.5, 1 / 30),
        (0.0041, 8.0, 1 / 256),
        (4.0, -2.1, 4.0),
    ],
)
def test_names_on_a_dial_are_told_from_times(photographs, time, stops, open_for):
    apart = abs(stops + math.log2(time))
    photographs["a"] = {TIME: time, STOPS: stops}
    if apart >= 0.15 or apart <= 0.005:
        open_for = time
    assert exif_settings(Path("a")).time == pytest.approx(open_for, rel=1e-9)


def test_light_goes_with_time_and_speed_and_with_the_square_of_the_opening():
    assert Settings(0.5, None, None).light == 0.5
    assert Settings(0.5, 4.0, None).light == 0.5 / 16
    assert Settings(0.5, None, 400.0).light == 2.0
    assert Settings(0.25, 2.0, 800.0).light == 0.5
    assert Settings(None, 2.0, 800.0).light is None


def test_several_are_compared_where_all_tell_the_same(photographs):
    photographs |= {
        "a": {TIME: 0.5, NUMBER: 2.0, SPEED: 100},
        "b": {TIME: 0.25, NUMBER: 2.0, SPEED: 400},
        "damaged": None,
        "untold": {},
        "no speed": {TIME: 0.5, NUMBER: 2.0},
        "speed": {SPEED: 100},
        "more speed": {SPEED: 200},
    }

    def of(*names):
        return exif_exposures([Path(name) for name in names])

    assert exif_exposure(Path("a")) == 0.125
    assert of("a", "b", "a") == ([0.125, 0.25, 0.125], True)
    assert of("damaged", "b") == ([0.25, 0.25], True)
    assert of("a", "untold") == (None, True)
    assert of("a", "no speed") == (None, True)
    assert of("untold", "untold") == (None, False)
    assert of("damaged") == (None, False)
    # Without a time there is nothing to compare, though something is told.
    assert of("speed", "more speed") == (None, True)
    assert of() == ([], False)
