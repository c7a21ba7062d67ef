"""Images arrive whole or not at all, and leave with the same bytes every time."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.fault_injection import run_watched
from usdbrdf.errors import EnvironmentFailure, ImageRefused, UsdBrdfError
from usdbrdf.files import images
from usdbrdf.files.images import (
    _check_limits,
    encoded_jpeg,
    image_size,
    kind_of_colours,
    read_exr,
    read_radiance,
    resized,
    write_exr,
    write_preview_png,
)
from usdbrdf.files.scratch import PREFIX


@pytest.fixture
def radiance():
    return np.random.default_rng(1).random((24, 40, 3)).astype(np.float32) * 100


def write_with_oiio(path, pixels, names, form="float", window=None, compression="zip"):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(names), form)
    spec.channelnames = names
    spec.attribute("compression", compression)
    if window is not None:
        spec.x, spec.y, spec.full_width, spec.full_height = window
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels)
    output.close()


# ---- writing ----


@pytest.mark.parametrize(("channels", "names"), [(1, "Y"), (3, "RGB"), (4, "RGBA")])
@pytest.mark.parametrize("half", [True, False])
def test_exr_round_trip(tmp_path, channels, names, half):
    pixels = np.random.default_rng(2).normal(0, 50, (5, 7, channels)).astype(np.float32)
    path = tmp_path / "é [1].exr"
    assert write_exr(path, pixels, half=half) == 0
    expected = pixels.astype(np.float16).astype(np.float32) if half else pixels
    assert np.array_equal(read_exr(path), expected)
    assert image_size(path) == (7, 5, tuple(names))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_single_channel_without_channel_axis(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((2, 3), np.float32))
    assert read_exr(tmp_path / "a.exr").shape == (2, 3, 1)


def test_equal_pixels_give_equal_bytes(tmp_path, radiance):
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, radiance)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    assert b"2000:01:01" in (tmp_path / "a.exr").read_bytes()
    assert b"lin_rec709_scene" in (tmp_path / "a.exr").read_bytes()


@pytest.mark.parametrize("channels", [1, 3])
def test_at_another_size_a_pixel_is_the_mean_of_what_it_covers(channels):
    pixels = np.random.default_rng(3).random((4, 9, channels)).astype(np.float32)
    found = resized(pixels, 3, 2)
    assert found.dtype == np.float32
    blocks = pixels.reshape(2, 2, 3, 3, channels).mean(axis=(1, 3))
    np.testing.assert_allclose(found, blocks, rtol=1e-5)
    larger = resized(pixels[::2, ::3], 6, 4)
    np.testing.assert_allclose(larger, pixels[::2, ::3].repeat(2, axis=0).repeat(2, axis=1))


@pytest.mark.fault("I14")
def test_half_floats_are_clamped_and_counted(tmp_path):
    pixels = np.array([[[65504, 65505, -1e30], [0, 1, 2]]], np.float32)
    assert write_exr(tmp_path / "a.exr", pixels) == 2
    assert read_exr(tmp_path / "a.exr")[0, 0].tolist() == [65504, 65504, -65504]
    assert write_exr(tmp_path / "b.exr", pixels, half=False) == 0
    assert np.array_equal(read_exr(tmp_path / "b.exr"), pixels)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_output_is_our_bug(tmp_path, value):
    pixels = np.zeros((4, 4, 3), np.float32)
    pixels[1, 2, 0] = value
    with pytest.raises(UsdBrdfError, match=r"1 values .+not finite") as caught:
        write_exr(tmp_path / "a.exr", pixels)
    assert type(caught.value) is UsdBrdfError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shape", [(4,), (4, 4, 2), (0, 4, 3), (2, 4, 4, 3)])
def test_wrong_shape_is_our_bug(tmp_path, shape):
    with pytest.raises(UsdBrdfError, match=r"is not \(H, W"):
        write_exr(tmp_path / "a.exr", np.zeros(shape, np.float32))


@pytest.mark.fault("R1")
def test_full_disk_keeps_the_old_file(tmp_path, monkeypatch, radiance):
    path = tmp_path / "a.exr"
    write_exr(path, radiance)
    before = path.read_bytes()

    create = oiio.ImageOutput.create

    class FullDisk:
        """Fails as OpenImageIO does: write_image says False, close says True."""

        def __init__(self, name):
            self.output = create(name)

        def open(self, name, spec):
            return self.output.open(name, spec)

        def write_image(self, pixels):
            return False

        def close(self):
            return self.output.close() or True

        def geterror(self):
            return "Failed pwrite\nof header"

    class ImageOutput:
        create = FullDisk

    monkeypatch.setattr(images.oiio, "ImageOutput", ImageOutput)
    expected = r"cannot be written \(Failed pwrite of header\).+\[image\.write\]$"
    with pytest.raises(EnvironmentFailure, match=expected):
        write_exr(path, radiance + 1)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.fault("R1")
def test_really_full_disk_keeps_the_old_file(tmp_path, radiance):
    """A limit on the file size fails in write() as a full disk does."""
    code = """
