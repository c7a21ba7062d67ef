"""`usdbrdf paper`: the tables and figures of two small assets of one room."""

from __future__ import annotations

import csv
import json
import re
import sys

import numpy as np
import pytest

import usdbrdf
from tests.json_schemas import checked
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main
from usdbrdf.errors import UsageError, UsdBrdfError
from usdbrdf.evaluation.evaluate_views import MODELS, ScoredView
from usdbrdf.files.images import image_size, read_radiance
from usdbrdf.paper.figures import MOST_ACROSS, TellingViews, _scene_of, views_sheet
from usdbrdf.paper.options import PaperOptions
from usdbrdf.paper.tables import changes
from usdbrdf.paper.write_paper import write_paper

SMALL = ["--frames", "3", "--samples-per-pixel", "1", "--rays", "8", "--samples", "8"]


@pytest.fixture(scope="module")
def brighter(room, make):
    twice = {name: tuple(2 * v for v in rgb) for name, rgb in room.capture.radiance.items()}
    return make(radiance=twice, saturation_radiance=128.0)


@pytest.fixture(scope="module")
def made(room, brighter, tmp_path_factory):
    output = tmp_path_factory.mktemp("paper") / "out"
    command = ["paper", str(room.asset), str(brighter.asset), "-o", str(output), *SMALL]
    assert main(command) == 0
    return output, json.loads((output / "paper.json").read_text("utf-8"))


def test_numbers_are_those_of_compare_and_evaluate(made, room, brighter, tmp_path):
    _, found = made
    compared = usdbrdf.compare(room.asset, brighter.asset, tmp_path / "comparison")
    assert {key: found[key] for key in ("texels", "lit", "objects")} == {
        key: compared[key] for key in ("texels", "lit", "objects")
    }
    options = usdbrdf.EvaluateOptions(samples_per_pixel=1, rays=8)
    views = room.capture.folder / "transforms.json"
    evaluated = usdbrdf.evaluate(room.asset, views, tmp_path / "evaluation", options)
    first = evaluated["frames"][0], found["views"][0]["rows"][0]
    assert first[0]["view"].endswith(first[1]["view"])
    assert first[1]["l2_baseline"] == pytest.approx(first[0]["l2_baseline"], rel=1e-6)


def test_every_file_is_there_and_named(made):
    output, found = made
    files = {p.relative_to(output).as_posix() for p in output.rglob("*") if p.is_file()}
    assert files == set(found["files"])
    text = (output / "paper.md").read_text("utf-8")
    shown = set(re.findall(r"\]\((figures/[^)]+)\)", text))
    assert shown <= files
    pytest.importorskip("matplotlib")
    assert {f"figures/fig8_{name}.{suffix}" for name in "ab" for suffix in ("png", "svg")} <= files
    assert {f"figures/fig{i}" for i in ("5_errors.png", "9_a.png", "9_b.png")} <= files
    for name in ("albedo", "objects", "materials", "views_a", "views_b"):
        with (output / f"tables/{name}.csv").open(encoding="utf-8") as file:
            assert len(list(csv.DictReader(file))) >= 3
    # Three cameras, A and B; four pictures across with gaps between.
    width, height, _ = image_size(output / "figures/fig6_albedo_shading.png")
    own = image_size(output / "figures/fig5_errors.png")
    assert (width + 4) / 4 == (own[0] + 4) / 3
    assert (height + 4) == 2 * (own[1] + 4)


def test_the_two_albedos_look_alike_though_one_room_is_twice_as_bright(made):
    output, found = made
    assert found["lit"]["albedo"]["nrmse"] < 0.01
    sheet = read_radiance(output / "figures/fig6_albedo_shading.png")
    width, height = (sheet.shape[1] + 4) // 4 - 4, (sheet.shape[0] + 4) // 6 - 4
    albedo = [sheet[i * (height + 4) :][:height, :width] for i in range(2)]
    assert np.abs(albedo[0] - albedo[1]).mean() < 0.02
    assert albedo[0].std() > 0.05


def test_relit_in_the_others_light_it_is_as_the_other_is(made):
    pytest.importorskip("mitsuba")
    _, found = made
    # The same materials in the same light; half the light would be an error of 0.5.
    assert found["relighting"]["a_in_light_of_b"] < 0.02
    assert found["relighting"]["b_in_light_of_a"] < 0.02


