"""Radiance from brackets of a camera whose response, noise and scene are made up."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from scipy.ndimage import gaussian_filter

from tests.json_schemas import checked
from tests.scenes import MadeCapture, edited, make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.alignment import aligned
from usdbrdf.capture.bracketed import merge_brackets
from usdbrdf.capture.brackets import Merged, merge, response_from_brackets
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.exif import exif_exposure
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, write_preview_png
from usdbrdf.options import IngestOptions

EXPOSURES = 16 * 4.0 ** -np.arange(9.0)


def _develop(exposure: np.ndarray) -> np.ndarray:
    """A film-like response: a toe, a shoulder, a different one for each channel."""
    gamma = np.array([2.4, 2.2, 1.9])
    bent = exposure ** (1 / gamma)
    return np.clip((bent + 0.25 * bent**2) / 1.25, 0, 1)


def _scene(shape: tuple[int, int] = (160, 240), *, decades: float = 5, seed: int = 0) -> np.ndarray:
    """(H, W, 3) radiance from 1 to 10^decades, patches of all levels side by side."""
    rng = np.random.default_rng(seed)
    level = rng.uniform(0, decades, (shape[0] // 10, shape[1] // 10)).repeat(10, 0).repeat(10, 1)
    tint = rng.uniform(0.5, 1, (shape[0] // 10, shape[1] // 10, 3)).repeat(10, 0).repeat(10, 1)
    shade = 1 + 0.1 * np.sin(np.arange(shape[1]) / 3)[None, :, None]
    return 10 ** level[..., None] * tint * shade


def _photograph(shape: tuple[int, int], *, decades: float, seed: int = 0) -> np.ndarray:
    """(H, W, 3) radiance with detail of all sizes, as photographs have."""
    rng = np.random.default_rng(seed)
    level = sum(
        s * gaussian_filter(rng.standard_normal(shape), s, mode="wrap") for s in (2, 5, 15, 40)
    )
    level = (level - level.min()) / np.ptp(level)
    return 10 ** (decades * level[..., None]) * np.array([0.7, 1, 0.8])


def _shoot(scene: np.ndarray, exposures: np.ndarray, *, seed: int = 1) -> np.ndarray:
    """(K, H, W, 3) codes: shot noise of 20,000 electrons at white, read noise of 5, 8 bits."""
    rng = np.random.default_rng(seed)
    full = 20_000
    pictures = []
    for exposure in exposures:
        electrons = np.minimum(scene * exposure / 100, 4) * full
        noisy = electrons + np.sqrt(electrons + 25) * rng.standard_normal(scene.shape)
        pictures.append(np.round(255 * _develop(np.clip(noisy / full, 0, 1))))
    return np.array(pictures).astype(np.uint8)


@pytest.fixture(scope="module")
def bracket():
    scene = _scene()
    codes = _shoot(scene, EXPOSURES)
    return scene, codes, response_from_brackets([codes], [EXPOSURES])


def test_the_response_is_the_cameras(bracket):
    response = bracket[2].logarithm
    assert (np.diff(response, axis=1) >= 0).all()
    exposure = np.linspace(0, 1, 200_001)
    codes = 255 * _develop(exposure[:, None].repeat(3, 1))
    for channel in range(3):
        inside = np.arange(24, 245)
        true = np.log(np.interp(inside, codes[:, channel], exposure))
        found = response[channel, inside]
        off = (found - true) - np.median(found - true)
        assert np.abs(off).max() < 0.05
        assert np.median(np.abs(off)) < 0.01


def _against(merged: Merged, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of what was merged, which is known, and its ratio to the truth, NaN elsewhere, up to one
    scale per channel."""
    known = np.isfinite(merged.radiance) & (merged.radiance < merged.saturation)
    known &= merged.radiance >= merged.noise_floor
    ratio = np.where(known, merged.radiance / true, np.nan)
    return known, ratio / np.nanmedian(ratio, axis=(0, 1))