import resource, sys
from pathlib import Path
import numpy as np
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.images import write_exr
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
try:
    write_exr(Path(sys.argv[1]), np.random.default_rng(0).random((64, 64, 3)).astype(np.float32))
except EnvironmentFailure as error:
    print(error)
"""
    path = tmp_path / "a.exr"
    write_exr(path, radiance)
    before = path.read_bytes()
    search = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    said = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        env={**os.environ, "PYTHONPATH": search},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert said.stdout.endswith("[image.write]\n"), said.stderr
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.fault("I12")
def test_exr_whose_header_lies_about_its_size(tmp_path, radiance):
    path = tmp_path / "a.exr"
    write_exr(path, radiance)
    window = struct.pack("<iiii", 0, 0, 39, 23)
    for side in (14_000, 60_000, 1 << 30):
        huge = struct.pack("<iiii", 0, 0, side - 1, side - 1)
        (tmp_path / "b.exr").write_bytes(path.read_bytes().replace(window, huge))
        with pytest.raises(ImageRefused):
            read_radiance(tmp_path / "b.exr")


def test_folder_that_is_not_there(tmp_path, radiance):
    with pytest.raises(EnvironmentFailure, match=r"cannot be written.+\[image\.write\]$"):
        write_exr(tmp_path / "none/a.exr", radiance)


@pytest.mark.fault("R1")
def test_a_file_that_does_not_read_back_is_not_published(tmp_path, monkeypatch, radiance):
    """A disk that loses what it said it wrote."""
    path = tmp_path / "a.exr"
    write_exr(path, radiance)
    before, write = path.read_bytes(), images.write_image

    def losing(path, staged, spec, pixels):
        pixels = np.array(pixels)
        pixels[-1, -1, -1] += 1
        write(path, staged, spec, pixels)

    monkeypatch.setattr(images, "write_image", losing)
    with pytest.raises(EnvironmentFailure, match=r"does not read back.+\[image\.write\]$"):
        write_exr(path, radiance + 1)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.fault("R1")
@pytest.mark.parametrize("suffix", [".jpg", ".JPEG"])
def test_a_picture_for_people_may_be_a_jpeg_that_is_written_whole(tmp_path, monkeypatch, suffix):
    """Its pixels are others than those that were written, and were taken for a disk's failure."""
    path = tmp_path / f"a{suffix}"
    rgb8 = np.random.default_rng(0).integers(0, 256, (24, 32, 1), np.uint8).repeat(3, axis=2)
    write_preview_png(path, rgb8)
    assert np.abs(read_radiance(path) * 255 - rgb8).mean() < 3
    before, write = path.read_bytes(), images.write_image

    def losing(path, staged, spec, pixels, lost):
        write(path, staged, spec, pixels)
        if staged.parent == tmp_path or lost == "end":
            content = staged.read_bytes()
            staged.write_bytes(content[:-9] if lost == "end" else content[:400] + content[500:])

    for lost in ("middle", "end"):
        monkeypatch.setattr(images, "write_image", partial(losing, lost=lost))
        with pytest.raises(EnvironmentFailure, match=r"does not read back.+\[image\.write\]$"):
            write_preview_png(path, rgb8)
    assert path.read_bytes() == before
    assert [*tmp_path.iterdir()] == [path]


