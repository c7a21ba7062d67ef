"""Camera raw files, against DNGs that tifffile writes of known colours."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.scenes import edited, make_capture
from usdbrdf.capture.raw_frames import develop_raw
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.images import read_radiance, write_preview_png
from usdbrdf.untrusted import raw_files

tifffile = pytest.importorskip("tifffile")
pytest.importorskip("rawpy")

BLACK, WHITE = 512, 15_512
# Of a camera that nobody built, XYZ to sensor under D65; and XYZ of linear Rec.709.
CAMERA = np.array([[0.90, -0.30, -0.10], [-0.40, 1.20, 0.20], [-0.05, 0.20, 0.60]])
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
PATCHES = np.array([[0.3, 0.3, 0.3], [0.4, 0.2, 0.15], [0.1, 0.25, 0.12], [0.12, 0.18, 0.4]])
SIDE = 32


def write_dng(path, exposure_s, *, light=1.0, neutral=None, clipped=False, more=()):
    """Patches in a row, RGGB, exposed so that at 1/50 s a radiance of 1 is half of the range."""
    white = CAMERA @ XYZ @ np.ones(3)
    neutral = white / white.max() if neutral is None else neutral
    sensor = 0.5 * light * exposure_s * 50 * (PATCHES @ (CAMERA @ XYZ).T)
    if clipped:
        sensor[0] = 2
    row = np.repeat(sensor, SIDE, axis=0)
    picture = np.repeat(row[None], SIDE, axis=0)
    mosaic = np.empty(picture.shape[:2])
    for (down, across), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        mosaic[down::2, across::2] = picture[down::2, across::2, channel]
    codes = np.clip(BLACK + mosaic * (WHITE - BLACK), 0, WHITE).round().astype(np.uint16)

    def ratios(values):
        return [n for value in values for n in (round(float(value) * 10_000), 10_000)]

    tags = [
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),  # DNGVersion
        (50708, "s", 0, "Sensor of a test", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, bytes([0, 1, 1, 2]), True),  # CFAPattern
        (50714, "H", 1, BLACK, True),
        (50717, "H", 1, WHITE, True),
        (50721, "2i", 9, ratios(CAMERA.ravel()), True),
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
        (50728, "2I", 3, ratios(neutral), True),  # AsShotNeutral
        (33434, "2I", 1, (1, round(1 / exposure_s)), True),
        (34855, "H", 1, 100, True),
        *more,
    ]
    tifffile.imwrite(path, codes, photometric=32803, planarconfig=1, extratags=tags, metadata=None)


def _patch_means(path):
    pixels = read_radiance(path)
    inner = slice(8, SIDE - 8)
    return np.array(
        [pixels[inner, SIDE * i + 8 : SIDE * (i + 1) - 8].mean((0, 1)) for i in range(4)]
    )


@pytest.fixture
def capture(tmp_path):
    made = make_capture(tmp_path / "capture", frames=3, size=(4 * SIDE, SIDE))
    white = CAMERA @ XYZ @ np.ones(3)
    warm = white / white.max() * (1.0, 1.0, 0.8)
    write_dng(made.folder / "frames/0000.dng", 1 / 50)
    write_dng(made.folder / "frames/0001.dng", 1 / 200, neutral=warm)
    write_dng(made.folder / "frames/0002.dng", 1 / 50, clipped=True)
    with edited(made.folder / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            frame["file_path"] = f"frames/{i:04d}.dng"
            for key in ("exposure_time", "saturation_radiance", "noise_floor_radiance"):
                frame.pop(key, None)
    return made.folder


def test_colours_exposures_and_clipping_come_out_right(capture, tmp_path, capsys):
    (capture / "masks").mkdir()
    write_preview_png(capture / "masks/0001.png", np.full((SIDE, 4 * SIDE, 3), 255, np.uint8))
    with edited(capture / "transforms.json") as document:
        document["frames"][1]["mask_path"] = "masks/0001.png"
    found = develop_raw(capture, tmp_path / "developed")
    document = json.loads((tmp_path / "developed/transforms.json").read_text())
    paths = [tmp_path / "developed" / frame["file_path"] for frame in document["frames"]]
    first, second, third = (_patch_means(path) for path in paths)
    unit = np.median(first / PATCHES)
    assert np.allclose(first / unit, PATCHES, rtol=0.01, atol=0.002)
    # A quarter of the exposure, and another white balance as shot: the same radiance.
    assert np.allclose(second, first, rtol=0.01, atol=0.002 * unit)
    assert np.allclose(third[1:], first[1:], rtol=0.01, atol=0.002 * unit)
    saturation = [frame["saturation_radiance"] for frame in document["frames"]]
    assert saturation[1] == pytest.approx(4 * saturation[0])
    assert (third[0] >= 0.998 * saturation[2]).all()
    assert (first < 0.998 * saturation[0]).all()
    assert found["clipped_share"] == pytest.approx(1 / 12, rel=0.2)
    assert found["stops"] == pytest.approx(2)
    assert found["white_balance_drift_stops"] == pytest.approx(np.log2(1 / 0.8), abs=0.01)
    assert "white balance drifts by up to 0.32 stops (0001.dng)" in capsys.readouterr().err
    assert document["frames"][0]["exposure_time"] == pytest.approx(1 / 50)
    assert (tmp_path / "developed/mesh.ply").is_file()
    mask = tmp_path / "developed" / document["frames"][1]["mask_path"]
    assert mask.read_bytes() == (capture / "masks/0001.png").read_bytes()


@pytest.mark.parametrize(
    ("stated", "left", "size"),
    [
        ((112, 24), 10, (112, 24)),
        ((56, 12), 10, (112, 24)),
        (None, 10, (112, 24)),
        ((124, 30), 4, (124, 30)),
        ((24, 112), 4, (124, 30)),
    ],
)
def test_frames_are_the_part_of_the_sensor_that_the_intrinsics_are_for(
    tmp_path, stated, left, size
):
    """Of a sensor with margins and a border, whose camera was held upright."""
    made = make_capture(tmp_path / "capture", frames=1, size=(4 * SIDE, SIDE))
    active, origin, cropped = (2, 4, SIDE, 4 * SIDE), (6, 2), (112, 24)
    more = [(50829, "I", 4, active, True), (50719, "I", 2, origin, True)]
    more += [(50720, "I", 2, cropped, True), (274, "H", 1, 6, True)]
    write_dng(made.folder / "frames/0000.dng", 1 / 50, more=more)
    with edited(made.folder / "transforms.json") as document:
        document["frames"][0]["file_path"] = "frames/0000.dng"
        document.update(zip("wh", stated or (None, None), strict=True))
    develop_raw(made.folder, tmp_path / "developed")
    (written,) = (tmp_path / "developed/frames").iterdir()
    pixels = read_radiance(written)
    assert pixels.shape[1::-1] == size
    # Beside each border between two patches there is one of them alone, where it lay.
    for i in range(1, 4):
        before, behind = (pixels[6:-6, SIDE * i - left + k].mean(0) for k in (-5, 4))
        assert np.allclose(before / behind, PATCHES[i - 1] / PATCHES[i], rtol=0.02)


def test_what_cannot_be_developed_is_refused(capture, tmp_path, monkeypatch):
    target = tmp_path / "developed"
    broken = capture / "frames/0001.dng"
    broken.write_bytes(broken.read_bytes()[:3000])
    assert main(["develop-raw", str(capture), "-o", str(target), "-q"]) == 3
    broken.write_bytes(b"II*\0")
    with pytest.raises(InputRefused, match=r"0001\.dng.*\[raw\.read\]$"):
        develop_raw(capture, target)
    assert not target.exists()
    monkeypatch.setattr(raw_files, "find_spec", lambda name: None)
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[raw\].*\[environment\.rawpy\]$"):
        develop_raw(capture, target)


@pytest.mark.parametrize("exposure", [1e308, 1e-320])
def test_exposures_that_no_camera_has_are_refused(capture, tmp_path, exposure):
    with edited(capture / "transforms.json") as document:
        document["frames"][0]["exposure_time"] = exposure
    with pytest.raises(InputRefused, match=r"0000\.dng: '.*' is no exp.*\[raw\.exposure\]$"):
        develop_raw(capture, tmp_path / "developed")


def test_names_of_raw_files_may_be_as_long_as_file_systems_allow(capture, tmp_path):
    with edited(capture / "transforms.json") as document:
        name = document["frames"][0]["file_path"] = f"frames/{251 * 'x'}.dng"
    (capture / "frames/0000.dng").rename(capture / name)
    develop_raw(capture, tmp_path / "developed")
    assert (tmp_path / f"developed/frames/00000_{200 * 'x'}.exr").is_file()


def test_a_document_without_frames_is_refused(capture, tmp_path):
    with edited(capture / "transforms.json") as document:
        document["frames"] = []
    with pytest.raises(InputRefused, match=r"no frames.*\[raw\.none\]$"):
        develop_raw(capture, tmp_path / "developed")


def test_frames_that_are_no_raw_files_are_refused(tmp_path):
    made = make_capture(tmp_path / "capture", frames=2)
    with pytest.raises(InputRefused, match=r"no camera raw file.*\[raw\.none\]$"):
        develop_raw(made.folder, tmp_path / "developed")