def test_radiance_over_five_decades_is_true_to_two_per_cent(bracket):
    scene, codes, response = bracket
    merged = merge(codes, EXPOSURES, response)
    known, ratio = _against(merged, scene)
    assert known.mean() > 0.97
    assert merged.ghost < 0.03
    for decade in range(5):
        own = (scene >= 10.0**decade) & (scene < 10.0 ** (decade + 1))
        assert np.nanmedian(np.abs(ratio[own] - 1)) < 0.02, decade


def test_what_clips_in_all_is_clipped_and_what_is_dark_in_all_is_dark(bracket):
    scene, _, response = bracket
    codes = _shoot(scene, EXPOSURES[:4])
    merged = merge(codes, EXPOSURES[:4], response)
    clipped = (codes > 250).all(axis=0)
    assert clipped.mean() > 0.1
    assert (merged.radiance[clipped] >= merged.saturation).all()
    assert not np.isnan(merged.radiance[clipped]).any()
    codes = _shoot(scene, EXPOSURES[6:])
    merged = merge(codes, EXPOSURES[6:], response)
    dark = (codes < 4).all(axis=0)
    assert dark.mean() > 0.05
    assert (merged.radiance[dark] < merged.noise_floor).all()


def test_what_moved_between_the_exposures_is_unknown(bracket):
    scene, codes, response = bracket
    codes = codes.copy()
    passer = np.full((60, 30, 3), 3000.0)
    codes[3, 50:110, 100:130] = _shoot(passer, EXPOSURES[3:4])[0]
    merged = merge(codes, EXPOSURES, response)
    # Where the scene does not clip in that exposure, the passer, who does, stands out.
    seen = (scene[51:109, 101:129] * EXPOSURES[3] / 100 < 0.3).all(axis=2)
    assert seen.sum() > 400
    assert np.isnan(merged.radiance[51:109, 101:129][seen]).all(axis=1).mean() > 0.95
    outside = np.ones(scene.shape[:2], bool)
    outside[50:110, 100:130] = False
    assert np.isnan(merged.radiance[outside]).mean() < 0.03


def _flickering(factors: dict[int, float]) -> np.ndarray:
    """Codes of exposures of which some catch all the light at a brighter or darker moment."""
    light = np.ones(len(EXPOSURES))
    light[list(factors)] = list(factors.values())
    return _shoot(_scene(), EXPOSURES * light, seed=3)


def test_a_lamp_that_flickers_in_short_exposures_does_not_contradict_itself(bracket):
    """As in a photographed room, whose lamp is 0.78 times as bright at 1/4000 s as at 1/1000 s."""
    scene, _, response = bracket
    codes = _flickering({7: 1.15, 8: 0.9})
    # In the longer ones it clips: the short ones alone tell how bright it is.
    lamp = (scene.min(axis=2) > 3e4) & (codes[6] > 250).all(axis=2)
    assert lamp.sum() > 300
    merged = merge(codes, EXPOSURES, response)
    assert np.isnan(merged.radiance[lamp]).mean() < 0.03
    np.testing.assert_allclose((merged.exposures / EXPOSURES)[7:], [1.15, 0.9], rtol=0.03)
    known, ratio = _against(merged, scene)
    assert np.nanmedian(np.abs(ratio[known & lamp[..., None]] - 1)) < 0.03


def test_exposures_are_as_stated_where_their_pixels_say_so_within_a_shutters_error(bracket):
    _, codes, response = bracket
    np.testing.assert_array_equal(merge(codes, EXPOSURES, response).exposures, EXPOSURES)
    merged = merge(_flickering({4: 1.03}), EXPOSURES, response)
    np.testing.assert_array_equal(merged.exposures, EXPOSURES)


def test_an_exposure_that_is_far_from_what_is_stated_is_no_flicker(bracket):
    merged = merge(_flickering({4: 2.5}), EXPOSURES, bracket[2])
    np.testing.assert_array_equal(merged.exposures, EXPOSURES)
    assert merged.ghost > 0.2


def test_too_few_pixels_tell_no_exposure(bracket):
    """What moves in a corner, where all else is dark or clips, is no flicker."""
    codes = np.zeros((2, 60, 60, 3), np.uint8)
    codes[0, :8, :8], codes[1, :8, :8] = 200, 150
    merged = merge(codes, EXPOSURES[:2], bracket[2])
    np.testing.assert_array_equal(merged.exposures, EXPOSURES[:2])


