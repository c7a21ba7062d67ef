"""Images that say themselves which colour space they have, written by OpenImageIO."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.scenes import edited, make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import encoding_of_tag
from usdbrdf.files.frames import PHOTOGRAPH_SATURATION, read_frame, read_recorded
from usdbrdf.files.icc_profiles import space_of_profile
from usdbrdf.files.images import colour_tag, read_radiance
from usdbrdf.options import IngestOptions

# The Academy's AP1 primaries and white, S-2014-004; and from them to linear Rec.709, its white
# adapted after Bradford, as the Academy publishes it.
AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
REC709_FROM_AP1 = np.array([
    [1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297],
])  # fmt: skip


def _tag(capture, **said):
    """Write all frames again with attributes of their headers."""
    for i in range(len(capture.world_from_camera)):
        pixels = read_radiance(capture.image(i))
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float")
        for name, value in said.items():
            if isinstance(value, tuple):
                spec.attribute(name, oiio.TypeDesc("float[8]"), value)
            else:
                spec.attribute(name.replace("__", ":"), value)
        output = oiio.ImageOutput.create(str(capture.image(i)))
        assert output.open(str(capture.image(i)), spec)
        assert output.write_image(pixels)
        assert output.close()


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "capture")


@pytest.mark.parametrize("said", [{"chromaticities": AP1}, {"oiio__ColorSpace": "lin_ap1_scene"}])
def test_what_the_header_says_is_believed_and_told(capture, said):
    _tag(capture, **said)
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.encoding == "lin_ap1_scene"
    assert any("lin_ap1_scene" in s and "[capture.encoding]" in s for s in scan.warnings)
    stored = read_radiance(capture.image(0))
    shown = read_frame(scan.frames, 0)
    expected = stored @ REC709_FROM_AP1.T
    assert np.allclose(shown.radiance[shown.valid], expected[shown.valid], rtol=2e-3, atol=2e-3)


def test_the_document_and_the_user_come_before_the_header(capture):
    _tag(capture, chromaticities=AP1)
    own = read_scan(capture.folder, IngestOptions(encoding="lin_rec2020_scene"))
    assert own.frames.encoding == "lin_rec2020_scene"
    with edited(capture.folder / "transforms.json") as document:
        document["encoding"] = "lin_rec709_scene"
    assert read_scan(capture.folder, IngestOptions()).frames.encoding == "lin_rec709_scene"


def test_a_header_that_says_nothing_known_changes_nothing_and_that_is_told(capture):
    _tag(capture, chromaticities=(0.6, 0.3, 0.3, 0.5, 0.1, 0.1, 0.3, 0.3))
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.encoding == "lin_rec709_scene"
    (told,) = [sentence for sentence in scan.warnings if "[capture.encoding]" in sentence]
    assert "of 12 images, first '0000.exr', the header says that their primaries" in told


def test_images_of_several_colour_spaces_are_refused(capture):
    """As of two cameras, or of those that somebody has edited; the first stood for all."""
    last = capture.image(11)
    kept = last.read_bytes()
    _tag(capture, chromaticities=AP1)
    last.write_bytes(kept)
    with pytest.raises(InputRefused, match=r"'0000.exr' is lin_ap1_scene, '0011.exr' lin_rec709"):
        read_scan(capture.folder, IngestOptions())
    own = read_scan(capture.folder, IngestOptions(encoding="lin_ap1_scene"))
    assert own.frames.encoding == "lin_ap1_scene"


def _as_photographs(capture, suffix, said, called=""):
    """All frames as 8-bit images whose headers say this, by their numbers."""
    with edited(capture.folder / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            pixels = np.clip(read_radiance(capture.image(i)), 0, 1)
            frame["file_path"] = f"frames/photograph_{i}{called or suffix}"
            file = capture.folder / f"frames/photograph_{i}{suffix}"
            spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
            for name, value in said(i).items():
                spec.attribute(name, value)
            output = oiio.ImageOutput.create(str(file))
            assert output.open(str(file), spec)
            assert output.write_image(pixels)
            assert output.close()
            file.rename(capture.folder / frame["file_path"])


def test_the_gamma_that_programs_write_into_png_for_srgb_is_no_other_space(capture):
    gamma = {"oiio:ColorSpace": "g22_rec709_scene"}
    _as_photographs(capture, ".png", lambda i: gamma if i % 2 else {})
    scan = read_scan(capture.folder, IngestOptions(assume_srgb=True))
    assert scan.frames.encoding == "srgb_rec709_scene"


def test_a_photograph_of_another_name_is_called_what_it_is(capture):
    _as_photographs(capture, ".jpg", lambda i: {}, called=".exr")
    with pytest.raises(InputRefused, match=r"photograph_0.exr: 12 frames are JPEG, which"):
        read_scan(capture.folder, IngestOptions())


def _as_radiance_hdr(capture, lines):
    """All frames again as Radiance's files, each with its lines of a header."""
    with edited(capture.folder / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            file = capture.image(i).with_suffix(".hdr")
            spec = oiio.ImageSpec(32, 24, 3, "float")
            output = oiio.ImageOutput.create(str(file))
            assert output.open(str(file), spec)
            assert output.write_image(read_radiance(capture.image(i)))
            assert output.close()
            head, blank, rest = file.read_bytes().partition(b"\n\n")
            file.write_bytes(head + b"\n" + lines(i) + blank + rest)
            frame["file_path"] = f"frames/{file.name}"


def test_what_a_radiance_file_has_been_multiplied_by_is_divided_out(capture):
    """Its EXPOSURE and COLORCORR, each stated as often as it was done."""
    before = read_frame(read_scan(capture.folder, IngestOptions()).frames, 3).radiance
    _as_radiance_hdr(capture, lambda i: b"EXPOSURE=4\nCOLORCORR= 1 2 1\nEXPOSURE= %g" % (1 + i))
    scan = read_scan(capture.folder, IngestOptions())
    found = read_frame(scan.frames, 3).radiance
    np.testing.assert_allclose(found, before / (16, 32, 16), rtol=0.02)


def test_the_primaries_of_a_radiance_file_are_known(capture):
    said = b"PRIMARIES=.68 .32 .265 .69 .15 .06 .3127 .329"
    _as_radiance_hdr(capture, lambda i: said)
    assert read_scan(capture.folder, IngestOptions()).frames.encoding == "lin_p3d65_scene"


def test_a_radiance_file_may_be_of_any_program(tmp_path):
    """Photoshop writes zeros for primaries that it does not tell."""
    (file := tmp_path / "a.hdr").write_bytes(
        b"#?AUTOPANO\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nPRIMARIES=0 0 0 0 0 0 0 0\n\n"
        b"-Y 8 +X 8\n" + b"\x80\x80\x80\x81" * 64
    )
    assert np.allclose(read_recorded(file, "lin_rec709_scene", np.inf).radiance, 0.5)
    assert colour_tag(file) == ("lin_rec709_scene", ())


def test_images_of_one_name_in_several_folders_are_several(capture):
    _tag(capture, chromaticities=(0.6, 0.3, 0.3, 0.5, 0.1, 0.1, 0.3, 0.3))
    with edited(capture.folder / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = f"frames/camera_{i}/a.exr"
            (capture.folder / frame["file_path"]).parent.mkdir()
            capture.image(i).rename(capture.folder / frame["file_path"])
    scan = read_scan(capture.folder, IngestOptions())
    (told,) = [sentence for sentence in scan.warnings if "[capture.encoding]" in sentence]
    assert "of 12 images" in told


def _profile(name: str) -> np.ndarray:
    """The header and the description of an ICC profile, as ICC.1:2001-04 lays them out."""
    text = name.encode() + b"\0"
    description = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78)
    description = description.ljust(-(-len(description) // 4) * 4, b"\0")
    table = struct.pack(">I4sII", 1, b"desc", 144, len(description))
    head = struct.pack(">I4sI", 144 + len(description), b"lcms", 0x02400000) + b"mntrRGB XYZ "
    head = head.ljust(36, b"\0") + b"acsp"
    head = head.ljust(68, b"\0") + struct.pack(">3I", 0xF6D6, 0x10000, 0xD32D)  # D50
    return np.frombuffer(head.ljust(128, b"\0") + table + description, np.uint8)


# As Apple's Display P3, HP's sRGB and Adobe's RGB have them: XYZ of red, green and blue.
P3 = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06656, 0.78407))
SRGB = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141))
ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
PROPHOTO = ((0.79767, 0.28804, 0.0), (0.13519, 0.71188, 0.0), (0.03134, 0.00009, 0.82491))
CURVES = {
    "sRGB's formula": b"para" + bytes(4) + struct.pack(
        ">HH5i", 3, 0,
        *(round(x * 65536) for x in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)),
    ),
    "sRGB's table": b"curv" + bytes(4) + struct.pack(
        ">I1024H", 1024,
        *(round(65535 * (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4))
          for x in np.linspace(0, 1, 1024)),
    ),
    "2.2": b"curv" + bytes(4) + struct.pack(">IHxx", 1, 0x233),
    "2.2 as a formula": b"para" + bytes(4) + struct.pack(">HHi", 0, 0, round(2.2 * 65536)),
    "none": b"curv" + bytes(8),
}  # fmt: skip