def test_preview(tmp_path, radiance):
    rgb8 = np.arange(5 * 6 * 3, dtype=np.uint8).reshape(5, 6, 3)
    for name in ("a.png", "b.png"):
        write_preview_png(tmp_path / name, rgb8)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert np.array_equal(np.rint(read_radiance(tmp_path / "a.png") * 255), rgb8)
    with pytest.raises(UsdBrdfError, match="uint8"):
        write_preview_png(tmp_path / "c.png", radiance)


# ---- reading ----


def test_nan_and_infinity_come_as_they_are(tmp_path, radiance):
    radiance[0, 0] = (np.nan, np.inf, -np.inf)
    write_with_oiio(tmp_path / "a.exr", radiance, ("R", "G", "B"))
    assert np.array_equal(read_radiance(tmp_path / "a.exr"), radiance, equal_nan=True)


@pytest.mark.fault("I8")
def test_channels_are_chosen_by_name(tmp_path):
    names = ("Z", "albedo.R", "B", "A", "G", "R")
    pixels = np.tile(np.arange(6, dtype=np.float32), (3, 4, 1))
    write_with_oiio(tmp_path / "a.exr", pixels, names)
    assert read_radiance(tmp_path / "a.exr")[0, 0].tolist() == [5, 4, 2]
    assert read_radiance(tmp_path / "a.exr").flags["C_CONTIGUOUS"]


@pytest.mark.fault("I8")
@pytest.mark.parametrize("names", [("Y",), ("U", "V"), ("R", "G"), ("a.R", "b.G", "a.B", "a.A")])
def test_wrong_channels_are_listed(tmp_path, names):
    write_with_oiio(tmp_path / "a.exr", np.ones((3, 4, len(names)), np.float32), names)
    with pytest.raises(ImageRefused, match=r"no channels R, G and B among .+\[image\.channels\]$"):
        read_radiance(tmp_path / "a.exr")


def _layer(name, letters="RGBA"):
    return tuple(f"{name}.{letter}" for letter in letters)


@pytest.mark.fault("I8")
@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (_layer("beauty", "RGB"), [0, 1, 2]),
        # As Blender writes them, and Nuke.
        ((*_layer("ViewLayer.Combined"), "ViewLayer.Depth.Z", *_layer("ViewLayer.Normal", "XYZ")),
         [0, 1, 2, 3]),
        ((*_layer("ViewLayer.DiffDir", "RGB"), *_layer("ViewLayer.Combined")), [3, 4, 5, 6]),
        (("beauty.blue", "beauty.green", "beauty.red", "depth.Z"), [2, 1, 0]),
        ((*_layer("albedo", "RGB"), *_layer("RGBA", "rgb")), [3, 4, 5]),
        ((*_layer("beauty"), "R", "G", "B"), [4, 5, 6]),
        ((*_layer("normal", "RGB"), *_layer("color", "RGB"), *_layer("CryptoObject00")), [3, 4, 5]),
        ((*_layer("P", "RGB"), *_layer("camera1")), [3, 4, 5, 6]),
    ],
)  # fmt: skip
def test_of_layers_that_of_the_whole_picture_is_read(tmp_path, names, chosen):
    pixels = np.tile(np.arange(len(names), dtype=np.float32), (3, 4, 1))
    write_with_oiio(tmp_path / "a.exr", pixels, names)
    assert read_radiance(tmp_path / "a.exr", alpha=True)[0, 0].tolist() == chosen


@pytest.mark.fault("I8")
@pytest.mark.parametrize(
    "names",
    [
        (*_layer("diffuse", "RGB"), *_layer("specular", "RGB")),
        (*_layer("Left.Combined", "RGB"), *_layer("Right.Combined", "RGB")),
        (*_layer("cam1", "RGB"), *_layer("cam2", "RGB")),
        (*_layer("normal", "RGB"), *_layer("wetness", "RGB")),
        (*_layer("image", "RGB"), *_layer("wetness", "RGB")),
    ],
)
def test_layers_of_which_none_is_the_whole_picture_are_listed(tmp_path, names):
    write_with_oiio(tmp_path / "a.exr", np.ones((3, 4, 6), np.float32), names)
    layers = f"{names[0][:-2]!r}, {names[3][:-2]!r}"
    said = rf"2 layers have R, G and B \({layers}\), .* beauty or Combined\. Export .*channels\]$"
    with pytest.raises(ImageRefused, match=said):
        read_radiance(tmp_path / "a.exr")