def test_blacks_that_a_camera_lifts_contradict_nothing():
    scene = _scene()
    codes = _shoot(scene, EXPOSURES)
    rng = np.random.default_rng(2)
    for channel, black in ((0, 5), (2, 9)):
        lifted = black + rng.integers(-1, 2, codes.shape[:3])
        codes[..., channel] = np.maximum(codes[..., channel], lifted)
    response = response_from_brackets([codes], [EXPOSURES])
    darkest, brightest = response.clear()
    assert (darkest[0] > 5, darkest[2] > 9) == (True, True)
    assert darkest.max() < 20
    assert brightest.min() > 230
    merged = merge(codes, EXPOSURES, response)
    assert merged.ghost < 0.03
    known, ratio = _against(merged, scene)
    assert known.mean() > 0.95
    assert np.nanmedian(np.abs(ratio - 1)) < 0.02


def test_one_exposure_tells_no_response():
    codes = _shoot(_scene(), EXPOSURES[:1])
    with pytest.raises(InputRefused, match=r"\[brackets\.response\]$"):
        response_from_brackets([codes], [EXPOSURES[:1]])


def test_still_brackets_stay_as_they_are():
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    codes = _shoot(_scene(), EXPOSURES)
    found = aligned(codes, list("abcdefghi"))
    assert not found.silent.any()
    np.testing.assert_array_equal(found.moved, np.broadcast_to(np.eye(3), (9, 3, 3)))
    np.testing.assert_array_equal(found.stack, codes)


def _bracketed(folder: Path, *, same_poses: bool) -> MadeCapture:
    """A capture of six exposures a view, as JPEG-like photographs of the made up camera."""
    capture = make_capture(folder, size=(64, 48))
    times = 4.0 ** -np.arange(6.0)
    with edited(capture.manifest) as document:
        frames = []
        for i, frame in enumerate(document["frames"]):
            scene = 400 * np.maximum(read_exr(capture.image(i)), 0.01).astype(np.float64)
            capture.image(i).unlink()
            files = [{"file_path": f"frames/{i}_{k}.png"} for k in range(6)]
            for k, codes in enumerate(_shoot(scene, times, seed=i)):
                _write_photograph(folder / files[k]["file_path"], codes, time=times[k])
            whole = {k: v for k, v in frame.items() if k == "transform_matrix"}
            if same_poses:
                frames += [{**whole, **file} for file in files]
            else:
                shuffled = [files[k] for k in (3, 0, 5, 1, 4, 2)]
                frames.append({**whole, "file_path": "frames/none.exr", "brackets": shuffled})
        document["frames"] = frames
    return capture


def _write_photograph(
    path: Path, codes: np.ndarray, *, time: float, stops: float | None = None
) -> None:
    """With its exposure in its EXIF data alone: at f/2 and ISO 400 it has the given time."""
    spec = oiio.ImageSpec(codes.shape[1], codes.shape[0], codes.shape[2], "uint8")
    spec.attribute("ExposureTime", float(time))
    spec.attribute("FNumber", 2.0)
    spec.attribute("Exif:PhotographicSensitivity", 400)
    if stops is not None:
        spec.attribute("Exif:ShutterSpeedValue", float(stops))
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(codes)
    assert output.close()


