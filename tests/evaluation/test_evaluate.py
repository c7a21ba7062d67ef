"""`usdbrdf evaluate`, end to end on a room whose radiance is known."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.json_schemas import checked
from tests.scenes import MadeCapture, edited, look_at, make_capture, turned_capture
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.evaluation.evaluate_views import measured_atlas
from usdbrdf.evaluation.metrics import compare_with_truth, true_albedo
from usdbrdf.evaluation.report import write_plot
from usdbrdf.files.images import image_size, read_exr
from usdbrdf.job.progress import set_quiet

LOW = usdbrdf.EvaluateOptions(samples_per_pixel=4, rays=32)


@pytest.fixture(scope="module")
def views(tmp_path_factory) -> MadeCapture:
    places = np.array([[3.0, 0.6, 1.5], [0.8, 2.2, 1.2], [3.2, 2.4, 1.0]])
    poses = np.array([look_at(place, np.array([1.8, 1.5, 0.8])) for place in places])
    return make_capture(tmp_path_factory.mktemp("views"), poses=poses)


@pytest.fixture(scope="module")
def found(room, views, tmp_path_factory):
    output = tmp_path_factory.mktemp("found") / "out"
    before = contents(room.asset)
    result = usdbrdf.evaluate(room.asset, views.manifest, output, LOW)
    assert contents(room.asset) == before, "the asset was changed"
    return output, result


def contents(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_a_baseline_of_the_same_radiance_everywhere_is_the_photograph(found):
    # But for pixels on an edge, which the photographs show without anti-aliasing.
    for row in found[1]["frames"]:
        assert row["compared"] == 1
        assert row["l2_shown_baseline"] < 0.1
        assert row["flip_baseline"] < 0.06


def test_the_summary_is_of_all_views(found):
    rows, summary = found[1]["frames"], found[1]["summary"]
    for metric in ("l2", "l2_with_lamps", "l2_shown", "flip", "psnr"):
        before, after = (
            [row[f"{metric}_{model}"] for row in rows] for model in ("baseline", "full")
        )
        assert summary[metric]["baseline"] == pytest.approx(np.mean(before))
        worse = sum(
            b > a if metric != "psnr" else b < a for a, b in zip(before, after, strict=True)
        )
        assert summary[metric]["worse_views"] == worse
    flip = summary["flip"]
    assert 1 + flip["change_percent"] / 100 == pytest.approx(flip["full"] / flip["baseline"])


def test_light_of_primaries_that_are_not_known_is_told_and_that_of_no_file_as_such(
    room, views, tmp_path, capsys
):
    file = tmp_path / "sky.hdr"
    primaries = b"PRIMARIES=0.6 0.3 0.3 0.5 0.2 0.1 0.3 0.3\n"
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n" + primaries + b"\n-Y 2 +X 4\n"
    file.write_bytes(head + bytes([64, 128, 64, 129]) * 8)
    set_quiet(False)
    usdbrdf.evaluate(room.asset, views.manifest, tmp_path / "a", replace(LOW, environment=file))
    assert capsys.readouterr().err.count("[light.primaries]") == 1
    file.unlink()
    with pytest.raises(InputRefused, match=r"sky\.hdr: this picture does not exist.*\[picture"):
        usdbrdf.evaluate(room.asset, views.manifest, tmp_path / "b", replace(LOW, environment=file))


@pytest.mark.parametrize("what", ["environment", "truth"])
def test_what_cannot_be_read_is_refused_before_all_photographs_are(
    room, views, tmp_path, monkeypatch, what
):
    monkeypatch.setattr("usdbrdf.evaluation.evaluate_views.exposure_of_views", pytest.fail)
    bad = tmp_path / "bad.exr"
    bad.write_bytes(b"none")
    with pytest.raises(InputRefused, match=r"bad\.exr"):
        usdbrdf.evaluate(room.asset, views.manifest, tmp_path / "out", replace(LOW, **{what: bad}))
    assert not (tmp_path / "out").exists()


def test_all_files_are_there(found):
    output, result = found
    listed = {p.relative_to(output).as_posix() for p in output.rglob("*") if p.is_file()}
    assert listed == set(result["files"])
    assert json.loads((output / "evaluation.json").read_text()) == json.loads(json.dumps(result))
    with (output / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["view"] for row in rows] == [f"frames/{i:04d}.exr" for i in range(3)]
    assert float(rows[1]["flip_full"]) == result["frames"][1]["flip_full"]
    assert image_size(output / "pictures/0002_0002.png")[:2] == (3 * 32 + 8, 2 * 24 + 4)
    assert image_size(output / "pictures/0002_0002.flip_full.png")[:2] == (32, 24)


def test_the_same_again_is_the_same(found, room, views, tmp_path):
    again = usdbrdf.evaluate(room.asset, views.manifest, tmp_path, LOW)
    assert again == found[1]


def test_pixels_that_the_photograph_does_not_know_are_left_out(room, views, tmp_path):
    folder = tmp_path / "views"
    masked = make_capture(folder, poses=views.world_from_camera, saturation_radiance=0.3)
    result = usdbrdf.evaluate(room.asset, masked.manifest, tmp_path / "out", LOW)
    for i, row in enumerate(result["frames"]):
        known = (read_exr(masked.image(i)) < 0.299).all(axis=2)
        assert 0 < row["compared"] < 1
        assert row["compared"] == pytest.approx(known.mean())


def test_the_command_prints_its_summary(room, views, tmp_path, capsys):
    truth = write_truth(tmp_path / "truth", room.capture)
    mesh = room.capture.folder / "mesh.ply"
    options = ["--samples-per-pixel", "1", "--rays", "8", "--json"]
    options += ["--truth", str(truth), "--mesh", str(mesh)]
    output = tmp_path / "out"
    assert (
        main(
            [
                "evaluate",
                str(room.asset),
                "--views",
                str(views.manifest),
                "-o",
                str(output),
                *options,
            ]
        )
        == 0
    )
    out, err = capsys.readouterr()
    told = checked(out, "evaluate")
    assert told["views"] == 3
    assert told["flip"] == json.loads((output / "evaluation.json").read_text())["summary"]["flip"]
    assert told["truth"]["material"]["objects"] == 4
    assert "against the truth: albedo NRMSE" in err
    assert "3 views, diffuse baseline -> full model: FLIP" in err


@pytest.mark.fault("R15")
def test_without_matplotlib_one_line_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    usdbrdf.job.progress.set_quiet(False)
    write_plot(tmp_path / "evaluation.png", [])
    assert "usdbrdf[report]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


DRAWN = """
import sys
from pathlib import Path
from usdbrdf.evaluation.report import write_plot
class Row(dict):
    def __missing__(self, key):
        return 0.5
