"""Captures as people have them: names, kinds of files and habits that formats allow and other
programs have. Each is written by hand from the format's documentation, gives the scan of the room
that it was made of, or is refused in a sentence."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.scenes import MadeCapture, edited, make_capture, write_ply
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.formats import named_pictures
from usdbrdf.capture.formats.named_pictures import Pictures, pictures_of
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, white_of_mask
from usdbrdf.model.capture import Scan
from usdbrdf.options import IngestOptions

DIM = {"lamp": (0.75, 0.5, 0.625)}


@pytest.fixture
def made(tmp_path: Path) -> MadeCapture:
    return make_capture(tmp_path / "scan", subdivisions=1, radiance=DIM)


def _read(made: MadeCapture, **options: object) -> Scan:
    return read_scan(made.folder, IngestOptions(**options))


def _rename(made: MadeCapture, name: str, *, files: str = "") -> None:
    """Frame i is called ``name`` in the document and is the file ``files``, both of i."""
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = name.format(i)
            if files:
                place = made.folder / files.format(i)
                place.parent.mkdir(exist_ok=True)
                made.image(i).rename(place)


def _write_bytes(path: Path, pixels: np.ndarray, **attributes: int) -> None:
    """Whole numbers, (H, W, C), in the kind of file that the path says."""
    path.parent.mkdir(exist_ok=True)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
    for key, value in attributes.items():
        spec.attribute(key, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels)
    assert output.close()


def _write_named(path: Path, pixels: np.ndarray, names: list[str]) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(names), "float")
    spec.channelnames = names
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    output.write_image(np.ascontiguousarray(pixels[..., : len(names)]))
    output.close()


def _as_photographs(made: MadeCapture, suffix: str, **attributes: int) -> None:
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = f"photographs/{i:04d}{suffix}"
            del frame["saturation_radiance"], frame["noise_floor_radiance"]
            shown = to_display_srgb8(read_exr(made.image(i)), exposure_scale=1.0)
            _write_bytes(made.folder / frame["file_path"], shown, **attributes)


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    """w, x, y, z of a rotation: the eigenvector of Bar-Itzhack's matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    upper = np.array([
        [xx - yy - zz, 0, 0, 0], [yx + xy, yy - xx - zz, 0, 0],
        [zx + xz, zy + yz, zz - xx - yy, 0], [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ])  # fmt: skip
    x, y, z, w = np.linalg.eigh(upper)[1][:, -1]
    return np.array([w, x, y, z])