@pytest.mark.parametrize("same_poses", [True, False])
def test_a_capture_of_brackets_becomes_one_of_radiance(tmp_path, same_poses, capsys):
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    capture = _bracketed(tmp_path / "scan", same_poses=same_poses)
    if not same_poses:
        with pytest.raises(InputRefused, match=r"merge-brackets.*\[capture\.brackets\]$"):
            read_scan(capture.folder, IngestOptions())
    assert (
        main(
            ["merge-brackets", str(capture.folder), "-o", str(tmp_path / "merged"), "-q", "--json"]
        )
        == 0
    )
    told = checked(capsys.readouterr().out, "merge-brackets")
    assert told["brackets"] > 0
    # In the shortest exposure all but the lamp is too dark to be held against the next.
    assert list(told["unchecked"].values()) == [[f"{i}_5.png"] for i in range(12)]
    assert told["unchecked_share"] == 1 / 5
    scan = read_scan(tmp_path / "merged", IngestOptions())
    assert (len(scan.frames), scan.frames.radiometric) == (12, True)
    np.testing.assert_allclose(scan.frames.world_from_camera, capture.world_from_camera)
    radiance = np.array([read_frame(scan.frames, i).radiance for i in range(12)])
    fresh = make_capture(tmp_path / "again", size=(64, 48))
    true = np.array([read_exr(fresh.image(i)) for i in range(12)])
    plain = true.max(axis=3) < 1
    ratio = (radiance / true)[plain]
    ratio /= np.nanmedian(ratio, axis=0)
    assert np.nanmedian(np.abs(ratio - 1)) < 0.02
    assert main(["merge-brackets", str(capture.folder), "-o", str(tmp_path / "merged")]) == 6


def _folder_of_photographs(folder: Path, times: np.ndarray) -> None:
    folder.mkdir()
    for k, codes in enumerate(_shoot(_scene((60, 80), decades=3), times)):
        _write_photograph(folder / f"IMG_{k}.png", codes, time=times[k])


@pytest.mark.parametrize("name", [251 * "x", 62 * "\N{FIRE}", "IMG\n\x1b[31m"])
def test_photographs_may_be_called_anything(tmp_path, name):
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    folder, merged = tmp_path / "stack", tmp_path / "merged"
    _folder_of_photographs(folder, 4.0 ** -np.arange(3.0))
    (folder / "IMG_0.png").rename(folder / f"{name}.png")
    assert main(["merge-brackets", str(folder), "-o", str(merged), "-q"]) == 0
    (frame,) = read_json(merged / "transforms.json")["frames"]
    assert (merged / frame["file_path"]).is_file()


def test_a_photograph_whose_name_is_not_utf8_is_refused_with_that_reason(tmp_path):
    folder = tmp_path / "stack"
    _folder_of_photographs(folder, 4.0 ** -np.arange(3.0))
    (folder / "IMG_0.png").rename(folder / os.fsdecode(b"IMG\xff.png"))
    with pytest.raises(InputRefused, match=r"not UTF-8\. Rename the file\. \[image\.unreadable\]$"):
        merge_brackets(folder, tmp_path / "merged")


@pytest.mark.fault("I13")
@pytest.mark.parametrize("command", ["merge-brackets", "develop-raw", "develop-video"])
def test_a_photograph_is_no_capture(tmp_path, command, capsys):
    photograph = tmp_path / "stack" / "IMG_0.png"
    photograph.parent.mkdir()
    photograph.write_bytes(b"\x89PNG")
    assert main([command, str(photograph), "-o", str(tmp_path / "merged")]) == 3
    said = capsys.readouterr().err
    assert "IMG_0.png: neither a folder nor a transforms.json. Name the folder" in said


@pytest.mark.fault("I13")
@pytest.mark.parametrize("name", ["mesh.ply", "objects.json", "mask.png"])
def test_a_pipe_beside_the_brackets_is_refused_before_they_are_merged(tmp_path, name, capsys):
    folder = tmp_path / "scan"
    _bracketed(folder, same_poses=False)
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with edited(folder / "transforms.json") as document:
        document["frames"][0]["mask_path"] = "mask.png"
    assert main(["merge-brackets", str(folder), "-o", str(tmp_path / "merged"), "-q"]) == 3
    assert f"{folder / name}: not a regular file" in capsys.readouterr().err
    assert not (tmp_path / "merged").exists()


def test_a_capture_that_is_not_there_is_told_whatever_lies_beside_it(tmp_path, capsys):
    gone, beside = tmp_path / "gone", tmp_path / "merged"
    assert main(["merge-brackets", str(gone), "-o", str(beside)]) == 3
    assert str(gone) in capsys.readouterr().err.partition(":")[2]