def test_the_same_again_is_the_same(made, room, brighter, tmp_path, capsys):
    output = made[0]
    options = ["--no-relight", "--json", *SMALL]
    place = tmp_path / "out"
    command = ["paper", str(room.asset), str(brighter.asset), "-o", str(place), *options]
    assert main(command) == 0
    assert checked(capsys.readouterr().out, "paper")["relighting"] is None
    again = json.loads((place / "paper.json").read_text("utf-8"))
    assert again["relighting"] is None
    assert "fig10" not in (place / "paper.md").read_text("utf-8")
    for name in again["files"]:
        if name not in ("paper.json", "paper.md"):
            assert (place / name).read_bytes() == (output / name).read_bytes(), name


def test_an_artists_edits_are_in_no_figure(room):
    asset = Asset.made(room.asset)
    before = asset.edits_layer.read_text("utf-8")
    root = f'over "{asset.name}" (active = false) {{}}'
    shown = len(_scene_of(asset).surfaces)
    try:
        asset.edits_layer.write_text(f"#usda 1.0\n{root}\n", "utf-8")
        assert len(_scene_of(asset).surfaces) == shown > 0
    finally:
        asset.edits_layer.write_text(before, "utf-8")


def test_an_output_inside_of_an_asset_is_refused(room, brighter):
    with pytest.raises(UsageError):
        usdbrdf.write_paper(room.asset, brighter.asset, brighter.asset / "paper")


@pytest.mark.parametrize("what", ["views", "other_views", "environment", "truth", "denoise"])
def test_what_cannot_be_had_is_refused_before_the_first_figure(
    room, brighter, tmp_path, monkeypatch, what
):
    monkeypatch.setattr("usdbrdf.paper.write_paper.agreement", pytest.fail)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    bad = tmp_path / "bad.exr"
    bad.write_bytes(b"none")
    of_views = {"environment", "truth"}
    options = PaperOptions(
        evaluate=usdbrdf.EvaluateOptions(**({what: bad} if what in of_views else {})),
        **({} if what in of_views else {what: "oidn" if what == "denoise" else bad}),
    )
    with pytest.raises(UsdBrdfError, match=r"bad\.exr|oidn"):
        write_paper(room.asset, brighter.asset, tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_changes_are_counted_apart():
    rows = [
        {"l2_baseline": 0.5, "l2_full": full, "flip_baseline": None, "flip_full": None}
        for full in (0.1, 0.3, 0.6, 0.5)
    ]
    found = changes(rows)
    assert found["l2"] == {
        "views": 4,
        "better_views": 2,
        "mean_improvement": pytest.approx(0.3),
        "worse_views": 1,
        "mean_deterioration": pytest.approx(0.1),
    }
    assert found["flip"]["views"] == 0
    assert found["flip"]["mean_improvement"] is None


def test_views_that_tell_most_are_kept():
    kept = TellingViews()
    empty = np.zeros((1, 1, 3), np.float32)
    for number, gain in enumerate((0.0, 0.3, 0.1, -0.2, 0.05)):
        row = {"number": number, "flip_baseline": 0.5, "flip_full": 0.5 - gain}
        kept.see(
            ScoredView(row=row, reference=empty, shown={}, counted=empty[..., 0] > 0, errors={})
        )
    assert [view.row["number"] for view in kept.chosen()] == [1, 3, 0, 4]


def view_of_size(width, height, number=0):
    """A view that counts in its left half and is off by 0.25 there."""
    counted = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    reference = np.full((height, width, 3), 0.5, np.float32)
    shown = dict.fromkeys(MODELS, np.where(counted[..., None], np.float32(0.75), reference))
    return ScoredView(
        row={"number": number, "flip_baseline": 0.5, "flip_full": 0.5},
        reference=reference,
        shown=shown,
        counted=counted,
        errors=dict.fromkeys(MODELS, np.full((height, width), 0.5, np.float32)),
    )


def test_views_are_kept_no_larger_than_they_are_shown():
    kept = TellingViews()
    kept.see(view_of_size(1920, 1280))
    (view,) = kept.chosen()
    assert view.counted.shape == (320, MOST_ACROSS)
    assert view.counted.mean() == 0.5
    for shown, flip in zip(view.shown.values(), view.errors.values(), strict=True):
        assert shown.shape == view.reference.shape == (320, MOST_ACROSS, 3)
        np.testing.assert_allclose(shown[view.counted], 0.75, atol=1e-6)
        np.testing.assert_allclose(flip, 0.5, atol=1e-6)
    small = view_of_size(300, 200)
    kept.see(small)
    assert kept._kept["last"][1] is small


def test_pictures_of_another_shape_are_not_stretched():
    sheet = views_sheet([view_of_size(300, 200), view_of_size(200, 300, 1)])
    # The second row's photograph, grey, is 133 pixels wide in a cell of 300, white beside it.
    row = sheet[204 + 100, :300]
    assert (row == 255).all(axis=1).sum() == 300 - 133
    assert (row[84:216] == 128).all()