@pytest.mark.fault("I8")
@pytest.mark.parametrize(
    "layer",
    ["normal", "N", "albedo", "Position", "uv", "ViewLayer.Denoising Normal", "crypto_object00"],
)
def test_an_only_layer_that_is_no_picture_is_refused(tmp_path, layer):
    write_with_oiio(tmp_path / "a.exr", np.ones((3, 4, 3), np.float32), _layer(layer, "RGB"))
    said = rf"1 layer has R, G and B \({layer!r}\), .* Export .*channels\]$"
    with pytest.raises(ImageRefused, match=said):
        read_radiance(tmp_path / "a.exr")
    write_with_oiio(tmp_path / "a.exr", np.ones((3, 4, 3), np.float32), _layer("camera1", "RGB"))
    assert read_radiance(tmp_path / "a.exr").shape == (3, 4, 3)


@pytest.mark.fault("I8")
def test_layers_may_be_parts_of_the_file(tmp_path, radiance):
    path, names = tmp_path / "a.exr", (_layer("diffuse", "RGB"), _layer("beauty", "RGB"))
    _two_parts(path, radiance + 1, radiance, names)
    assert np.array_equal(read_radiance(path), radiance.astype(np.float16))
    assert image_size(path) == (40, 24, names[1])
    _two_parts(path, radiance, radiance + 1, (names[0], _layer("gloss", "RGB")))
    with pytest.raises(ImageRefused, match=r"2 layers have R, G and B \('diffuse', 'gloss'\)"):
        read_radiance(path)


@pytest.mark.fault("I8")
def test_a_part_that_is_called_as_no_picture_is_none_whatever_its_channels(tmp_path, radiance):
    path, letters = tmp_path / "a.exr", ("R", "G", "B")
    for other in ("rgba", "camera1"):
        _two_parts(path, radiance + 1, radiance, (letters, letters), ("normal", other))
        assert np.array_equal(read_radiance(path), radiance.astype(np.float16))
        assert kind_of_colours(path) == 2
    _two_parts(path, radiance, radiance, (letters, letters), ("normal", "albedo"))
    with pytest.raises(ImageRefused, match=r"2 layers have R, G and B \('normal', 'albedo'\)"):
        read_radiance(path)
    assert kind_of_colours(path) == 0


@pytest.mark.fault("I9")
def test_data_window_is_placed_in_the_display_window(tmp_path):
    pixels = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    write_with_oiio(tmp_path / "a.exr", pixels, ("R", "G", "B"), window=(6, -1, 8, 4))
    image = read_radiance(tmp_path / "a.exr")
    expected = np.full((4, 8, 3), np.nan, np.float32)
    expected[0, 6:] = pixels[1, :2]
    assert np.array_equal(image, expected, equal_nan=True)
    assert image_size(tmp_path / "a.exr")[:2] == (8, 4)


@pytest.mark.fault("I9")
def test_data_window_larger_than_the_display_window(tmp_path):
    pixels = np.arange(6 * 7 * 3, dtype=np.float32).reshape(6, 7, 3)
    write_with_oiio(tmp_path / "a.exr", pixels, ("R", "G", "B"), window=(-2, -1, 4, 3))
    assert np.array_equal(read_radiance(tmp_path / "a.exr"), pixels[1:4, 2:6])


@pytest.mark.fault("I9")
def test_data_window_beside_the_display_window(tmp_path):
    pixels = np.ones((2, 2, 3), np.float32)
    for window in ((-9, 0, 4, 3), (0, 50, 4, 3)):
        write_with_oiio(tmp_path / "a.exr", pixels, ("R", "G", "B"), window=window)
        assert np.isnan(read_radiance(tmp_path / "a.exr")).all()


@pytest.mark.fault("I1")
@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".tif", ".png", ".jpg"])
@pytest.mark.parametrize("fraction", [0.0, 0.02, 0.3, 0.5, 0.9, 0.99])
def test_truncated_file_is_refused(tmp_path, radiance, suffix, fraction, capfd):
    form = "float" if suffix in (".exr", ".hdr", ".tif") else "uint8"
    whole, cut = tmp_path / f"whole{suffix}", tmp_path / f"cut{suffix}"
    write_with_oiio(whole, radiance / 100, ("R", "G", "B"), form)
    read_radiance(whole)
    cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * fraction)])
    with pytest.raises(ImageRefused, match=r"^.+ \[image\.(truncated|unreadable)\]$"):
        read_radiance(cut)


