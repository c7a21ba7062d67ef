"""Exposures as cameras write them into photographs, by the EXIF standard (CIPA DC-008)."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.scenes import edited, make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.camera_checks import doubts_about_headers
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.parts import as_photographs
from usdbrdf.files import exif
from usdbrdf.files.exif import Settings, exif_settings
from usdbrdf.model.lens import Lens
from usdbrdf.options import IngestOptions

_ISO = "Exif:PhotographicSensitivity"


@pytest.mark.parametrize(
    ("said", "settings"),
    [
        ({"ExposureTime": 0.01, "FNumber": 4.0, _ISO: 200}, (0.01, 4.0, 200)),
        # In stops alone: 2^-7 s, f/4.
        ({"Exif:ShutterSpeedValue": 7.0, "Exif:ApertureValue": 4.0}, (2**-7, 4.0, None)),
        ({"ExposureTime": 0.01, "Exif:ApertureValue": 4.0}, (0.01, 4.0, None)),
        # 0/0 and 1/0, as of lenses without contacts and of programs.
        ({"ExposureTime": math.nan, "FNumber": math.nan, _ISO: 0}, (None, None, None)),
        ({"ExposureTime": math.inf, "FNumber": 0.0}, (None, None, None)),
        ({"ExposureTime": 0.01, "FNumber": 0.0, "Exif:ApertureValue": 0.0}, (0.01, None, None)),
        ({"ExposureTime": 0.0, "Exif:ShutterSpeedValue": 0.0}, (None, None, None)),
        ({"Exif:ShutterSpeedValue": 0.0}, (1.0, None, None)),
        # Beyond two bytes, the other tags alone, and several values.
        ({_ISO: 65535, "Exif:RecommendedExposureIndex": 102400}, (None, None, 102400)),
        ({"Exif:StandardOutputSensitivity": 400}, (None, None, 400)),
        ({_ISO: (200, 200)}, (None, None, 200)),
    ],
)
def test_settings_are_told_in_any_of_the_ways_of_the_standard(monkeypatch, said, settings):
    monkeypatch.setattr("usdbrdf.files.exif.header_of", lambda _, names: [*map(said.get, names)])
    assert exif_settings(None) == pytest.approx(Settings(*settings))


def _made(tmp_path, said):
    """A room whose photographs say these EXIF data, by their numbers."""
    made = make_capture(tmp_path / "capture")
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            del frame["exposure_time"], frame["saturation_radiance"], frame["noise_floor_radiance"]
            frame["file_path"] = f"frames/{i:04d}.jpg"
            spec = oiio.ImageSpec(32, 24, 3, "uint8")
            for name, value in said(i).items():
                spec.attribute(name, value)
            output = oiio.ImageOutput.create(str(made.folder / frame["file_path"]))
            assert output.open(str(made.folder / frame["file_path"]), spec)
            assert output.write_image(np.full((24, 32, 3), 100 + i, np.uint8))
            assert output.close()
            made.image(i).unlink()
    return made


def _photographs(tmp_path, said):
    """The scan of such a room."""
    return read_scan(_made(tmp_path, said).folder, IngestOptions(assume_srgb=True))


def test_exposures_in_stops_are_divided_out(tmp_path):
    scan = _photographs(
        tmp_path, lambda i: {"Exif:ShutterSpeedValue": 5.0 + i % 3, "Exif:ApertureValue": 4.0}
    )
    assert any("divided out (2.0 stops)" in sentence for sentence in scan.warnings)


def test_apertures_that_some_photographs_do_not_tell_are_not_taken_for_f1(tmp_path):
    """They would be 16 times as bright as those of f/4 beside them."""
    told = {"ExposureTime": 0.01}
    scan = _photographs(tmp_path, lambda i: told | ({"FNumber": 4.0} if i % 2 else {}))
    assert any("EXIF data are not compared" in sentence for sentence in scan.warnings)
    assert len(np.unique(scan.frames.saturation_radiance)) == 1


def _stating(tmp_path, said, changes):
    """What is told of a room whose document states ``changes`` by frames' numbers."""
    made = _made(tmp_path, said)
    with edited(made.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            frame |= changes(i)
    scan = read_scan(made.folder, IngestOptions(assume_srgb=True))
    return [w for w in scan.warnings if "EXIF" in w and "[capture.ldr]" not in w]


@pytest.mark.fault("I15")
def test_exposures_that_are_not_those_of_the_headers_are_told(tmp_path):
    def header(i):
        return {"ExposureTime": 0.01 * 2 ** (i % 3), "FNumber": 4.0, _ISO: 200}

    def as_taken(i):
        return {"exposure_time": 0.01 * 2 ** (i % 3)}

    def one_wrong(i):
        return {"exposure_time": 0.04 if i == 3 else 0.01 * 2 ** (i % 3)}

    # ISO speed and f-number are the same in all: what all have in common does not count.
    assert _stating(tmp_path / "right", header, as_taken) == []
    (said,) = _stating(tmp_path / "wrong", header, one_wrong)
    assert "of 1 of " in said
    assert "by 2.0 stops beside the others in frames/0003.jpg" in said
    assert said.endswith("[capture.exposure]")
    # A camera that chooses its ISO speed by itself.
    (said,) = _stating(tmp_path / "speeds", lambda i: header(i) | {_ISO: 100 << i % 3}, as_taken)
    assert "by 1.0 stops" in said
    assert _stating(tmp_path / "none", lambda i: {}, one_wrong) == []


@pytest.mark.fault("I15")
def test_a_focal_length_that_is_not_that_of_the_headers_is_told(tmp_path):
    """Of 32 x 24 pixels, whose diagonal of 40 is 43.27 mm on film."""
    made = _made(tmp_path / "room", lambda i: {})
    focal = math.sqrt(math.prod(made.intrinsics[:2]))
    usual = focal * math.hypot(36, 24) / 40

    def told(name, millimetres):
        return _stating(
            tmp_path / name, lambda i: {"Exif:FocalLengthIn35mmFilm": millimetres}, lambda i: {}
        )

    assert told("right", round(usual)) == []
    assert told("cropped", round(usual / 1.2)) == []
    (said,) = told("wrong", round(2 * usual))
    assert f"focal length that is stated, {focal:.0f} pixels" in said
    assert f"is {usual / round(2 * usual):.2f} times" in said
    assert said.endswith("[capture.lens]")


@pytest.mark.fault("I15")
def test_of_a_digital_zoom_either_reading_of_the_headers_is_believed(tmp_path):
    made = _made(tmp_path / "room", lambda i: {})
    film = math.sqrt(math.prod(made.intrinsics[:2])) * math.hypot(36, 24) / 40

    def told(name, millimetres):
        zoomed = {"Exif:FocalLengthIn35mmFilm": millimetres, "Exif:DigitalZoomRatio": 2.0}
        return _stating(tmp_path / name, lambda i: zoomed, lambda i: {})

    assert told("with", round(film)) == []
    assert told("without", round(film / 2)) == []
    assert len(told("neither", round(4 * film))) == 1


def test_headers_are_held_against_what_they_are_of(tmp_path):
    """Not against another file's where one cannot be read; and two halves have no middle."""

    def record(i, **known):
        camera = {"world_from_camera": np.eye(4), "intrinsics": (30.0, 30.0, 16.0, 12.0)}
        path = tmp_path / "room" / "capture" / "frames" / f"{i:04d}.jpg"
        return FrameRecord(name=path.name, image_path=path, resolution=(32, 24), **camera, **known)

    def told(stated, **known):
        records = [record(i, exposure_time=stated(i), **known) for i in range(10)]
        return [*doubts_about_headers(records, Path("room"), exposures_are_stated=True)]

    _made(tmp_path / "room", lambda i: {"ExposureTime": 0.01 * 2 ** (i % 3)})
    assert told(lambda i: 0.01 * 2 ** (i % 3)) == []
    (said,) = told(lambda i: 0.01 * 2 ** (i % 3) * (4 if i % 2 else 1))
    assert "of 5 of 10" in said
    assert "by 2.0 stops" in said
    record(4).image_path.write_bytes(b"cut off")
    assert told(lambda i: 0.01 * 2 ** (i % 3)) == []
    # A stitcher copies the headers of what it was given.
    focal = {"Exif:FocalLengthIn35mmFilm": 5}
    for file in (tmp_path / "room" / "capture" / "frames").iterdir():
        file.unlink()
    _made(tmp_path / "other", lambda i: focal)
    shutil.copytree(
        tmp_path / "other" / "capture" / "frames",
        tmp_path / "room" / "capture" / "frames",
        dirs_exist_ok=True,
    )
    assert len(told(lambda i: 1.0)) == 1
    assert told(lambda i: 1.0, lens=Lens(curve="equirectangular")) == []


@pytest.mark.parametrize("stated", [True, False])
def test_headers_are_read_once(tmp_path, monkeypatch, stated):
    records = _records(tmp_path, stated)
    opened = []

    def counted(path, names):
        opened.append(path)
        return [None] * len(names)

    monkeypatch.setattr(exif, "header_of", counted)
    as_photographs(records, Findings(), tmp_path)
    assert sorted(opened) == sorted(record.image_path for record in records)


def _records(folder: Path, stated: bool) -> list[FrameRecord]:
    return [
        FrameRecord(
            name=str(i),
            image_path=folder / f"{i}.jpg",
            world_from_camera=np.eye(4),
            intrinsics=(30, 30, 16, 12),
            resolution=(32, 24),
            exposure_time=1 + i * stated,
        )
        for i in range(3)
    ]