def test_photographs_of_a_folder_are_one_bracket(tmp_path):
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    folder, merged = tmp_path / "stack", tmp_path / "merged"
    _folder_of_photographs(folder, 4.0 ** -np.arange(6.0))
    assert main(["merge-brackets", str(folder), "-o", str(merged), "-q"]) == 0
    (frame,) = read_json(merged / "transforms.json")["frames"]
    assert frame["saturation_radiance"] > frame["noise_floor_radiance"] > 0
    radiance = read_exr(merged / frame["file_path"])
    known = (radiance > frame["noise_floor_radiance"]) & (radiance < frame["saturation_radiance"])
    ratio = np.where(known, radiance / _scene((60, 80), decades=3), np.nan)
    ratio /= np.nanmedian(ratio, axis=(0, 1))
    assert known.mean() > 0.9
    assert np.nanmedian(np.abs(ratio - 1)) < 0.02


def test_what_is_told_of_a_folder_names_it_and_no_document_that_is_not_there(tmp_path, capsys):
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    folder, times = tmp_path / "stack", 4.0 ** -np.arange(6.0)
    folder.mkdir()
    for k, codes in enumerate(_shoot(_scene((60, 80), decades=3), times)):
        _write_photograph(folder / f"IMG_{k}.png", codes, time=times[k] * (1.2 if k == 2 else 1))
    assert main(["merge-brackets", str(folder), "-o", str(tmp_path / "merged")]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "brackets.flicker" in line]
    assert told == [line for line in told if f"{folder}: " in line] != []


@pytest.mark.parametrize("profile", ["ColorMatch RGB", "ProPhoto RGB", "sRGB IEC61966-2.1"])
def test_a_profile_that_is_not_known_is_told(tmp_path, monkeypatch, capsys, profile):
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    folder = tmp_path / "stack"
    _folder_of_photographs(folder, 4.0 ** -np.arange(6.0))
    monkeypatch.setattr("usdbrdf.capture.bracketed.colour_tag", lambda path: (profile, ()))
    assert main(["merge-brackets", str(folder), "-o", str(tmp_path / "merged")]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "brackets.encoding" in line]
    assert len(told) == ("IEC61966" not in profile)
    assert all(profile in line and "IMG_0.png" in line for line in told)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([1.0, 0.25, 1.0, 0.25], r"IMG_0.png is exposed as.*several views.*\[brackets\.views\]$"),
        ([1.0], r"neither a transforms.json nor two photographs.*\[brackets\.none\]$"),
    ],
)
def test_a_folder_that_is_not_one_bracket_is_refused(tmp_path, times, said):
    _folder_of_photographs(tmp_path / "stack", np.array(times))
    with pytest.raises(InputRefused, match=said):
        merge_brackets(tmp_path / "stack", tmp_path / "merged")


@pytest.mark.parametrize(("key", "what"), [("FNumber", "f-number"), ("Exif:Pho", "ISO speed")])
def test_what_only_some_photographs_tell_of_their_exposure_is_not_guessed(tmp_path, key, what):
    """Without an f-number a photograph counted as taken at f/1."""
    folder = tmp_path / "stack"
    _folder_of_photographs(folder, 4.0 ** -np.arange(4.0))
    spec = oiio.ImageInput.open(str(folder / "IMG_2.png")).spec()
    for name in [a.name for a in spec.extra_attribs if a.name.startswith(key)]:
        spec.erase_attribute(name)
    output = oiio.ImageOutput.create(str(folder / "IMG_2.png"))
    assert output.open(str(folder / "IMG_2.png"), spec)
    assert output.write_image(np.full((60, 80, 3), 90, np.uint8))
    assert output.close()
    with pytest.raises(InputRefused, match=rf"IMG_2.png: its EXIF data tell no {what}, those of"):
        merge_brackets(folder, tmp_path / "merged")


def test_a_lamp_that_clips_in_all_exposures_is_never_unknown(bracket):
    """Although its flicker makes what a channel tells contradict itself."""
    _, codes, response = bracket
    codes = codes.copy()
    codes[:, 40:60, 40:60] = (255, 128, 100)
    merged = merge(codes, EXPOSURES, response)
    face = merged.radiance[41:59, 41:59]
    assert not np.isnan(face).any()
    assert (face[..., 0] >= merged.saturation).all()


