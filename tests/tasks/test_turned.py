"""Photographs that EXIF data turn are used as stored where their poses belong to such pixels, and
are refused otherwise: by sizes, by the same points of the mesh in several frames, or unknown."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.scenes import MadeCapture, edited, make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import read_exr
from usdbrdf.model.capture import Scan
from usdbrdf.options import InspectOptions
from usdbrdf.tasks.inspect import inspect

DIM = {"lamp": (0.75, 0.5, 0.625)}
ALL = range(12)


def _saved(path: Path, pixels: np.ndarray, orientation: int) -> None:
    path.parent.mkdir(exist_ok=True)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec.attribute("Orientation", orientation)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(pixels))
    assert output.close()


def _stored_of_upright(shown: np.ndarray, orientation: int) -> np.ndarray:
    """What a camera stores under a tag, found by OpenImageIO's own turning."""
    for turn in (
        lambda a: a, lambda a: a[:, ::-1], lambda a: a[::-1, ::-1], lambda a: a[::-1],
        lambda a: a.swapaxes(0, 1), np.rot90, lambda a: np.rot90(a, -1),
        lambda a: a[::-1, ::-1].swapaxes(0, 1),
    ):  # fmt: skip
        stored = np.ascontiguousarray(turn(shown))
        image = oiio.ImageBuf(stored)
        image.specmod().attribute("Orientation", orientation)
        upright = oiio.ImageBufAlgo.reorient(image).get_pixels("uint8")
        if upright.shape == shown.shape and (upright == shown).all():
            return stored
    raise AssertionError(orientation)


def _photographed(
    made: MadeCapture, orientation: int, *, upright: bool, suffix: str = ".jpg", which=ALL
) -> MadeCapture:
    """Frames ``which`` as photographs with a tag, whose poses are those of ``upright`` images or of
    the pixels as stored; the others have none."""
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = f"photographs/{i:04d}{suffix}"
            del frame["saturation_radiance"], frame["noise_floor_radiance"]
            shown = to_display_srgb8(read_exr(made.image(i)), exposure_scale=1.0)
            tag = orientation if i in which else 1
            pixels = _stored_of_upright(shown, tag) if upright else shown
            _saved(made.folder / frame["file_path"], pixels, tag)
    return made


def _room(tmp_path: Path, size: tuple[int, int] = (48, 48)) -> MadeCapture:
    return make_capture(tmp_path / "scan", subdivisions=1, radiance=DIM, size=size)


def _refusals(made: MadeCapture, **options: object) -> str:
    found = inspect(made.folder, InspectOptions(assume_srgb=True, **options))
    return " ".join(map(str, found.refusals))


@pytest.mark.parametrize("orientation", range(2, 9))
def test_pixels_as_stored_are_used_where_the_poses_are_theirs(tmp_path, orientation):
    made = _photographed(_room(tmp_path), orientation, upright=False)
    assert _refusals(made) == ""


@pytest.mark.parametrize(
    ("orientation", "suffix"), [(3, ".tif"), *((n, ".jpg") for n in range(2, 9))]
)
def test_poses_of_upright_images_are_named(tmp_path, orientation, suffix):
    made = _photographed(_room(tmp_path), orientation, upright=True, suffix=suffix)
    said = _refusals(made)
    assert re.search(rf"12 images, first '0000{suffix}' \(orientation {orientation}\)", said), said
    assert "the poses are those of upright ones" in said
    assert said.endswith("[capture.orientation]")


def test_a_few_turned_images_among_many_are_found(tmp_path):
    made = _photographed(_room(tmp_path), 3, upright=True, which=(5, 9))
    assert "EXIF data turn 2 images, first '0005.jpg' (orientation 3)" in _refusals(made)


def test_what_nothing_tells_is_refused(tmp_path):
    """Of one colour, a room looks the same either way."""
    made = _room(tmp_path)
    for i in ALL:
        image = made.image(i)
        flat = np.full((48, 48, 3), 0.25 + i / 100, np.float32)
        assert oiio.ImageBuf(flat).write(str(image))
    _photographed(made, 3, upright=False)
    assert "neither sizes nor pixels tell" in _refusals(made)


def _read(made: MadeCapture) -> Scan:
    return read_scan(made.folder, InspectOptions(assume_srgb=True))


def test_stated_sizes_tell_before_pixels(tmp_path):
    """Lying images for lying cameras: whoever made the poses did not turn images."""
    made = _photographed(_room(tmp_path, (48, 32)), 6, upright=False)
    scan = _read(made)
    assert not scan.turned_images
    assert not any("orientation" in sentence for sentence in scan.warnings)
    with edited(made.manifest) as document:  # the pictures' own size is no statement
        for owner in (document, *document["frames"]):
            for key in ("w", "h"):
                owner.pop(key, None)
    assert len(_read(made).turned_images) == 12
    assert _refusals(made) == ""


def test_images_that_lie_for_cameras_that_stand_are_refused(tmp_path):
    made = _photographed(_room(tmp_path, (48, 32)), 6, upright=True)
    with pytest.raises(InputRefused, match=r"EXIF data turn it.*\[capture\.size\]$"):
        _read(made)


def _say_sides_as_stored(made: MadeCapture) -> None:
    """As who reads the size from the file, and everything else from who turned the pictures."""
    with edited(made.manifest) as document:
        for owner in (document, *document["frames"]):
            if "w" in owner:
                owner["w"], owner["h"] = owner["h"], owner["w"]


@pytest.mark.parametrize("orientation", [6, 8])
def test_sizes_as_stored_beside_lenses_of_upright_images_tell_nothing(tmp_path, orientation):
    """Lying images for standing cameras, whose principal points say so: they were used, which told
    that frames do not agree."""
    made = _photographed(_room(tmp_path, (48, 36)), orientation, upright=True)
    _say_sides_as_stored(made)
    assert len(_read(made).turned_images) == 12
    said = _refusals(made)
    assert "the poses are those of upright ones" in said
    assert said.endswith("and state their size as it is then. [capture.orientation]")
