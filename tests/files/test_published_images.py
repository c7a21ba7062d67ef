"""Photographs lose what tells of people; their pixels are those that they had."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest

from usdbrdf.files.images import open_image, read_exr, write_exr
from usdbrdf.files.published_images import copy_without_metadata, write_texture

SECRETS = {
    "Artist": "Jane Roe",
    "Exif:BodySerialNumber": "SN-12345",
    "GPS:Latitude": (52.0, 30.0, 1.0),
    "GPS:LatitudeRef": "N",
    "ImageDescription": "our living room",
    "Copyright": "Roe",
    "capDate": "2026:11:01 10:00:00",
}


def photograph(path, half=True):
    """Written by OpenImageIO itself, with all that a camera tells."""
    pixels = np.random.default_rng(3).random((20, 30, 3)).astype(np.float32)
    kind = "half" if path.suffix == ".exr" else "uint8"
    spec = oiio.ImageSpec(30, 20, 3, kind)
    for name, value in SECRETS.items():
        if isinstance(value, str):
            spec.attribute(name, value)
        else:
            spec.attribute(name, "float[3]", value)
    spec.attribute("DateTime", "2026:11:01 10:00:00")
    if path.suffix == ".exr":
        spec.set_colorspace("lin_p3d65_scene")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels)
    output.close()


@pytest.mark.parametrize("suffix", [".exr", ".jpg", ".png", ".tif"])
def test_what_tells_of_people_goes_and_pixels_stay(tmp_path, suffix):
    source, target = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    photograph(source)
    assert b"Jane Roe" in source.read_bytes()
    copy_without_metadata(source, target)
    content = target.read_bytes()
    for secret in (b"Jane", b"SN-12345", b"living", b"2026", b"Roe"):
        assert secret not in content
    names = {a.name for a in oiio.ImageInput.open(str(target)).spec().extra_attribs}
    assert not [n for n in names - {"Exif:ColorSpace"} if n.startswith(("GPS", "Exif"))]
    assert np.array_equal(read_exr(target), read_exr(source))
    if suffix == ".exr":
        spec = oiio.ImageInput.open(str(target)).spec()
        assert spec.getattribute("oiio:ColorSpace") == "lin_p3d65_scene"
        assert str(spec.format) == "half"


def test_a_picture_in_the_header_of_a_jpeg_goes_and_what_follows_it(tmp_path):
    source, target = tmp_path / "a.jpg", tmp_path / "b.jpg"
    photograph(source)
    content = source.read_bytes()
    comment = b"\xff\xfe\x00\x0dGPS 52.5 13"
    source.write_bytes(content[:2] + comment + content[2:] + b"trailer: 52.5 N")
    copy_without_metadata(source, target)
    assert b"52.5" not in target.read_bytes()
    assert np.array_equal(read_exr(target), read_exr(source))


def test_of_hdr_files_only_what_pixels_mean_stays(tmp_path):
    source, target = tmp_path / "a.hdr", tmp_path / "b.hdr"
    pixels = np.random.default_rng(3).random((20, 30, 3)).astype(np.float32)
    output = oiio.ImageOutput.create(str(source))
    assert output.open(str(source), oiio.ImageSpec(30, 20, 3, "float"))
    assert output.write_image(pixels)
    output.close()
    content = source.read_bytes()
    source.write_bytes(content.replace(b"FORMAT=", b"OWNER=Jane Roe\nEXPOSURE=1.0\nFORMAT=", 1))
    copy_without_metadata(source, target)
    assert b"Jane" not in target.read_bytes()
    assert b"EXPOSURE=1.0" in target.read_bytes()
    assert np.array_equal(read_exr(target), read_exr(source))


def test_what_tells_nothing_is_copied_as_it_is(tmp_path):
    source, target = tmp_path / "a.exr", tmp_path / "b.exr"
    photograph(source)
    copy_without_metadata(source, target)
    copy_without_metadata(target, again := tmp_path / "c.exr")
    assert again.read_bytes() == target.read_bytes()


def test_a_texture_keeps_floats_and_all_channels(tmp_path):
    source, target = tmp_path / "a.exr", tmp_path / "b.exr"
    pixels = np.random.default_rng(3).random((20, 30, 4)).astype(np.float32) * 1e5
    spec = oiio.ImageSpec(30, 20, 4, "float")
    output = oiio.ImageOutput.create(str(source))
    assert output.open(str(source), spec)
    assert output.write_image(pixels)
    output.close()
    write_texture(target, source)
    assert np.array_equal(read_exr(target), pixels)
    write_texture(target, target)
    assert np.array_equal(read_exr(target), pixels)


def test_a_texture_is_written_into_a_folder_whose_name_is_a_pattern(tmp_path):
    """OpenImageIO replaces every % of the path that it stages a texture at."""
    folder, pixels = tmp_path / "50%" / "%04d" / "a", np.full((2, 3, 3), 0.5, np.float32)
    folder.mkdir(parents=True)
    write_exr(tmp_path / "a.exr", pixels)
    write_texture(folder / "b.exr", tmp_path / "a.exr")
    assert np.array_equal(read_exr(folder / "b.exr"), pixels)
    assert [file.name for file in folder.iterdir()] == ["b.exr"]


@pytest.mark.parametrize("name", [b"ow\xf2er", b"ow(er", b"o.n[r"])
def test_names_of_attributes_that_are_no_words_go_too(tmp_path, name):
    """Nothing of the file is refused for them, and nothing of it stays."""
    image = oiio.ImageBuf(oiio.ImageSpec(8, 8, 3, "half"))
    image.specmod().attribute("owner", "me")
    assert image.write(str(tmp_path / "a.exr"))
    content = (tmp_path / "a.exr").read_bytes()
    assert content.count(b"owner\0") == 1
    (tmp_path / "a.exr").write_bytes(content.replace(b"owner\0", name + b"\0"))
    copy_without_metadata(tmp_path / "a.exr", tmp_path / "b.exr")
    assert name + b"\0" not in (tmp_path / "b.exr").read_bytes()
    assert read_exr(tmp_path / "b.exr").shape == (8, 8, 3)


@pytest.mark.parametrize(("kind", "called"), [("png", "jpg"), ("jpg", "png"), ("tif", "png")])
def test_what_is_called_otherwise_loses_its_metadata_all_the_same(tmp_path, kind, called):
    """Photographs are what telephones and chats call them; it was said that the disk is full."""
    photograph(tmp_path / f"a.{kind}")
    (tmp_path / f"a.{kind}").rename(source := tmp_path / f"a.{called}")
    copy_without_metadata(source, target := tmp_path / f"b.{called}")
    assert b"Jane Roe" in source.read_bytes()
    assert b"Jane Roe" not in target.read_bytes()
    kinds = [open_image(file).format_name() for file in (source, target)]
    assert kinds[0] == kinds[1]
    assert {*tmp_path.iterdir()} == {source, target}