def _as_colmap(made: MadeCapture, names: list[str], files: list[str]) -> None:
    """The text model of COLMAP's documentation, of two cameras."""
    made.manifest.unlink()
    model = made.folder / "sparse" / "0"
    model.mkdir(parents=True)
    numbers = " ".join(map(str, made.intrinsics))
    rows = [f"3 PINHOLE 32 24 {numbers}", f"17 OPENCV 32 24 {numbers} 0 0 0 0"]
    (model / "cameras.txt").write_text("# Camera list\n" + "\n".join(rows) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for i, (name, file) in enumerate(zip(names, files, strict=True)):
        turn = (made.world_from_camera[i][:3, :3] * (1, -1, -1)).T
        place = -turn @ made.world_from_camera[i][:3, 3]
        numbers = " ".join(map(str, [*_quaternion(turn), *place]))
        # One point of the image, with a number that might be an image's.
        lines += [f"{i + 1} {numbers} {(3, 17)[i % 2]} {name}", "1.5 2.5 -1 3 4 5"]
        (made.folder / "images" / file).parent.mkdir(parents=True, exist_ok=True)
        made.image(i).rename(made.folder / "images" / file)
    (model / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _same(scan: Scan, made: MadeCapture) -> None:
    order = np.argsort([path.stem.rpartition(" ")[2] for path in scan.frames.image_paths])
    np.testing.assert_allclose(
        scan.frames.world_from_camera[order], made.world_from_camera, atol=1e-6
    )
    np.testing.assert_allclose(scan.frames.intrinsics[0], made.intrinsics)


@pytest.mark.parametrize("kind", ["exr", "JPG"])
def test_names_of_colmaps_images_may_hold_anything(made, kind):
    """Also of JPEGs, in whose place radiance lies."""
    pytest.importorskip("pycolmap")
    names = [f"{('linke Küche', '右/cam 2')[i % 2]}/Bild ñ {i:04d}.{kind}" for i in range(12)]
    _as_colmap(made, names, [str(Path(name).with_suffix(".exr")) for name in names])
    scan = _read(made)
    _same(scan, made)
    taken = [sentence for sentence in scan.warnings if "[capture.file]" in sentence]
    assert len(taken) == (kind == "JPG")
    assert all("12 pictures" in sentence for sentence in taken)


@pytest.mark.parametrize(
    ("name", "files", "told"),
    [
        ("frames\\{:04d}.exr", "", False),
        ("./frames/{:04d}", "", False),
        ("frames/{:04d}.jpg", "", True),
        ("Pictures/IMG {:04d}.exr", "Pictures/Img {:04d}.EXR", True),
        ("frame.{:04d}", "frame.{:04d}.exr", False),
        ("frames/{:04d}.CR2", "", True),
        ("frames/{:04d}.HEIC", "", True),
        ("frames/{:04d}.nef", "frames/{:04d}.NEF.exr", True),
        ("K\u00fcche/{:04d} \u00f1.exr", "Ku\u0308che/{:04d} n\u0303.exr", False),
        ("Frames/{:04d}.exr", "", False),
    ],
)
def test_frames_are_found_by_other_spellings_of_their_names(made, name, files, told):
    _rename(made, name, files=files)
    scan = _read(made)
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera)
    assert any("[capture.file]" in sentence for sentence in scan.warnings) == told


# The beginning of a HEIC as telephones write it: a box of its brand, and of others.
HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(64)


@pytest.mark.parametrize("name", ["{:04d}.heic", "{:04d}.JPG"])
def test_pictures_of_telephones_that_are_not_read_say_how_to_convert_them(made, name):
    """As they are, and as people rename them."""
    _rename(made, f"photographs/{name}")
    (made.folder / "photographs").mkdir()
    for i in range(12):
        (made.folder / "photographs" / name.format(i)).write_bytes(HEIC)
    with pytest.raises(
        InputRefused, match=r"HEIC or AVIF.*heif-convert -q 97.*\[capture\.image\]$"
    ):
        _read(made, assume_srgb=True)


@pytest.mark.parametrize("name", ["IMG_1.HEIC", "IMG_1.avif"])
def test_a_folder_of_such_alone_says_so_too(tmp_path, name):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / name).write_bytes(HEIC)
    pictures = pictures_of(tmp_path, IngestOptions())
    with pytest.raises(InputRefused, match=rf"{name} is HEIC or AVIF.*\[capture\.frames\]$"):
        named_pictures.refuse_without_pictures(pictures, tmp_path / "cameras.xml")


def test_a_jpeg_is_a_jpg_also_beside_others(made):
    _as_photographs(made, ".jpg")
    (made.folder / "photographs/0003.jpg").rename(made.folder / "photographs/0003.JPEG")
    scan = _read(made, assume_srgb=True)
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera)


def test_folders_of_other_spellings_are_no_links_and_not_two(made, tmp_path):
    _rename(made, "Frames/{:04d}.exr")
    (made.folder / "FRAMES").mkdir()
    with pytest.raises(InputRefused, match=r"does not exist.*\[capture\.file\]$"):
        _read(made)
    (made.folder / "FRAMES").rmdir()
    (made.folder / "frames").rename(tmp_path / "elsewhere")
    (made.folder / "frames").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputRefused, match=r"does not exist.*\[capture\.file\]$"):
        _read(made)


def test_accents_that_macos_takes_apart_are_the_same(tmp_path):
    """Names by their stem alone, as cameras of Metashape and RealityScan have them."""
    for name in ("Ku\u0308che.jpg", "Bad.jpg"):
        _write_bytes(tmp_path / "images" / name, np.zeros((2, 2, 3), np.uint8))
    pictures = pictures_of(tmp_path, IngestOptions())
    found = pictures.named("K\u00fcche.jpg")
    assert found == tmp_path / "images" / "Ku\u0308che.jpg"
    assert pictures.mask_of(found, tmp_path, IngestOptions()) is None


