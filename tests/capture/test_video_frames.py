"""Frames of videos that a made up camera took, which went through its exposures over and over."""

from __future__ import annotations

import errno
import tempfile
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from tests.capture.test_brackets import _photograph, _shoot
from tests.json_schemas import checked
from tests.scenes import edited, make_capture
from usdbrdf.capture import video_frames
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.video_frames import develop_video
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import environment_failures
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_radiance
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted import video_files

av = pytest.importorskip("av", reason="needs usdbrdf[video]")
pytest.importorskip("cv2", reason="needs usdbrdf[video]")

SIZE = (160, 120)
CYCLE = [0.64, 0.08, 0.01]
NUMBERS = [1, 5, 6, 10, 14, 15, 19, 23, 24, 28, 32, 33]
# What stands for one second of exposure, so that the longest clips and the shortest drowns.
LIGHT = 16.0


def _radiance(number: int) -> np.ndarray:
    """(H, W, 3) that frame sees: a slow pan over a large picture."""
    large = _photograph((SIZE[1] + 40, SIZE[0] + 80), decades=2.5, seed=2)
    right, down = number * 3 // 2, number // 2
    return large[down : down + SIZE[1], right : right + SIZE[0]]


def _write_video(path: Path, exposures: list[float], *, codec: str = "libx264") -> None:
    """With an encoder call that the product knows nothing of."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(30))
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv444p"
        stream.options = {"crf": "4"} if codec == "libx264" else {}
        for number, exposure in enumerate(exposures):
            codes = _shoot(_radiance(number), np.array([LIGHT * exposure]), seed=number)[0]
            frame = av.VideoFrame.from_ndarray(codes, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    _write_video(path, [CYCLE[n % 3] for n in range(36)])
    return path


@pytest.fixture
def capture(tmp_path, video) -> Path:
    made = make_capture(tmp_path / "scan", size=SIZE)
    (made.folder / "walk.mp4").write_bytes(video.read_bytes())
    with edited(made.manifest) as document:
        for number, frame in zip(NUMBERS, document["frames"], strict=True):
            for key in ("file_path", "exposure_time", "saturation_radiance"):
                frame.pop(key, None)
            frame["video_frame"] = number
        document |= {"video": "walk.mp4", "exposure_cycle": CYCLE}
    return made.folder


def test_frames_become_radiance_in_one_unit(capture, tmp_path, capsys):
    with pytest.raises(InputRefused, match=r"develop-video.*\[capture\.video\]$"):
        read_scan(capture, IngestOptions())
    target = tmp_path / "radiance"
    assert main(["develop-video", str(capture), "-o", str(target), "--json"]) == 0
    told = checked(capsys.readouterr().out, "develop-video")
    assert (told["frames"], told["stops"], told["contradicting"]) == (12, 6, {})
    scan = read_scan(target, IngestOptions())
    assert scan.frames.radiometric
    assert [path.name for path in scan.frames.image_paths] == [f"{n:06d}.exr" for n in NUMBERS]
    np.testing.assert_allclose(scan.frames.exposure_time, [CYCLE[n % 3] for n in NUMBERS])
    ratios = []
    for i, number in enumerate(NUMBERS):
        pixels = read_frame(scan.frames, i)
        found, true = pixels.radiance[pixels.valid], _radiance(number)[pixels.valid]
        assert len(found) > 1000
        ratio = found / true
        ratio /= np.median(ratio, axis=0)
        # Of single pixels, of which the shortest exposure has few electrons.
        assert np.median(np.abs(ratio - 1)) < 0.08, number
        ratios.append(np.median(found / true, axis=0))
    # Over six stops of exposure.
    np.testing.assert_allclose(
        ratios, np.broadcast_to(np.median(ratios, axis=0), (12, 3)), rtol=0.04
    )


def test_a_table_says_the_exposures_and_a_wrong_one_is_told(capture, tmp_path, capsys):
    stated = {n: CYCLE[n % 3] for n in range(36)}
    stated[14] *= 1.6
    table = "\n".join(["frame,exposure_time", *(f"{n},{t}" for n, t in stated.items())])
    (capture / "exposures.csv").write_text(table)
    with edited(capture / "transforms.json") as document:
        del document["exposure_cycle"]
        document["exposure_table"] = "exposures.csv"
    found = develop_video(capture, tmp_path / "radiance")
    assert list(found["contradicting"]) == ["14"]
    assert found["contradicting"]["14"] == pytest.approx(-np.log2(1.6), abs=0.2)
    assert "14 (-0." in capsys.readouterr().err


def test_a_cycle_that_begins_elsewhere_is_refused(capture, tmp_path):
    with edited(capture / "transforms.json") as document:
        document["exposure_cycle"] = CYCLE[1:] + CYCLE[:1]
    with pytest.raises(InputRefused, match=r"frame 0\. \[video.contradiction\]$"):
        develop_video(capture, tmp_path / "radiance")
    assert not (tmp_path / "radiance").exists()


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"video": None}, "video.none"),
        ({"video": "../walk.mp4"}, "paths.outside"),
        ({"video": "gone.mp4"}, "video.missing"),
        ({"exposure_cycle": [0.1]}, "video.exposure"),
        ({"exposure_cycle": [0.1, 0.1]}, "video.exposure"),
        ({"exposure_cycle": [0.1, -1]}, "video.exposure"),
        ({"exposure_cycle": [0.1, 1e-320]}, "video.exposure"),
        ({"exposure_cycle": None, "exposure_table": "table.csv"}, "document.missing"),
        ({"exposure_table": "table.csv"}, "video.exposure"),
    ],
)
def test_documents_that_do_not_say_enough_are_refused(capture, tmp_path, changes, rule):
    with edited(capture / "transforms.json") as document:
        document |= changes
    with pytest.raises(InputRefused, match=rf"\[{rule}\]$"):
        develop_video(capture, tmp_path / "radiance")


@pytest.mark.parametrize("number", [-1, 2.5, "3", None, True, 5, 10**9])
def test_frames_that_no_video_has_are_refused(capture, tmp_path, number):
    with edited(capture / "transforms.json") as document:
        document["frames"][0]["video_frame"] = number
    with pytest.raises(InputRefused, match=r"\[video.frames\]$"):
        develop_video(capture, tmp_path / "radiance")


def test_a_video_that_ends_before_is_refused(capture, tmp_path):
    with edited(capture / "transforms.json") as document:
        document["frames"][0]["video_frame"] = 400
    with pytest.raises(InputRefused, match=r"no sound frame 400, which.*\[video.frames\]$"):
        develop_video(capture, tmp_path / "radiance")


@pytest.mark.parametrize("kind", ["empty", "text", "playlist", "half", "zeros within"])
def test_broken_and_hostile_files_are_refused(capture, tmp_path, kind, monkeypatch):
    path = capture / "walk.mp4"
    whole = path.read_bytes()
    (tmp_path / "secret.mp4").write_bytes(whole)
    half = len(whole) // 2
    path.write_bytes({
        "empty": b"",
        "text": b"frames of a video\n" * 100,
        "playlist": f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{tmp_path}/secret.mp4\n"
        "#EXT-X-ENDLIST\n".encode(),
        "half": whole[:half],
        "zeros within": whole[: half // 2] + bytes(half) + whole[half // 2 + half :],
    }[kind])  # fmt: skip
    with pytest.raises(InputRefused, match=r"\[video\.(read|frames|response)\]$"):
        develop_video(capture, tmp_path / "radiance")
    assert not (tmp_path / "radiance").exists()


def test_frames_are_upright_and_the_asked_ones(tmp_path, video):
    found = video_files.frames_of_video(video, [7, 3, 7, 90], tmp_path)
    assert found.numbers == (3, 7)
    assert found.resolution == SIZE
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["000003.png", "000007.png"]


def _red(path: Path, rows: int, **said: object) -> Path:
    """A video of BT.709's red, as its luma and chroma have it."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(30))
        stream.width, stream.height, stream.pix_fmt = 160, rows, "yuv444p"
        stream.options = {"crf": "1"}
        for name, value in said.items():
            setattr(stream.codec_context, name, value)
        codes = np.broadcast_to(np.uint8([63, 102, 240])[:, None, None], (3, rows, 160))
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(codes), format="yuv444p")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