@pytest.mark.parametrize(
    "fault",
    [
        "no exposure",
        "no camera's exposure",
        "no brackets",
        "another size",
        "no file",
        "cut out",
        "logarithms",
    ],
)
def test_what_makes_no_brackets_is_refused(tmp_path, fault, capsys):
    pytest.importorskip("cv2", reason="needs usdbrdf[brackets]")
    capture = _bracketed(tmp_path / "scan", same_poses=False)
    first = capture.folder / "frames/2_1.png"
    if fault == "no exposure":
        write_preview_png(first, np.zeros((48, 64, 3), np.uint8))
    if fault == "no camera's exposure":  # its radiance is beyond all floats
        with edited(capture.manifest) as document:
            document["frames"][0]["brackets"][0]["exposure_time"] = 1e-320
    if fault == "another size":
        _write_photograph(first, np.zeros((24, 64, 3), np.uint8), time=0.25)
    if fault == "no file":
        first.unlink()
    if fault == "logarithms":
        with edited(capture.manifest) as document:
            document["encoding"] = "ACEScct"
    if fault == "cut out":
        _write_photograph(first, np.zeros((48, 64, 4), np.uint8), time=0.25)
    if fault == "no brackets":
        with edited(capture.manifest) as document:
            for frame in document["frames"]:
                frame["file_path"] = frame.pop("brackets")[0]["file_path"]
    assert main(["merge-brackets", str(capture.folder), "-o", str(tmp_path / "merged")]) == 3
    rule = {
        "no exposure": "[brackets.exposure]",
        "no camera's exposure": "[brackets.exposure]",
        "no brackets": "[brackets.none]",
        "another size": "[brackets.size]",
        "no file": "[capture.file]",
        "cut out": "[brackets.alpha]",
        "logarithms": "[brackets.encoding]",
    }[fault]
    assert capsys.readouterr().err.endswith(f"{rule}\n")
    assert not (tmp_path / "merged").exists()


def test_photographs_of_several_exposures_get_one_scale_by_their_exif_data(tmp_path):
    capture = make_capture(tmp_path / "scan")
    radiance = {}
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            time = (1 / 20, 1 / 80)[i % 2]
            light = read_exr(capture.image(i)) * time * 16
            srgb = np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)
            frame["file_path"] = f"frames/{i}.png"
            codes = np.round(255 * np.clip(srgb, 0, 1)).astype(np.uint8)
            _write_photograph(capture.folder / frame["file_path"], codes, time=time)
            del frame["exposure_time"]
            radiance[i] = read_exr(capture.image(i))
    scan = read_scan(capture.folder, IngestOptions(assume_srgb=True))
    assert any("EXIF data are divided out (2.0 stops)" in warning for warning in scan.warnings)
    ratios = []
    for i in range(12):
        pixels = read_frame(scan.frames, i)
        ratios.append(np.median((pixels.radiance / radiance[i])[pixels.valid]))
    np.testing.assert_allclose(ratios, ratios[0], rtol=0.03)


@pytest.mark.parametrize(
    ("time", "stops", "open_for"),
    [
        (1 / 30, 5.0, 1 / 32),
        (1 / 125, 7.0, 1 / 128),
        (1 / 1000, 10.0, 1 / 1024),
        (1 / 80, 6.38, 2 ** -(19 / 3)),  # in eighths of a stop, as some cameras have it
        (1 / 45, 5.5, 2**-5.5),
        (1 / 33, float(np.log2(33)), 1 / 33),  # a telephone's, exact
        (1 / 30, 7.0, 1 / 30),  # which contradict each other
        (1 / 30, None, 1 / 30),
    ],
)
def test_the_name_of_an_exposure_time_gives_way_to_the_shutters_speed(
    tmp_path, time, stops, open_for
):
    path = tmp_path / "photograph.jpg"
    _write_photograph(path, np.zeros((4, 4, 3), np.uint8), time=time, stops=stops)
    assert exif_exposure(path) == pytest.approx(open_for, rel=1e-4)