write_plot(Path(sys.argv[1]), [Row(), Row()])
"""


@pytest.mark.fault("S9")
def test_settings_of_matplotlib_in_the_current_folder_play_no_part(tmp_path):
    """A capture by others may bring some along, in which somebody works: they ran LaTeX, or ended
    what had rendered all views."""
    pytest.importorskip("matplotlib", reason="the plot is the extra `report`")
    (program := tmp_path / "draw.py").write_text(DRAWN)
    said = {}
    for name, settings in (
        ("none", None),
        ("latex", b"text.usetex: True\nfigure.dpi: 7\naxes.facecolor: black\n"),
        ("no text", b"\xff\xfe"),
        ("unread", Path("/proc/self/mem")),  # a regular file whose first byte is an error
        ("no file", os.mkfifo),
    ):
        (place := tmp_path / name).mkdir()
        if isinstance(settings, bytes):
            (place / "matplotlibrc").write_bytes(settings)
        elif isinstance(settings, Path):
            (place / "matplotlibrc").symlink_to(settings)
        elif settings is not None:
            settings(place / "matplotlibrc")
        said[name] = subprocess.run(
            [sys.executable, program, place / "plot.svg"],
            cwd=place,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
            capture_output=True, text=True, check=True, timeout=300,
        ).stderr  # fmt: skip
    plots = {name: tmp_path / name / "plot.svg" for name in said}
    assert plots["latex"].read_bytes() == plots["none"].read_bytes()
    for name in ("no text", "unread", "no file"):
        assert not plots[name].exists()
        assert "not drawn, matplotlib cannot read its settings" in said[name]


def test_with_it_there_is_a_plot(found):
    pytest.importorskip("matplotlib", reason="the plot is the extra `report`")
    assert image_size(found[0] / "evaluation.png")[0] > 500


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"samples_per_pixel": 5}, "not a square"),
        ({"samples_per_pixel": 0}, "whole number of at least 1"),
        ({"rays": 8}, "at least 8 for each"),
        ({"mesh": Path("m.ply")}, "--truth"),
    ],
)
def test_wrong_options(options, said):
    with pytest.raises(UsageError, match=said):
        usdbrdf.EvaluateOptions(**options)


def test_a_folder_without_an_asset_is_refused(views, tmp_path):
    with pytest.raises(InputRefused, match=r"\[asset.missing\]"):
        usdbrdf.evaluate(tmp_path, views.manifest, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# Known truth


def write_truth(folder: Path, capture: MadeCapture, **changes: object) -> Path:
    folder.mkdir()
    objects = [
        {"id": i, "name": name, "phi": 0.5, "psi": 0.25, "emission": [8.0 * (name == "lamp")] * 3}
        for i, name in enumerate(capture.names)
    ]
    objects[0].update(changes)
    (folder / "objects.json").write_text(json.dumps(objects))
    np.savez(folder / "albedo_vertex.npz", albedo=capture.points)
    return folder


def test_known_albedo_is_linear_between_the_meshs_vertices(room, tmp_path):
    truth = write_truth(tmp_path / "truth", room.capture)
    _, atlas = measured_atlas(room.asset)
    known = true_albedo(atlas, truth, room.capture.folder / "mesh.ply")
    assert np.abs(known - atlas.texels.position).max() < 1e-5


def test_errors_against_the_truth(room, tmp_path):
    truth = write_truth(tmp_path / "truth", room.capture)
    _, atlas = measured_atlas(room.asset)
    told = compare_with_truth(atlas, truth, room.capture.folder / "mesh.ply", "albedo")
    rows = told["material"]["rows"]
    assert set(rows) == set(room.capture.names) - {"lamp"}
    for row in rows.values():
        assert row["error"][0] == pytest.approx(abs(row["found"][0] - 0.5), abs=1e-3)
    mean = np.mean([row["error"][1] for row in rows.values()])
    assert told["material"]["mean_abs_psi"] == pytest.approx(mean)
    assert {"floor", "walls"} <= set(told["albedo"]["objects"]) <= set(rows)


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"name": "other"}, "does not know the asset's object"), ({"phi": None}, "phi")],
)
def test_another_captures_truth_is_refused(room, tmp_path, changes, said):
    truth = write_truth(tmp_path / "truth", room.capture, **changes)
    _, atlas = measured_atlas(room.asset)
    with pytest.raises(InputRefused, match=rf"{said}.*\[evaluate.truth\]"):
        compare_with_truth(atlas, truth, room.capture.folder / "mesh.ply", "albedo")


def test_albedo_of_another_mesh_is_refused(room, tmp_path):
    truth = write_truth(tmp_path / "truth", room.capture)
    np.savez(truth / "albedo_vertex.npz", albedo=np.zeros((5, 3)))
    _, atlas = measured_atlas(room.asset)
    with pytest.raises(InputRefused, match=r"\(5, 3\), but .*mesh.ply.*\[evaluate.truth\]"):
        compare_with_truth(atlas, truth, room.capture.folder / "mesh.ply", "albedo")


def test_a_capture_that_was_turned_has_the_figures_of_one_that_was_not(
    room, turned, views, found, tmp_path
):
    """Its views and its truth come in its own coordinates."""
    folder = turned_capture(views, tmp_path / "views", "X")
    with edited(folder / "transforms.json") as document:
        del document["frames"][1:]
    options = replace(LOW, allow_outside=(views.folder,))
    (ours,) = usdbrdf.evaluate(turned, folder / "transforms.json", tmp_path / "out", options)[
        "frames"
    ]
    theirs = found[1]["frames"][0]
    assert ours["compared"] == theirs["compared"] == 1
    for name in ("l2_baseline", "l2_full", "l2_shown_full"):
        assert ours[name] == pytest.approx(theirs[name], rel=0.01), name
    truth = write_truth(tmp_path / "truth", room.capture)
    _, atlas = measured_atlas(turned)
    known = true_albedo(atlas, truth, turned.parent / "scan" / "mesh.ply")
    assert np.abs(known - atlas.texels.position).max() < 1e-5