# Red as BT.601 reads these codes.
@pytest.mark.parametrize(
    ("rows", "flags", "red"),
    [
        (720, {}, (255, 0, 0)),
        (120, {}, (233, 0, 2)),
        (720, {"colorspace": 5}, (233, 0, 2)),
        (120, {"colorspace": 1, "color_primaries": 1, "color_trc": 1}, (255, 0, 0)),
    ],
)
def test_the_matrix_is_that_which_players_take(tmp_path, rows, flags, red):
    video_files.read_here(_red(tmp_path / "red.mp4", rows, **flags), [0], str(tmp_path))
    shown = 255 * read_radiance(video_files.place_of(tmp_path, 0))
    np.testing.assert_allclose(shown.mean(axis=(0, 1)), red, atol=2)


@pytest.mark.parametrize(
    ("said", "rule"),
    [
        ({"color_primaries": 9, "colorspace": 9}, "BT.709.*video.colour"),
        ({"color_trc": 16}, "PQ.*video.colour"),
        ({"color_trc": 18}, "HLG.*video.colour"),
        ({"sample_aspect_ratio": Fraction(4, 3)}, "4/3.*video.pixels"),
    ],
)
def test_other_colours_and_pixels_are_refused(tmp_path, said, rule):
    path = _red(tmp_path / "red.mp4", 120, **said)
    with pytest.raises(InputRefused, match=rf"red\.mp4: .*{rule}\]$"):
        video_files.read_here(path, [0], str(tmp_path))