@pytest.mark.fault("I1")
@pytest.mark.parametrize("length", [3, 100, -1])
@pytest.mark.parametrize("compression", ["none", "zip", "piz", "dwaa"])
def test_exr_truncated_anywhere(tmp_path, radiance, compression, length):
    path = tmp_path / "a.exr"
    write_with_oiio(path, radiance, ("R", "G", "B"), "half", compression=compression)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(ImageRefused):
        read_radiance(path)


def _two_parts(path, first, second, names, parts=("part 0", "part 1")):
    """A multi-part EXR: each part one picture with channels of these names."""
    specs = []
    for pixels, channels in zip((first, second), names, strict=True):
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "half")
        spec.channelnames = channels
        spec.attribute("compression", "zip")
        spec.attribute("oiio:subimagename", parts[len(specs)])
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs))
    assert output.write_image(first)
    assert output.open(str(path), specs[1], "AppendSubimage")
    assert output.write_image(second)
    assert output.close()


@pytest.mark.fault("I8")
@pytest.mark.fault("I11")
def test_the_part_with_red_green_and_blue_is_read_wherever_it_stands(tmp_path, radiance):
    path, depth = tmp_path / "a.exr", np.ones((24, 40, 1), np.float32)
    _two_parts(path, depth, radiance, (("Z",), ("R", "G", "B")))
    assert np.array_equal(read_radiance(path), radiance.astype(np.float16))
    assert image_size(path) == (40, 24, ("R", "G", "B"))
    _two_parts(path, depth, radiance, (("Z",), ("N.X", "N.Y", "N.Z")))
    with pytest.raises(ImageRefused, match=r"no channels R, G and B among 'Z'"):
        read_radiance(path)


@pytest.mark.fault("I11")
@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_an_unfinished_part_is_refused_or_was_not_needed(tmp_path, radiance, share):
    """Never zeros, and never another part's pixels."""
    path = tmp_path / "a.exr"
    for names in ((("R", "G", "B"), ("x", "y", "z")), (("x", "y", "z"), ("R", "G", "B"))):
        _two_parts(path, radiance, radiance + 1, names)
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        try:
            found = read_radiance(path)
        except ImageRefused:
            continue
        assert names[0][0] == "R", "the part lies at the end of the file"
        assert np.array_equal(found, radiance.astype(np.float16))


def test_jpeg_with_a_thumbnail_and_a_tail(tmp_path, radiance):
    path = tmp_path / "a.jpg"
    write_with_oiio(path, radiance / 100, ("R", "G", "B"), "uint8")
    plain = path.read_bytes()
    thumbnail = b"\xff\xe5" + struct.pack(">H", 2 + 6) + b"\xff\xd8\xff\xd9ab"
    path.write_bytes(plain[:2] + thumbnail + plain[2:] + b"movie" * 2000)
    read_radiance(path)
    path.write_bytes((plain[:2] + thumbnail + plain[2:])[:-10])
    with pytest.raises(ImageRefused, match=r"no end-of-image mark"):
        read_radiance(path)


@pytest.mark.fault("I2")
def test_damaged_bytes_give_pixels_or_a_refusal(tmp_path, radiance):
    """A window of random bytes slides over the file; nothing else may ever come out."""
    path = tmp_path / "a.exr"
    write_exr(path, radiance)
    whole = path.read_bytes()
    generator = np.random.default_rng(3)
    refused = 0
    for _ in range(300):
        content = bytearray(whole)
        limit = len(whole) if generator.random() < 0.5 else 400
        start, length = int(generator.integers(limit)), int(generator.integers(1, 40))
        content[start : start + length] = generator.bytes(len(content[start : start + length]))
        path.write_bytes(content)
        try:
            pixels = read_radiance(path)
        except ImageRefused:
            refused += 1
        else:
            assert pixels.dtype == np.float32
            assert pixels.shape[2] == 3
    assert refused > 100