def _profile_of_numbers(columns, curve: str, name: str = "Anzeige P3", language: str = "deDE"):
    """A whole profile of a display, as ICC.1:2022 lays it out."""
    text = name.encode("utf-16-be")
    described = b"mluc" + bytes(4) + struct.pack(">II4sII", 1, 12, language.encode(), len(text), 28)
    tags = {b"desc": described + text}
    for colour, place in zip(b"rgb", columns, strict=True):
        numbers = struct.pack(">3i", *(round(x * 65536) for x in place))
        tags[b"%cXYZ" % colour] = b"XYZ " + bytes(4) + numbers
        tags[b"%cTRC" % colour] = CURVES[curve]
    table, body = struct.pack(">I", len(tags)), b""
    for tag, content in tags.items():
        table += struct.pack(">4sII", tag, 132 + 12 * len(tags) + len(body), len(content))
        body += content.ljust(-(-len(content) // 4) * 4, b"\0")
    head = bytes(_profile("")[4:128])
    head = head[:4] + struct.pack(">I", 0x04200000) + head[8:]
    return struct.pack(">I", 132 + 12 * len(tags) + len(body)) + head + table + body


# XYZ of the primaries of ACEScg (Academy S-2014-004), adapted to D50.
ACESCG = ((0.68988, 0.28451, -0.00605), (0.14976, 0.67169, 0.01001), (0.12456, 0.0438, 0.82094))


@pytest.mark.parametrize(
    ("columns", "curve", "encoding", "told"),
    [
        (ACESCG, "none", "lin_ap1_scene", "are read so"),
        (PROPHOTO, "none", "lin_rec709_scene", "'Anzeige P3', which is not read here"),
        (SRGB, "sRGB's table", "lin_rec709_scene", "values are for a display (srgb_rec709_scene)"),
    ],
)
def test_floats_have_the_space_of_the_profile_in_them(capture, columns, curve, encoding, told):
    """They passed for Rec.709's without a word."""
    icc = np.frombuffer(_profile_of_numbers(columns, curve, language="enUS"), np.uint8)
    with edited(capture.folder / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = f"frames/{i}.tif"
            pixels = read_radiance(capture.image(i))
            spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float")
            spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), icc)
            output = oiio.ImageOutput.create(str(capture.folder / frame["file_path"]))
            assert output.open(str(capture.folder / frame["file_path"]), spec)
            assert output.write_image(pixels)
            assert output.close()
    scan = read_scan(capture.folder, IngestOptions())
    assert scan.frames.encoding == encoding
    (sentence,) = (said for said in scan.warnings if "[capture.encoding]" in said)
    assert told in sentence


def _png(path, chunks):
    """One colour, after the PNG specification, with chunks before the pixels."""
    whole = b"\x89PNG\r\n\x1a\n"
    pixels = zlib.compress(b"".join(b"\0" + bytes([64, 128, 32] * 8) for _ in range(8)))
    header = struct.pack(">IIBBBBB", 8, 8, 8, 2, 0, 0, 0)
    for name, data in [(b"IHDR", header), *chunks, (b"IDAT", pixels), (b"IEND", b"")]:
        check = zlib.crc32(name + data)
        whole += struct.pack(">I", len(data)) + name + data + struct.pack(">I", check)
    path.write_bytes(whole)


def _primaries(*places):
    """cHRM, of x, y of white, red, green and blue."""
    return b"cHRM", struct.pack(">8I", *(round(100_000 * place) for place in places))


_OF_P3 = _primaries(0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
_OF_REC709 = _primaries(0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
_OF_2020 = _primaries(0.3127, 0.329, 0.708, 0.292, 0.17, 0.797, 0.131, 0.046)
_AS_SRGB, _LINEAR = (b"gAMA", struct.pack(">I", 45455)), (b"gAMA", struct.pack(">I", 100000))


@pytest.mark.parametrize(
    ("chunks", "known"),
    [
        ([_AS_SRGB, _OF_P3], "srgb_p3d65_scene"),
        ([_OF_P3], "srgb_p3d65_scene"),
        ([_LINEAR, _OF_P3], "lin_p3d65_scene"),
        ([_AS_SRGB, _OF_REC709], "g22_rec709_scene"),
        ([(b"sRGB", b"\0"), _AS_SRGB, _OF_P3], "srgb_rec709_scene"),
        ([_AS_SRGB, _OF_2020], None),
        ([(b"cHRM", b"short")], "srgb_rec709_scene"),
        ([(b"eXIf", b"MM\0*" + bytes(70_000)), _AS_SRGB, _OF_P3], "srgb_p3d65_scene"),
        ([(b"tEXt", b"Comment\0" + b"a" * 200_000), _OF_P3], "srgb_p3d65_scene"),
    ],
)
def test_a_png_has_the_primaries_that_it_states(tmp_path, chunks, known):
    """They were not heeded: P3 passed for sRGB without a word."""
    _png(tmp_path / "a.png", chunks)
    name, places = colour_tag(tmp_path / "a.png")
    assert encoding_of_tag(name, places) == known
    assert known or name.startswith("primaries and white 0.708, 0.292")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize(
    ("columns", "curve", "known"),
    [(P3, "sRGB's formula", "srgb_p3d65_scene"), (PROPHOTO, "2.2", None)],
)
def test_a_profile_described_in_no_known_language_is_known_by_its_numbers(
    tmp_path, suffix, columns, curve, known
):
    icc = np.frombuffer(_profile_of_numbers(columns, curve), np.uint8)
    file = tmp_path / f"a{suffix}"
    spec = oiio.ImageSpec(8, 8, 3, "uint8")
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), icc)
    output = oiio.ImageOutput.create(str(file))
    assert output.open(str(file), spec)
    assert output.write_image(np.zeros((8, 8, 3), np.uint8))
    assert output.close()
    name, places = colour_tag(file)
    assert encoding_of_tag(name, places) == known
    assert known or name == "an ICC profile without a name"


@pytest.mark.parametrize(
    ("columns", "curve", "known"),
    [
        (P3, "sRGB's formula", "srgb_p3d65_scene"),
        (P3, "sRGB's table", "srgb_p3d65_scene"),
        (SRGB, "sRGB's table", "srgb_rec709_scene"),
        (ADOBE, "2.2", "g22_adobergb_scene"),
        (ADOBE, "2.2 as a formula", "g22_adobergb_scene"),
        (SRGB, "2.2", ""),
        (P3, "none", "lin_p3d65_scene"),
        (ACESCG, "none", "lin_ap1_scene"),
        (PROPHOTO, "none", ""),
        (PROPHOTO, "2.2", ""),
    ],
)
def test_a_profile_is_known_by_primaries_and_curve(columns, curve, known):
    assert space_of_profile(_profile_of_numbers(columns, curve, "sRGB", "enUS")) == known


def test_what_is_no_whole_profile_is_of_no_space():
    whole, random = _profile_of_numbers(P3, "sRGB's table"), np.random.default_rng(0)
    last = whole.rfind(CURVES["sRGB's table"]) + len(CURVES["sRGB's table"])
    assert all(space_of_profile(whole[:size]) == "" for size in range(0, last, 7))
    for _ in range(500):
        damaged = np.frombuffer(whole, np.uint8).copy()
        damaged[random.integers(128, 400, 20)] = random.integers(0, 256, 20)
        space_of_profile(damaged.tobytes())


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize(
    ("profile", "encoding"),
    [
        ("Display P3", "srgb_p3d65_scene"),
        ("Adobe RGB (1998)", "g22_adobergb_scene"),
        ("sRGB IEC61966-2.1", "srgb_rec709_scene"),
        ("ProPhoto RGB", "srgb_rec709_scene"),
    ],
)
def test_photographs_have_the_space_of_the_profile_in_them(capture, profile, encoding, suffix):
    icc = _profile(profile)
    with edited(capture.folder / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            codes = np.round(255 * np.clip(read_radiance(capture.image(i)), 0, 1)).astype(np.uint8)
            frame["file_path"] = f"frames/photograph_{i}{suffix}"
            file = str(capture.folder / frame["file_path"])
            spec = oiio.ImageSpec(codes.shape[1], codes.shape[0], 3, "uint8")
            spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), icc)
            output = oiio.ImageOutput.create(file)
            assert output.open(file, spec)
            assert output.write_image(codes)
            assert output.close()
    scan = read_scan(capture.folder, IngestOptions(assume_srgb=True))
    assert scan.frames.encoding == encoding
    told = [sentence for sentence in scan.warnings if "[capture.encoding]" in sentence]
    assert len(told) == (profile != "sRGB IEC61966-2.1")
    assert all((encoding if encoding != "srgb_rec709_scene" else profile) in one for one in told)


