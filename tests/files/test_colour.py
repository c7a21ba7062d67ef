"""Colour conversions against the published formulas."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files import colour
from usdbrdf.files.colour import (
    encoding_of_tag,
    kind_of_encoding,
    known_encodings,
    to_display_srgb8,
    to_working_space,
    unknown_encoding,
)


def srgb_from_linear(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.fixture
def ramp():
    return np.linspace(0, 1, 3 * 4096, dtype=np.float32).reshape(64, 64, 3)


def test_working_space_is_copied_unchanged(ramp):
    ramp[0, 0] = (-1, 1e5, np.nan)
    ramp.setflags(write=False)
    copy = to_working_space(ramp, "lin_rec709_scene")
    assert np.array_equal(copy, ramp, equal_nan=True)
    assert not np.shares_memory(copy, ramp)


def test_srgb_is_decoded(ramp):
    encoded = srgb_from_linear(ramp.astype(np.float64)).astype(np.float32)
    assert np.allclose(to_working_space(encoded, "srgb_rec709_scene"), ramp, atol=2e-6)


def test_acescg_white_and_red():
    white_and_red = np.array([[[1, 1, 1], [0.61309741, 0.07019372, 0.02061559]]], np.float32)
    expected = [[[1, 1, 1], [1, 0, 0]]]
    assert np.allclose(to_working_space(white_and_red, "lin_ap1_scene"), expected, atol=2e-5)


@pytest.mark.parametrize("encoding", known_encodings())
def test_white_stays_white(encoding):
    white = np.ones((2, 2, 3), np.float32)
    assert np.allclose(to_working_space(white, encoding), 1, atol=1e-4)


def test_non_contiguous_pixels(ramp):
    assert np.array_equal(
        to_working_space(ramp[::2, ::-1], "lin_ap1_scene"),
        to_working_space(ramp, "lin_ap1_scene")[::2, ::-1],
    )


def test_unknown_encoding_names_the_known():
    with pytest.raises(
        InputRefused, match=r"'AdobeRGB 7'.+lin_rec709_scene.+\[colour\.encoding\]$"
    ):
        to_working_space(np.zeros((1, 1, 3), np.float32), "AdobeRGB 7")


def test_wrong_shape():
    with pytest.raises(UsdBrdfError, match=r"pixels\.shape=\(4, 3\)"):
        to_working_space(np.zeros((4, 3), np.float32), "lin_ap1_scene")


def test_display_bytes(ramp):
    exact = 255 * srgb_from_linear(np.clip(ramp.astype(np.float64) * 2, 0, 1))
    assert np.abs(to_display_srgb8(ramp, exposure_scale=2) - exact).max() < 0.51


def test_display_of_what_is_no_number(ramp):
    ramp[0, 0] = (0.5, np.nan, 0.5)
    ramp[0, 1] = (np.inf, -np.inf, -3)
    shown = to_display_srgb8(ramp, exposure_scale=1)
    assert shown[0, :2].tolist() == [[255, 0, 255], [255, 0, 0]]


def test_older_opencolorio_has_the_newest_config_of_its_own():
    names = ["studio-config-v2.1.0_aces-v1.3", "studio-config-v10.0.0_x", "cg-config-v11"]
    assert colour._pick_config(names) == "studio-config-v10.0.0_x"
    assert colour._pick_config([*names, colour._CONFIG]) == colour._CONFIG


def _logc4(linear):
    """ARRI, LogC4 Specification (2022), 2.2."""
    a, b, c = (2**18 - 16) / 117.45, (1023 - 95) / 1023, 95 / 1023
    return (np.log2(a * linear + 64) - 6) / 14 * b + c


def _slog3(linear):
    """Sony, Technical Summary for S-Gamut3.Cine/S-Log3 (2014), above its linear part."""
    return (420 + np.log10((linear + 0.01) / (0.18 + 0.01)) * 261.5) / 1023


def _acescct(linear):
    """Academy S-2016-001, above its linear part."""
    return (np.log2(linear) + 9.72) / 17.52


@pytest.mark.parametrize(
    ("name", "encoded"),
    [
        ("ARRI LogC4", _logc4),
        ("arri_logc4", _logc4),
        ("S-Log3 S-Gamut3.Cine", _slog3),
        ("ACEScct", _acescct),
    ],
)
def test_logarithms_of_cameras_are_decoded(name, encoded):
    grey = np.array([0.02, 0.18, 0.9, 4.0, 20.0])
    stored = np.repeat(encoded(grey)[None, :, None], 3, axis=2).astype(np.float32)
    assert kind_of_encoding(name) == "log"
    # Grey is grey in every primaries whose white is the same after adaptation.
    assert np.allclose(to_working_space(stored, name)[0, :, 1], grey, rtol=2e-3)


def test_photographs_of_a_wider_display():
    assert kind_of_encoding("srgb_p3d65_scene") == "display"
    encoded = srgb_from_linear(np.array([[[0.5, 0.2, 0.1]]])).astype(np.float32)
    as_linear = to_working_space(np.array([[[0.5, 0.2, 0.1]]], np.float32), "lin_p3d65_scene")
    assert np.allclose(to_working_space(encoded, "srgb_p3d65_scene"), as_linear, atol=1e-5)


def test_a_name_that_is_nearly_right_is_told():
    assert kind_of_encoding("ARRI LogC5") is None
    assert "'ARRI LogC4'" in unknown_encoding("ARRI LogC5")
    assert kind_of_encoding("Raw") is None
    assert kind_of_encoding("sRGB - Display") is None


# x, y of red, green, blue and white, from the standards' texts: IEC 61966-2-1 and ITU-R BT.709,
# SMPTE EG 432-1, ITU-R BT.2020, SMPTE ST 2065-1, Academy S-2014-004, Adobe RGB (1998).
D65, ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)
PRIMARIES = {
    "lin_rec709_scene": (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, *D65),
    "lin_p3d65_scene": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),
    "lin_rec2020_scene": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *ACES_WHITE),
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *ACES_WHITE),
    "lin_adobergb_scene": (0.640, 0.330, 0.210, 0.710, 0.150, 0.060, *D65),
}


@pytest.mark.parametrize("encoding", PRIMARIES)
def test_primaries_name_their_space_if_all_are_right_to_two_thousandths(encoding):
    places = np.array(PRIMARIES[encoding])
    assert encoding_of_tag("", tuple(places)) == encoding
    for k in range(8):
        for off, found in ((0.0019, encoding), (-0.0019, encoding), (0.0021, None)):
            near = places.copy()
            near[k] += off
            assert encoding_of_tag("", tuple(near)) == found
    assert encoding_of_tag("", ()) is None