@pytest.mark.parametrize("code", [errno.ENOMEM, errno.EIO, errno.ESTALE, errno.ENOSPC])
def test_what_the_machine_lacks_is_no_fault_of_the_video(tmp_path, video, monkeypatch, code):
    def fails(*_, **__):
        av.error.err_check(-code)

    def fails_too(_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(av, "open", fails)
    if code == errno.EIO:
        # FFmpeg says so of damage too, of a file that can be read to its end.
        with pytest.raises(InputRefused, match=r"\[video.read\]$"):
            video_files.read_here(video, [0], str(tmp_path))
        monkeypatch.setattr(video_files, "sha256_of", fails_too)
    with pytest.raises(EnvironmentFailure), environment_failures("video"):
        video_files.read_here(video, [0], str(tmp_path))


@pytest.mark.parametrize("at", ["decoding", "merging"])
def test_an_interrupted_run_leaves_nothing(capture, tmp_path, monkeypatch, at):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    monkeypatch.setattr(tempfile, "tempdir", None)

    def interrupted(*given, **_):
        if at == "decoding":  # of which some frames are there already
            (given[2] / "000000.png").write_bytes(b"")
        raise KeyboardInterrupt

    name = "frames_of_video" if at == "decoding" else "merge"
    monkeypatch.setattr(video_frames, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        develop_video(capture, tmp_path / "made" / "radiance")
    assert list(scratch.iterdir()) == []
    assert not (tmp_path / "made" / "radiance").exists()
    assert list((tmp_path / "made").glob("*")) == []


def test_chosen_frames_of_one_exposure_are_told_by_those_beside_them(capture, tmp_path):
    with edited(capture / "transforms.json") as document:
        for i, frame in enumerate(document["frames"]):
            frame["video_frame"] = 1 + i // 4 * 12 + i % 4 * 3
    found = develop_video(capture, tmp_path / "radiance")
    assert (found["frames"], found["stops"]) == (12, 0)


def test_without_pyav_a_sentence_says_how_to_get_it(tmp_path, video, monkeypatch):
    monkeypatch.setattr(video_files, "find_spec", lambda name: None)
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[video\].*\[environment.av\]"):
        video_files.frames_of_video(video, [1], tmp_path)