def test_paths_of_another_machine_tell_pictures_of_one_name_apart(tmp_path):
    """As Meshroom's and OpenMVG's documents have them."""
    for folder in ("left", "right"):
        (tmp_path / "images" / folder).mkdir(parents=True)
        _write_bytes(tmp_path / "images" / folder / "0001.jpg", np.zeros((2, 2, 3), np.uint8))
    pictures = pictures_of(tmp_path, IngestOptions())
    for path in ("C:\\shoot\\right\\0001.jpg", "/home/me/right/0001.png"):
        assert pictures.named(path) == tmp_path / "images/right/0001.jpg"
    assert pictures.named("/home/me/0001.jpg") is None


@pytest.mark.parametrize(
    ("label", "found"),
    [
        ("RIG/0/img_1.JPG", "rig/0/IMG_1.jpg"),
        ("rig/1/IMG_1", "rig/1/img_1.JPG"),
        ("D:\\Scan\\Rig\\1\\IMG_1.png", "rig/1/img_1.JPG"),
        ("IMG_1.jpg", "rig/0/IMG_1.jpg"),
        ("img_1.jpg", "rig/1/img_1.JPG"),
        ("Img_1.jpg", None),
        ("twice.jpg", "twice.jpg"),
        ("Twice.jpg", None),
        ("other.jpg", "rig/Other.jpeg"),
    ],
)
def test_programs_of_windows_call_pictures_in_other_letters(tmp_path, label, found):
    """Exact letters come first; what differs in case alone is nobody's under a third spelling."""
    files = ("rig/0/IMG_1.jpg", "rig/1/img_1.JPG", "twice.jpg", "TWICE.jpg", "rig/Other.jpeg")
    for i, name in enumerate(files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        _write_bytes(tmp_path / name, np.full((4, 4, 3), i, np.uint8))
    named = pictures_of(tmp_path.parent, IngestOptions(frames=tmp_path)).named(label)
    assert named == (found and tmp_path / found)


def test_of_many_pictures_of_one_name_each_is_found_by_its_path_at_once(tmp_path, monkeypatch):
    """Stations of six faces: all thousands were compared with each of them."""
    files = [tmp_path / f"station_{i}" / "FRONT.jpg" for i in range(3)]
    pictures = Pictures(folder=tmp_path, paths=tuple(files))
    walked, meant_by = [], named_pictures.meant_by

    class Known(dict):
        def __iter__(self):
            walked.append(self)
            return super().__iter__()

    def meant(wanted, stem, paths):
        return meant_by(wanted, stem, Known.fromkeys(paths))

    monkeypatch.setattr(named_pictures, "meant_by", meant)
    assert [pictures.named(f"station_{i}/FRONT.jpg") for i in range(3)] == files
    assert walked == []


@pytest.mark.parametrize("place", ["/home/me/scan/", "C:\\Users\\me\\scan\\", "../fox/"])
def test_frames_named_where_they_lay_on_another_machine_are_found_or_need_their_folder(made, place):
    """What lies at the end of their paths in the capture's own folder is meant; nothing else is."""
    is_absolute = not place.startswith("..")
    with edited(made.manifest) as document:
        document["mesh"] = f"{place}mesh.ply" if is_absolute else "mesh.ply"
    _rename(made, place + "frames/{:04d}.exr")
    scan = _read(made)
    assert list(scan.frames.image_paths) == [made.image(i).resolve() for i in range(12)]
    (pictures, *mesh) = (said for said in scan.warnings if "[capture.moved]" in said)
    assert "12 of the files" in pictures
    assert ["its mesh lies elsewhere" in said for said in mesh] == [True] * is_absolute
    made.image(3).unlink()
    assert len(_read(made).frames) == 11
    (made.folder / "frames").rename(made.folder / "radiance")
    with pytest.raises(InputRefused, match=r"Name the folder of the pictures with --frames,"):
        _read(made)
    scan = _read(made, frames=made.folder / "radiance")
    assert len(scan.frames) == 11


@pytest.mark.parametrize("through_a_link", [False, True])
def test_frames_may_be_named_by_absolute_paths_into_the_capture(made, tmp_path, through_a_link):
    """As many programs write them. Of radiance beside the JPEGs that are named that is taken, here
    too; masks as well."""
    home = made.folder
    if through_a_link:
        home = tmp_path / "link"
        home.symlink_to(made.folder)
    with edited(made.manifest) as document:
        document["mesh"] = f"{home}/mesh.ply"
    _rename(made, f"{home}/frames/{{:04d}}.jpg")
    scan = _read(made)
    assert list(scan.frames.image_paths) == [made.image(i).resolve() for i in range(12)]
    assert not any("[capture.moved]" in said for said in scan.warnings)
    _write_bytes(made.folder / "masks" / "0.png", np.full((24, 32, 3), 255, np.uint8))
    with edited(made.manifest) as document:
        document["frames"][0]["mask_path"] = f"{home}/masks/0.png"
    assert any("1 masks are used" in said for said in _read(made).warnings)


def test_what_lies_outside_is_not_opened_however_its_path_ends(made, tmp_path):
    """Neither itself, nor through a link at the end of its path in the capture."""
    (tmp_path / "other").mkdir()
    made.image(0).rename(tmp_path / "other" / "0000.exr")
    with edited(made.manifest) as document:
        document["frames"][0]["file_path"] = str(tmp_path / "other" / "0000.exr")
    with pytest.raises(InputRefused, match=r"absolute path.*\[paths\.outside\]$"):
        _read(made)
    (made.folder / "other").symlink_to(tmp_path / "other")
    with pytest.raises(InputRefused, match=r"absolute path.*\[paths\.outside\]$"):
        _read(made)


@pytest.mark.parametrize("suffix", [".exr", ""])
def test_what_is_there_is_meant_not_its_namesake_in_the_capture(made, tmp_path, suffix):
    """Another picture was taken in its place, without more than a warning of a moved capture."""
    (tmp_path / "old/frames").mkdir(parents=True)
    shutil.copyfile(made.image(0), tmp_path / "old/frames/0003.exr")
    shutil.copyfile(made.folder / "mesh.ply", tmp_path / "old/mesh.ply")
    _rename(made, str(tmp_path / "old/frames/{:04d}") + suffix)
    with pytest.raises(InputRefused, match=r"--allow-outside.*\[paths\.outside\]$"):
        _read(made)
    _rename(made, "frames/{:04d}.exr")
    with edited(made.manifest) as document:
        document["mesh"] = "../old/mesh.ply"
    with pytest.raises(InputRefused, match=r"--allow-outside.*\[paths\.outside\]$"):
        _read(made)
    assert len(_read(made, allow_outside=(tmp_path / "old",)).frames) == 12


@pytest.mark.parametrize("first", [True, False])
def test_a_picture_that_is_nowhere_costs_its_frame_in_whatever_order(made, first):
    """It refused the capture where it came before the first that was found."""
    _rename(made, "/home/me/scan/frames/{:04d}.exr")
    made.image(0 if first else 11).unlink()
    assert len(_read(made).frames) == 11


def test_masks_that_were_not_brought_are_no_photographs(made):
    """An end of one part is a photograph's name as often as a mask's."""
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            frame["mask_path"] = f"/home/me/masks/{Path(frame['file_path']).name}"
    made.image(0).rename(made.folder / "0000.exr")
    _read_refused = r"absolute path.*\[paths\.outside\]$"
    with edited(made.manifest) as document:
        document["frames"][0]["file_path"] = "0000.exr"
    with pytest.raises(InputRefused, match=_read_refused):
        _read(made)
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            frame["mask_path"] = f"/home/me/masks/{frame['file_path']}"
        document["frames"][0].pop("mask_path")
    with pytest.raises(InputRefused, match=r"is a picture of a frame.*\[capture\.mask\]$"):
        _read(made)


def test_the_rolling_shutter_of_instant_ngp_is_told(made):
    with edited(made.manifest) as document:
        document["rolling_shutter"] = [0, 0, 0, 0]
    assert not any("[capture.shutter]" in sentence for sentence in _read(made).warnings)
    with edited(made.manifest) as document:
        document["frames"][3]["rolling_shutter"] = [0, 0, 0, 0.02]
    assert any("[capture.shutter]" in sentence for sentence in _read(made).warnings)


def test_frames_of_another_folder_are_named_by_it(made, tmp_path):
    _rename(made, "jpegs/{:04d}.jpg")
    (made.folder / "frames").rename(tmp_path / "radiance")
    with pytest.raises(InputRefused, match=r"--frames.*\[capture\.file\]$"):
        _read(made)
    scan = _read(made, frames=tmp_path / "radiance")
    np.testing.assert_allclose(scan.frames.world_from_camera, made.world_from_camera)
    assert {path.parent for path in scan.frames.image_paths} == {(tmp_path / "radiance").resolve()}


def test_radiance_beside_the_jpegs_that_are_named_is_taken(made):
    """But not what has no colours, as depths."""
    _as_photographs(made, ".jpg")
    for i in range(12):
        _write_bytes(made.folder / f"photographs/{i:04d}.exr", read_exr(made.image(i))[..., :1])
    assert not _read(made, assume_srgb=True).frames.radiometric
    for i in range(12):
        shutil.copy(made.image(i), made.folder / f"photographs/{i:04d}.exr")
    (made.folder / "photographs/0004.jpg").unlink()
    scan = _read(made)
    assert scan.frames.radiometric
    assert {path.suffix for path in scan.frames.image_paths} == {".exr"}
    (told,) = (s for s in scan.warnings if "radiance beside them" in s)
    assert "11 of the photographs" in told
    assert "'0000.exr' for '0000.jpg'. [capture.file]" in told


def test_what_a_camera_wrote_need_not_be_there_but_may(made):
    """Radiance is taken for it, and of HEIF, which nothing here reads, a JPEG too."""
    _as_photographs(made, ".jpg")
    for i in range(12):
        (made.folder / f"photographs/{i:04d}.HEIC").write_bytes(b"no picture")
        (made.folder / f"photographs/{i:04d}.dng").write_bytes(b"no picture")
    _rename(made, "photographs/{:04d}.HEIC")
    assert {p.suffix for p in _read(made, assume_srgb=True).frames.image_paths} == {".jpg"}
    _rename(made, "photographs/{:04d}.dng")
    with pytest.raises(InputRefused, match=r"develop-raw"):
        _read(made, assume_srgb=True)
    _rename(made, "photographs/{:04d}.dng", files="photographs/{:04d}.exr")
    assert _read(made).frames.radiometric


@pytest.mark.parametrize("suffix", ["HEIC", "exr", "hdr", "tif"])
def test_a_jpeg_of_another_name_is_a_photograph(made, suffix):
    """As telephones and messengers hand them on; it passed for radiance."""
    _as_photographs(made, ".jpg")
    for i in range(12):
        photograph = made.folder / f"photographs/{i:04d}.jpg"
        photograph.rename(photograph.with_suffix(f".{suffix}"))
    _rename(made, f"photographs/{{:04d}}.{suffix}")
    with pytest.raises(InputRefused, match=r"--assume-srgb"):
        _read(made)
    assert not _read(made, assume_srgb=True).frames.radiometric


@pytest.mark.parametrize("depths", [".exr", ".png", ".tif"])
def test_depths_beside_a_picture_are_not_what_is_meant(made, depths):
    """By a camera's file, of which a JPEG was made, or by a name or a number alone."""
    _as_photographs(made, ".jpg")
    for i in range(12):
        pixels = 1000 * read_exr(made.image(i))[..., :1]
        whole = pixels if depths == ".exr" else pixels.astype(np.uint16)
        _write_bytes(made.folder / f"photographs/{i:04d}{depths}", whole)
    _rename(made, "photographs/{:04d}.HEIC")
    for options in ({}, {"frames": made.folder / "photographs"}):
        paths = _read(made, assume_srgb=True, **options).frames.image_paths
        assert {path.suffix for path in paths} == {".jpg"}
    paths = tuple(sorted((made.folder / "photographs").iterdir()))
    assert len(paths) == 24
    pictures = Pictures(folder=made.folder, paths=paths)
    assert {path.suffix for path in pictures.numbered().values()} == {".jpg"}
    photograph = made.folder / "photographs/0004.jpg"
    assert pictures.named("0004.HEIC") == pictures.named("0004") == photograph


@pytest.mark.parametrize("layers", [("normal",), ("A", "N"), ("camera",)])
def test_a_picture_of_layers_is_not_meant_where_one_of_colours_is(tmp_path, layers):
    pixels = np.ones((3, 4, 3 * len(layers)), np.float32)
    for folder, of in (("rgb", [""]), ("aov", [f"{layer}." for layer in layers])):
        (tmp_path / folder).mkdir()
        _write_named(tmp_path / folder / "0.exr", pixels, [f"{n}{c}" for n in of for c in "RGB"])
    pictures = pictures_of(tmp_path, IngestOptions(frames=tmp_path))
    assert pictures.named("0") == pictures.numbered()[0] == (tmp_path / "rgb/0.exr").resolve()
    to_display = np.zeros((3, 4, 3), np.uint8)
    _write_bytes(tmp_path / "rgb/0.jpg", to_display)
    (tmp_path / "rgb/0.exr").unlink()
    pictures = pictures_of(tmp_path, IngestOptions(frames=tmp_path))
    found = "aov/0.exr" if layers == ("camera",) else "rgb/0.jpg"
    assert pictures.named("0") == (tmp_path / found).resolve()


def test_a_missing_frame_is_not_replaced_by_a_picture_of_another_kind(made):
    """Which may be its depths."""
    _as_photographs(made, ".jpg")
    (made.folder / "photographs" / "0004.jpg").unlink()
    _write_bytes(made.folder / "photographs" / "0004.png", np.zeros((24, 32, 3), np.uint8))
    scan = _read(made, assume_srgb=True)
    assert {path.suffix for path in scan.frames.image_paths} == {".jpg"}
    assert any("'photographs/0004.jpg': the image file does not exist" in s for s in scan.warnings)


def test_two_files_that_a_name_might_mean_are_none(made):
    shutil.copy(made.image(0), made.folder / "frames" / "0000.Exr")
    _rename(made, "frames/{:04d}.jpg")
    dropped = [s for s in _read(made).warnings if "1 of 12 frames dropped" in s]
    assert len(dropped) == 1


def test_tiff_of_whole_numbers_is_a_photograph_unless_its_space_is_stated(made):
    _as_photographs(made, ".tif")
    with pytest.raises(InputRefused, match=r"whole numbers.*--input-space.*\[capture\.ldr\]$"):
        _read(made)
    taken = _read(made, assume_srgb=True).frames
    assert (taken.radiometric, taken.encoding) == (False, "srgb_rec709_scene")
    stated = _read(made, encoding="lin_rec2020_scene").frames
    assert (stated.radiometric, stated.encoding) == (True, "lin_rec2020_scene")


def test_png_of_16_bits_is_linear_if_that_is_stated(made):
    """As raw developers write it; of 8 bits it is a photograph whatever is said."""
    for i in range(12):
        pixels = np.round(65535 * np.clip(read_exr(made.image(i)), 0, 1)).astype(np.uint16)
        _write_bytes(made.folder / f"photographs/{i:04d}.png", pixels)
    _rename(made, "photographs/{:04d}.png")
    with pytest.raises(InputRefused, match=r"PNG.*--input-space.*\[capture\.ldr\]$"):
        _read(made)
    taken = _read(made, assume_srgb=True)
    assert not taken.frames.radiometric
    assert not any("8-bit" in sentence for sentence in taken.warnings)
    frames = _read(made, encoding="lin_rec709_scene").frames
    assert (frames.radiometric, frames.encoding) == (True, "lin_rec709_scene")
    shown = read_frame(frames, 3)
    expected = read_exr(made.image(3))
    np.testing.assert_allclose(shown.radiance[shown.valid], expected[shown.valid], atol=1e-4)
    _as_photographs(made, ".png")
    with pytest.raises(UsageError, match="8-bit photographs"):
        _read(made, encoding="lin_rec709_scene", assume_srgb=True)


def test_frames_that_cannot_be_read_for_several_reasons_are_not_told_of_one(made):
    """The first's stood for all; and grey pictures have no beauty pass to export."""
    made.image(2).write_bytes(b"")
    grey = read_exr(made.image(3))[..., :1]
    _write_named(made.image(3), grey, ["Y"])
    (told,) = [s for s in _read(made).warnings if "2 of 12 frames dropped" in s]
    assert ": the first, as " in told
    made.image(2).write_bytes(made.image(3).read_bytes())
    (told,) = [s for s in _read(made).warnings if "2 of 12 frames dropped" in s]
    assert "'Y'. It is grey: export it in colour. [capture.image]" in told


def test_masks_have_suffixes_of_any_case(made):
    pytest.importorskip("pycolmap")
    names = [f"{i:04d}.exr" for i in range(12)]
    _as_colmap(made, names, names)
    white = np.full((24, 32, 1), 255, np.uint8)
    white[:6] = 0
    for name in names:
        _write_bytes(made.folder / "masks" / f"{name}.PNG", white)
    assert all(_read(made).frames.masks)


def test_a_folder_of_masks_that_are_nobodys_is_told(made):
    _write_bytes(made.folder / "masks" / "other.png", np.zeros((24, 32, 1), np.uint8))
    said = [sentence for sentence in _read(made).warnings if "[capture.mask]" in sentence]
    assert len(said) == 1
    assert "nothing is masked" in said[0]


@pytest.mark.parametrize("name", ["mask", "Masks"])
def test_a_folder_of_masks_by_another_name_is_told(made, name):
    for i in range(12):
        _write_bytes(made.folder / name / f"{i:04d}.png", np.zeros((24, 32, 1), np.uint8))
    said = [sentence for sentence in _read(made).warnings if "[capture.mask]" in sentence]
    assert len(said) == 1
    assert f"there is a folder {name}, but it is not called masks: rename it. [" in said[0]


@pytest.mark.parametrize("name", ["label", "face_segment"])
def test_labels_of_faces_by_another_name_are_told(made, name):
    write_ply(made.folder / "mesh.ply", made.points, made.triangles, made.face_object)
    content = (
        (made.folder / "mesh.ply").read_bytes().replace(b" object_id\n", f" {name}\n".encode())
    )
    (made.folder / "mesh.ply").write_bytes(content)
    (made.folder / "objects.json").unlink(missing_ok=True)
    (said,) = (sentence for sentence in _read(made).warnings if "[objects.none]" in sentence)
    assert f"no object labels (its faces have {name!r}: call it object_id" in said


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_a_mask_is_its_colours_and_not_its_alpha(tmp_path, channels):
    pixels = np.zeros((4, 6, channels), np.uint8)
    pixels[:2] = 255
    if channels in (2, 4):
        pixels[..., -1] = 255
    _write_bytes(tmp_path / "mask.png", pixels)
    assert white_of_mask(tmp_path / "mask.png").all(axis=1).tolist() == [True, True, False, False]


def test_a_mask_that_leaves_nothing_costs_its_frame(made):
    with edited(made.manifest) as document:
        document["frames"][3]["mask_path"] = "black.png"
    _write_bytes(made.folder / "black.png", np.zeros((24, 32, 3), np.uint8))
    scan = _read(made)
    assert len(scan.frames) == 11
    assert any("black everywhere. [capture.mask]" in sentence for sentence in scan.warnings)


def _with_alpha(made: MadeCapture, i: int, opaque_rows: int) -> None:
    colours = read_exr(made.image(i))
    alpha = np.zeros((*colours.shape[:2], 1), np.float32)
    alpha[:opaque_rows] = 1
    _write_bytes(made.image(i), np.concatenate([colours * alpha, alpha], axis=2))


def test_frames_cut_out_of_their_background_are_masked_by_their_alpha(made):
    """As of an object on a turntable; alpha of 1 everywhere, as most pictures have it, is none."""
    for i in range(12):
        _with_alpha(made, i, opaque_rows=24)
    assert not any("[capture.alpha]" in sentence for sentence in _read(made).warnings)
    for i in range(11):
        _with_alpha(made, i, opaque_rows=18)
    _with_alpha(made, 11, opaque_rows=0)
    scan = _read(made)
    (told, lost) = (sentence for sentence in scan.warnings if "alpha" in sentence)
    assert "25% of the pixels are transparent" in told
    assert "its alpha says that nothing is there. [capture.alpha]" in lost
    assert len(scan.frames) == 11
    assert scan.counts["pixels_unknown"] == scan.counts["pixels_transparent"] == 11 * 6 * 32


def test_what_both_mask_and_alpha_hide_is_hidden_once(made):
    """What is missing of the rest still counts against --max-nonfinite."""
    _with_alpha(made, 3, opaque_rows=18)
    pixels = read_exr(made.image(3))
    pixels[:6, :, :3] = np.nan
    _write_bytes(made.image(3), pixels)
    white = np.zeros((24, 32, 3), np.uint8)
    white[:18] = 255
    _write_bytes(made.folder / "white.png", white)
    with edited(made.manifest) as document:
        document["frames"][3]["mask_path"] = "white.png"
    (told,) = (sentence for sentence in _read(made).warnings if "[capture.nonfinite]" in sentence)
    assert "25% of the pixels are NaN" in told


def test_a_mesh_in_millimetres_beside_poses_in_metres(made):
    write_ply(made.folder / "mesh.ply", 1000 * made.points, made.triangles, made.face_object)
    with pytest.raises(InputRefused, match=r"a mesh in millimetres .*\[capture\.parallax\]$"):
        _read(made)


def test_a_principal_point_outside_of_the_image_is_told(made):
    assert not any("[capture.camera]" in sentence for sentence in _read(made).warnings)
    with edited(made.manifest) as document:
        document["cx"] = 40.0
    assert any("[capture.camera]" in sentence for sentence in _read(made).warnings)


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("a%20b/r {}.exr", "a b/r {}.exr"),
        ("a b/r {}.exr", "a%20b/r%20{}.exr"),
        ("%41 {}", "A {}.exr"),
    ],
)
def test_names_may_be_written_as_in_addresses(made, name, files):
    _rename(made, name, files=files)
    scan = _read(made)
    assert [
        path.relative_to(made.folder.resolve()).as_posix() for path in scan.frames.image_paths
    ] == [files.format(i) for i in range(12)]