@pytest.mark.fault("I13")
def test_what_is_not_a_regular_file(tmp_path):
    os.mkfifo(tmp_path / "fifo.exr")
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "text.exr").write_text("not an image")
    (tmp_path / "dangling.exr").symlink_to("none")
    names = ("fifo", "folder", "text", "dangling", "none", "x" * 300, "a\0b", "\udcff", "\ud800")
    for name in names:
        with pytest.raises(ImageRefused, match=r"\[image\.unreadable\]$"):
            read_radiance(tmp_path / f"{name}.exr")


def test_a_name_that_is_not_utf8_is_refused_though_the_file_is_there(tmp_path, radiance):
    write_exr(tmp_path / "a.exr", radiance)
    path = (tmp_path / "a.exr").rename(tmp_path / os.fsdecode(b"\xff.exr"))
    for read in (read_radiance, read_exr, image_size):
        with pytest.raises(ImageRefused, match=r"\[image\.unreadable\]$"):
            read(path)


@pytest.mark.parametrize("suffix", [".dng", ".CR2", ".nef"])
def test_camera_raw_is_refused_by_name(tmp_path, radiance, suffix):
    write_with_oiio(tmp_path / "a.tif", radiance, ("R", "G", "B"))
    path = (tmp_path / "a.tif").rename(tmp_path / f"a{suffix}")
    with pytest.raises(ImageRefused, match=r"camera raw.+\[image\.raw\]$"):
        read_radiance(path)


def test_other_formats_are_refused_by_content(tmp_path, radiance):
    write_with_oiio(tmp_path / "a.bmp", radiance / 100, ("R", "G", "B"), "uint8")
    path = (tmp_path / "a.bmp").rename(tmp_path / "a.exr")
    with pytest.raises(ImageRefused, match=r"bmp images are not read.+\[image\.format\]$"):
        read_radiance(path)


def test_alpha_does_not_darken(tmp_path):
    pixels = np.tile(np.array([1, 0.6, 0.2, 0.5], np.float32), (3, 4, 1))
    path = tmp_path / "a.png"
    spec = oiio.ImageSpec(4, 3, 4, "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), spec)
    output.write_image(pixels)
    output.close()
    assert np.allclose(read_radiance(path), pixels[..., :3], atol=1 / 255)


@pytest.mark.fault("I12")
def test_limits(tmp_path, radiance):
    write_exr(tmp_path / "a.exr", radiance)
    read_radiance(tmp_path / "a.exr", max_side=40)
    with pytest.raises(ImageRefused, match=r"40 x 24 pixels.+\[image\.limits\]$"):
        read_radiance(tmp_path / "a.exr", max_side=39)
    names = tuple(f"c{i:02}" for i in range(65))
    write_with_oiio(tmp_path / "b.exr", np.ones((2, 2, 65), np.float32), names)
    with pytest.raises(ImageRefused, match="65 channels"):
        read_exr(tmp_path / "b.exr")


@pytest.mark.fault("I12")
def test_what_is_made_is_limited_not_what_is_stored(tmp_path, radiance):
    """373 bytes with one pixel in a display window of 16384 x 4096 would be made 768 MiB."""
    path = tmp_path / "a.exr"
    write_with_oiio(path, radiance[:1, :1], ("R", "G", "B"), "half", window=(0, 0, 16384, 4096))
    assert path.stat().st_size < 500
    for read in (read_radiance, read_exr, image_size):
        with pytest.raises(ImageRefused, match=r"1 x 1 .* 16384 x 4096.*\[image\.limits\]$"):
            read(path)
    # A crop of a usual picture stays what it is.
    write_with_oiio(path, radiance, ("R", "G", "B"), "half", window=(99, 50, 1920, 1080))
    image = read_radiance(path)
    assert image.shape == (1080, 1920, 3)
    assert np.isfinite(image).all(axis=2).sum() == 24 * 40


def test_too_little_memory_is_the_machine_s_fault(tmp_path):
    """At whatever point it runs out, and however the decoder puts it."""
    code = """
import resource, sys
from pathlib import Path
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.images import read_radiance
path = Path(sys.argv[1])
read_radiance(path)
size = int(next(row for row in open("/proc/self/statm")).split()[0]) * resource.getpagesize()
for more in (1, 16, 40, 64, 96, 110, 128):
    resource.setrlimit(resource.RLIMIT_AS, (size + (more << 20), resource.RLIM_INFINITY))
    try:
        kept = read_radiance(path)
        said = "read"
    except EnvironmentFailure as error:
        said = str(error)
    print(more, said)
"""
    path = tmp_path / "a.exr"
    write_exr(path, np.random.default_rng(0).random((3000, 3000, 3)).astype(np.float32))
    search = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    said = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        env={**os.environ, "PYTHONPATH": search},
        capture_output=True,
        text=True,
        check=False,
    )
    rows = said.stdout.splitlines()
    assert len(rows) == 7, said.stderr
    told = [row for row in rows if row.endswith("[environment.memory]")]
    assert len(told) >= 5, rows  # what was freed before may serve for the last ones
    assert all(row.endswith((" read", "[environment.memory]")) for row in rows), rows