@pytest.mark.parametrize(
    ("profile", "encoding"),
    [
        ("sRGB", "srgb_rec709_scene"),  # of Android
        ("GIMP built-in sRGB", "srgb_rec709_scene"),
        ("sRGB2014", "srgb_rec709_scene"),
        ("Artifex Software sRGB ICC Profile", "srgb_rec709_scene"),
        ("sRGB-elle-V2-srgbtrc.icc", "srgb_rec709_scene"),
        ("sRGB IEC61966-2.1 black scaled", "srgb_rec709_scene"),
        ("GIMP built-in Linear sRGB", None),
        ("sRGB_D65_lin", None),
        ("Rec2020-elle-V4-srgbtrc.icc", None),
        ("WideRGB-elle-V2-srgbtrc.icc", None),
        ("AllColorsRGB-elle-V4-srgbtrc.icc", None),
        ("Display P3 with sRGB TRC", None),
        ("srgb_p3d65_scene", "srgb_p3d65_scene"),  # of OpenColorIO
        ("srgb_ap1_scene", "srgb_ap1_scene"),
        ("sP3", "srgb_p3d65_scene"),  # of Blender
        ("sRGB-elle-V2-g10.icc", None),
        ("Adobe RGB (1998)", "g22_adobergb_scene"),
        ("Compatible with Adobe RGB (1998)", "g22_adobergb_scene"),
    ],
)
def test_profiles_are_known_by_any_of_their_names(profile, encoding):
    assert encoding_of_tag(profile, ()) == encoding