def test_a_name_that_is_there_is_not_read_as_an_address(made):
    _rename(made, "a%20b {}.exr", files="a%20b {}.exr")
    _rename(made, "a%20b {}.exr")
    for i in range(12):
        shutil.copy(made.folder / f"a%20b {i}.exr", made.folder / f"a b {11 - i}.exr")
    assert [path.name for path in _read(made).frames.image_paths] == [
        f"a%20b {i}.exr" for i in range(12)
    ]


@pytest.mark.parametrize(
    "name", ["%2e%2e/beside {}.exr", "%00 {}.exr", "%2Fetc%2Fpasswd", "\ud800 {}"]
)
def test_an_address_leads_no_farther_than_a_name(made, name):
    for i in range(12):
        shutil.copy(made.image(i), made.folder.parent / f"beside {i}.exr")
    _rename(made, name)
    with pytest.raises(InputRefused):
        _read(made)


@pytest.mark.parametrize("named", ["Masks/{:04d}.PNG", "D:\\shoot\\Masks\\{:04d}.PNG"])
def test_masks_are_found_by_other_spellings_of_their_names(made, named):
    _rename(made, "frames/{:04d}.exr")
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame["mask_path"] = named.format(i)
            white = np.full((24, 32, 1), 255, np.uint8)
            white[:, :16] = 0
            _write_bytes(made.folder / f"masks/{i:04d}.png", white)
    scan = _read(made)
    assert scan.views
    assert {view.mask for view in scan.views} == {
        made.folder / f"masks/{i:04d}.png" for i in range(12)
    }