@pytest.mark.fault("I2")
@pytest.mark.parametrize("error", [SystemError, RuntimeError, IndexError, UnicodeDecodeError])
def test_whatever_the_decoder_raises_is_a_refusal(tmp_path, monkeypatch, radiance, error):
    """Damaged PIZ blocks have been seen to raise a SystemError."""
    write_exr(tmp_path / "a.exr", radiance)
    source = images.open_image(tmp_path / "a.exr")

    class Stumbling:
        def __getattr__(self, name):
            return getattr(source, name)

        def read_image(self, *_):
            raise error(*(("utf-8", b"", 0, 1, "x") if error is UnicodeDecodeError else ("boom",)))

    monkeypatch.setattr(images, "open_image", lambda path, max_side: Stumbling())
    with pytest.raises(ImageRefused, match=r"truncated or damaged.*\[image\.truncated\]$"):
        read_radiance(tmp_path / "a.exr")


@pytest.mark.fault("I2")
@pytest.mark.parametrize("compression", ["none", "zip", "piz", "dwaa", "b44"])
def test_six_damaged_bytes_give_pixels_or_a_refusal(tmp_path, radiance, compression):
    path = tmp_path / "a.exr"
    write_with_oiio(path, radiance, ("R", "G", "B"), "half", compression=compression)
    whole = path.read_bytes()
    generator = np.random.default_rng(4)
    refused = 0
    for _ in range(200):
        content = bytearray(whole)
        for place in generator.integers(len(whole), size=6):
            content[place] = generator.integers(256)
        path.write_bytes(content)
        try:
            assert read_radiance(path).shape[2] == 3
        except ImageRefused:
            refused += 1
    assert refused > (20 if compression != "none" else 0), "a byte of the header at least"