def test_colours_of_photographs_beyond_rec709_are_known(capture, tmp_path):
    """A red of Display P3 is negative in blue and green there, which is no reason to mask it."""
    codes = np.full((24, 32, 3), (200, 12, 12), np.uint8)
    spec = oiio.ImageSpec(32, 24, 3, "uint8")
    output = oiio.ImageOutput.create(str(tmp_path / "red.png"))
    assert output.open(str(tmp_path / "red.png"), spec)
    assert output.write_image(codes)
    assert output.close()
    frames = read_scan(capture.folder, IngestOptions()).frames
    paths = [tmp_path / "red.png", *frames.image_paths[1:]]
    saturation = np.full(len(paths), PHOTOGRAPH_SATURATION)
    frames = replace(
        frames, image_paths=tuple(paths), encoding="srgb_p3d65_scene",
        saturation_radiance=saturation, noise_floor_radiance=0 * saturation,
    )  # fmt: skip
    found = read_frame(frames, 0)
    assert found.valid.all()
    assert (found.radiance[..., 1] < 0).all()
    linear = np.where(codes > 10, ((codes / 255 + 0.055) / 1.055) ** 2.4, codes / 255 / 12.92)
    # From Display P3 to Rec.709, SMPTE EG 432-1 and ITU-R BT.709, whose white is the same.
    rec709_from_p3 = [[1.22494, -0.22494, 0], [-0.04206, 1.04206, 0], [-0.01964, -0.07864, 1.09828]]
    np.testing.assert_allclose(found.radiance, linear @ np.transpose(rec709_from_p3), atol=1e-4)


@pytest.mark.parametrize("order", ["<", ">"])
def test_adobe_rgb_is_known_by_the_exif_data_of_cameras(tmp_path, order):
    """DCF 2.0: uncalibrated, and R03 in the directory of interoperability; no profile."""
    entry = struct.pack(f"{order}HHI4s", 1, 2, 4, b"R03\0")
    for name, extra, known in (("a.jpg", entry, "g22_adobergb_scene"), ("b.jpg", b"", None)):
        path = tmp_path / name
        spec = oiio.ImageSpec(8, 8, 3, "uint8")
        spec.attribute("Exif:ColorSpace", 65535)
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec)
        assert output.write_image(np.zeros((8, 8, 3), np.uint8))
        assert output.close()
        whole = path.read_bytes()
        # A segment more, as cameras write several.
        path.write_bytes(
            whole[:2] + b"\xff\xe5" + struct.pack(">H", 2 + len(extra)) + extra + whole[2:]
        )
        tag = colour_tag(path)
        assert encoding_of_tag(*tag) == known
        assert tag[0]
