"""Which pictures are taken for the light from outside."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.files.images import write_exr, write_preview_png
from usdbrdf.transport.environment import environment_from_file


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -0.25])
def test_a_picture_with_what_is_no_light_is_refused(tmp_path, value: float):
    image = np.full((4, 8, 3), 0.5, np.float32)
    image[1, 2, 0] = image[3, 3, 1] = value
    # Not by our own writer, which takes no such values.
    assert oiio.ImageBuf(image).write(str(tmp_path / "sky.exr"))
    with pytest.raises(InputRefused, match=r"2 pixels .*\[shading.environment\]$") as caught:
        environment_from_file(tmp_path / "sky.exr", "Z")
    assert caught.value.exit_code == 3


def test_an_8_bit_picture_is_refused(tmp_path):
    levels = np.arange(96, dtype=np.uint8).reshape(4, 8, 3)
    write_preview_png(tmp_path / "sky.png", levels)
    with pytest.raises(InputRefused, match=r"8- or 16-bit .*\[shading.environment\]$"):
        environment_from_file(tmp_path / "sky.png", "Z")


@pytest.mark.parametrize("level", [0.0, 1.0, 3.0])
def test_an_even_exr_is_taken_whatever_its_level(tmp_path, level: float):
    write_exr(tmp_path / "sky.exr", np.full((4, 8, 3), level, np.float32))
    found = environment_from_file(tmp_path / "sky.exr", "Z")
    assert found.z_up
    np.testing.assert_array_equal(found.image, np.float32(level))


def test_no_picture_is_black():
    assert not environment_from_file(None, "Y").image.any()
