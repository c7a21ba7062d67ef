"""Which pictures are taken for the light from outside."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.images import write_exr, write_preview_png
from usdbrdf.transport.environment import environment_from_file
from usdbrdf.untrusted import bounds


def _write(path, image):
    """Past our own writer, which would refuse what is not finite."""
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], "float")
    assert output.open(str(path), spec)
    assert output.write_image(image)
    assert output.close()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -0.25])
def test_a_picture_with_what_is_no_light_is_refused(tmp_path, value: float):
    image = np.full((4, 8, 3), 0.5, np.float32)
    image[1, 2, 0] = image[3, 3, 1] = value
    _write(tmp_path / "sky.exr", image)
    with pytest.raises(InputRefused, match=r"2 pixels .*\[shading.environment\]$") as caught:
        environment_from_file(tmp_path / "sky.exr", "Z")
    assert caught.value.exit_code == 3


def test_one_channel_is_grey(tmp_path):
    _write(tmp_path / "sky.exr", np.arange(32, dtype=np.float32).reshape(4, 8, 1))
    found = environment_from_file(tmp_path / "sky.exr", "Y").image
    np.testing.assert_array_equal(found[..., 1].ravel(), np.arange(32))
    np.testing.assert_array_equal(found[..., 0], found[..., 2])


def test_a_picture_is_read_in_a_child_within_limits_and_once_only(tmp_path, monkeypatch):
    write_exr(tmp_path / "sky.exr", np.full((4, 8, 3), 0.625, np.float32))

    def limit(file_bytes: int, seconds: float) -> None:
        monkeypatch.setitem(bounds.LIMITS, "picture", bounds.Limits(file_bytes, seconds, 64 << 30))

    limit(100, 60)
    with pytest.raises(InputRefused, match=r"the limit of a picture is 100.*\[picture.size\]$"):
        environment_from_file(tmp_path / "sky.exr", "Y")
    limit(1 << 20, 0.01)
    with pytest.raises(EnvironmentFailure, match=r"sky.exr.*\[child.timeout\]$"):
        environment_from_file(tmp_path / "sky.exr", "Y")
    limit(1 << 20, 60)
    first = environment_from_file(tmp_path / "sky.exr", "Y").image
    monkeypatch.setattr(bounds, "run_child", lambda *_, **__: pytest.fail("the bytes are known"))
    np.testing.assert_array_equal(environment_from_file(tmp_path / "sky.exr", "Y").image, first)


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