@pytest.mark.fault("I12")
@pytest.mark.parametrize(("height", "limited"), [(5000, False), (6500, True)])
def test_from_a_gibibyte_on_no_byte_may_stand_for_ten_thousand(tmp_path, height, limited):
    """12 bytes a pixel, 16384 a row: 5461 rows are one."""
    spec, most = oiio.ImageSpec(16384, height, 3, "float"), 10_000
    spec.full_width, spec.full_height = spec.width, spec.height
    declared = 12 * spec.width * height
    _check_limits(tmp_path / "a.exr", spec, declared // (most - 1), 65_536)
    for size in (declared // (most + 1), 1000):
        if limited:
            with pytest.raises(ImageRefused, match=r"times as many.+\[image\.limits\]$"):
                _check_limits(tmp_path / "a.exr", spec, size, 65_536)
        else:
            _check_limits(tmp_path / "a.exr", spec, size, 65_536)


@pytest.mark.fault("I12")
@pytest.mark.parametrize("side", [15_000, 60_000, 1_000_000])
def test_decompression_bomb_is_refused_before_it_is_decoded(tmp_path, side):
    def chunk(kind, content):
        crc = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes(10_000), 9)
    content = chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    for read in (read_radiance, image_size):
        with pytest.raises(ImageRefused):
            read(tmp_path / "a.png")


def test_a_jpeg_for_people_has_no_metadata_and_is_the_picture(tmp_path):
    ramp = np.linspace(0, 255, 64, dtype=np.uint8)
    picture = np.stack(np.broadcast_arrays(ramp[None, :], ramp[:48, None], np.uint8(90)), axis=-1)
    content = encoded_jpeg(np.ascontiguousarray(picture), 90)
    kinds, position = [], 2
    while content[position + 1] != 0xDA:
        kinds.append(content[position + 1])
        position += 2 + int.from_bytes(content[position + 2 : position + 4], "big")
    # Tables, frame header and JFIF's own segment: no other application's, no comment.
    assert set(kinds) <= {0xE0, 0xDB, 0xC0, 0xC2, 0xC4, 0xDD}
    (tmp_path / "picture.jpg").write_bytes(content)
    assert np.abs(read_radiance(tmp_path / "picture.jpg") * 255 - picture).mean() < 2
    assert encoded_jpeg(np.ascontiguousarray(picture), 90) == content


def test_a_jpeg_is_made_where_the_next_command_sweeps_if_it_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    made = []

    def write(target, *rest):
        made.extend(tmp_path.iterdir())
        write_image(target, *rest)

    write_image = images.write_image
    monkeypatch.setattr(images, "write_image", write)
    encoded_jpeg(np.zeros((8, 8, 3), np.uint8), 90)
    assert [place.name.startswith(PREFIX) for place in made] == [True]
    assert not any(tmp_path.iterdir())


UNREAD = """
import errno, itertools, sys
from pathlib import Path
sys.path.insert(0, "benchmarks")
from system_calls import can_watch, run_watched
import numpy as np
from usdbrdf.errors import EnvironmentFailure, ImageRefused
from usdbrdf.files.images import read_radiance
if not can_watch():
    sys.exit(77)
image = Path(sys.argv[1])
expected = np.load(sys.argv[2])

def read():
    try:
        return 0 if np.array_equal(read_radiance(image), expected) else 1
    except EnvironmentFailure:
        return 4
    except ImageRefused:
        return 3

for often in (1, 10**9):
    for number in itertools.count():
        passed = itertools.count()
        answer = lambda call: errno.EIO if number <= next(passed) < number + often else None
        status = run_watched(read, ("read", "open"), image, answer)
        if next(passed) <= number:
            break
        print(often, status)
"""


@pytest.mark.fault("I1")
def test_a_disk_that_fails_is_no_damage_of_a_frame(tmp_path, radiance):
    """Once, and from some read on for good: the kernel answers so, nothing of ours is replaced."""
    write_exr(tmp_path / "frame.exr", radiance, half=False)
    np.save(tmp_path / "expected.npy", radiance)
    files = tmp_path / "frame.exr", tmp_path / "expected.npy"
    done = run_watched("-c", UNREAD, *files, timeout_s=120)
    found = {tuple(line.split()) for line in done.stdout.splitlines()}
    assert found == {("1", "0"), ("1000000000", "4")}


@pytest.mark.fault("I12")
def test_a_header_that_asks_for_memory_is_the_file_s_fault(tmp_path):
    """Of a tag with 2,000,000,000 values in a file of some kilobytes the decoder says that memory
    is short; nothing is wrong with the machine."""
    path = tmp_path / "a.tif"
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(24, 16, 3, "uint8"))
    assert output.write_image(np.zeros((16, 24, 3), np.uint8))
    assert output.close()
    content = bytearray(path.read_bytes())
    (at,) = struct.unpack_from("<I", content, 4)
    for i in range(struct.unpack_from("<H", content, at)[0]):
        entry = at + 2 + 12 * i
        if struct.unpack_from("<H", content, entry)[0] == 259:  # Compression
            struct.pack_into("<I", content, entry + 4, 2_000_000_000)
    path.write_bytes(content)
    with pytest.raises(ImageRefused, match=r"\[image\.\w+\]$"):
        read_radiance(path)


def test_an_exr_of_whole_numbers_is_refused(tmp_path):
    """Five passed for 5 / 2^32."""
    path = tmp_path / "counts.exr"
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(4, 4, 3, "uint"))
    assert output.write_image(np.full((4, 4, 3), 5, np.uint32))
    assert output.close()
    with pytest.raises(ImageRefused, match=r"whole numbers \(UINT\).*\[image.channels\]"):
        read_radiance(path)
