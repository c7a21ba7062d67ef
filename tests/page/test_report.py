"""The page carries what the asset says, in one file, and nothing that was not meant to leave."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Usd

import usdbrdf
from tests.page.conftest import data_of, fit_of
from usdbrdf.asset.maps import camera_hits
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict, UsageError
from usdbrdf.evaluation.evaluate_views import MODELS, ScoredView, measured_atlas, viewed_asset
from usdbrdf.model.material import turned_up
from usdbrdf.page import objects, views
from usdbrdf.page.capture import findings, warnings_of
from usdbrdf.page.daylight import _around, daylight
from usdbrdf.page.objects import undetermined_because, why
from usdbrdf.page.pictures import (
    _BACKGROUND,
    Seen,
    SurfaceMap,
    part_around,
    pictures_of_map,
    status_of,
)
from usdbrdf.page.report import page, report, shows_most
from usdbrdf.page.room import lamps, with_the_weakest_as_one
from usdbrdf.transport.environment import NO_SUN, Environment, Sun, directions_of_pixels
from usdbrdf.transport.rays import empty_hits


def pictures(text):
    return [
        base64.b64decode(found) for found in re.findall(r"data:image/jpeg;base64,([^\"]+)", text)
    ]


def test_every_object_is_there_with_the_numbers_of_its_prim(room, page_file):
    data = data_of(page_file.read_text("utf-8"))
    stage = Usd.Stage.Open(str(next(room.asset.glob("*.usda"))))
    meshes = [p for p in stage.Traverse() if p.GetAttribute("usdBrdf:label").HasAuthoredValue()]
    assert {row["prim"] for row in data["objects"]} == {str(p.GetPath()) for p in meshes}
    for row in data["objects"]:
        prim = stage.GetPrimAtPath(row["prim"])
        assert row["fit"] == prim.GetAttribute("usdBrdf:fit:status").Get()
        for name in ("phi", "psi"):
            stored = prim.GetAttribute(f"usdBrdf:fit:{name}")
            if stored.HasAuthoredValue():
                assert row[name] == pytest.approx(stored.Get(), abs=1e-4)
        assert row["why"].endswith(".")
    assert any(row["status"] == "lamp" for row in data["objects"])


def test_frames_views_and_maps_are_there(room, page_file):
    data = data_of(page_file.read_text("utf-8"))
    count = data["capture"]["frames"]
    assert len(data["rows"]) == len(data["map"]["cameras"]) == count
    assert all(row["exposure_s"] > 0 and 0 <= row["clipped"] <= 1 for row in data["rows"])
    assert all(0 <= value <= 1 for x, y, *_ in data["map"]["cameras"] for value in (x, y))
    assert 1 <= len(data["views"]) <= 8
    assert {m["name"] for m in data["maps"]} >= {
        *("lit", "coverage", "samples", "spread", "stderr", "irradiance", "albedo", "phi", "psi")
    }
    assert all(len(shown["pictures"]) == len(data["views"]) for shown in data["maps"])


def test_no_word_about_an_object_passes_for_a_picture_of_it(room):
    """Which those that no photograph shows have none of."""
    _, atlas = measured_atlas(room.asset)
    obj = atlas.scene.objects[0]
    told = objects._numbers(atlas, 0, obj, read_fit(atlas.stage, obj.prim_path), False)
    assert not {"frame", "photograph", "model"} & told.keys()
    assert told["material"] in ("dielectric", "diffuse")


def test_the_room_opens_as_one_of_the_frames_looks(room, page_file):
    first = data_of(page_file.read_text("utf-8"))["room"]["first"]
    asset, atlas = measured_atlas(room.asset)
    frames, lit = atlas.frames, viewed_asset(asset, atlas, None).lit
    turn = turned_up("Z", "Y")[:3, :3]
    places = [turn @ frames.camera(i).eye for i in range(len(frames))]
    chosen = int(np.linalg.norm(places - np.array(first["eye"]), axis=1).argmin())
    np.testing.assert_allclose(first["eye"], places[chosen], atol=1e-3)
    hits = camera_hits(lit.rays, frames, chosen, 64, 48)
    forward = turn @ -frames.camera(chosen).world_from_camera[:3, 2]
    along = np.array(first["target"]) - first["eye"]
    distance = np.median(hits.distance[hits.face >= 0])
    np.testing.assert_allclose(along, distance * forward, rtol=0.05, atol=0.05)


def test_it_is_the_frame_that_shows_most_objects_plainly():
    share = np.array([[0.9, 0.001, 0.001], [0.3, 0.003, 0], [0.4, 0.01, 0.001], [0.2, 0, 0.3]])
    assert shows_most(share) == 3
    assert shows_most(share[:3]) == 2
    assert shows_most(share[:1]) == 0


def test_a_few_texels_that_mirror_a_lamp_are_no_lamp(room):
    _, atlas = measured_atlas(room.asset)
    found = lamps(atlas, "Z")
    assert found
    own = atlas.texels.of_object(0)
    assert not atlas.emission[own].any()
    emission = atlas.emission.copy()
    some = SimpleNamespace(
        texels=atlas.texels, emission=emission, emissive=atlas.emissive, scene=atlas.scene
    )
    emission[own] = 1e-6 * emission.max()
    assert len(lamps(some, "Z")) == len(found)
    emission[own] = emission.max()
    assert len(lamps(some, "Z")) == len(found) + 1


def test_pictures_have_no_metadata_and_nothing_names_this_machine(room, page_file):
    text = page_file.read_text("utf-8")
    found = pictures(text)
    assert len(found) > 20
    for picture in found:
        assert picture.startswith(b"\xff\xd8")
        assert not any(word in picture for word in (b"Exif", b"GPS", b"http:", b"OpenImageIO"))
    packed = base64.b64decode(data_of(text)["room"]["glb"])
    for content in (text.encode("utf-8"), gzip.decompress(packed)):
        assert str(room.asset.parent).encode() not in content
        assert str(room.capture.folder.parent).encode() not in content


def test_a_page_without_photographs_has_none_and_none_of_their_names(room, page_file, tmp_path):
    names = {row["name"] for row in data_of(page_file.read_text("utf-8"))["rows"]}
    options = usdbrdf.ReportOptions(photographs=False)
    report(room.asset, tmp_path / "private.html", options)
    text = (tmp_path / "private.html").read_text("utf-8")
    data = data_of(text)
    assert names
    assert not any(name in text for name in names)
    assert not any("photograph" in row for row in (*data["objects"], *data["views"]))
    assert "photograph" in data_of(page_file.read_text("utf-8"))["views"][0]


def test_without_photographs_pixels_of_nothing_are_black():
    view = ScoredView(
        row={"number": 0, "view": "a"},
        reference=np.ones((4, 6, 3), np.float32),
        shown=dict.fromkeys(MODELS, np.ones((4, 6, 3), np.float32)),
        counted=np.arange(6) < np.full((4, 1), 3),
        errors=dict.fromkeys(MODELS, np.zeros((4, 6), np.float32)),
    )
    for model in MODELS:
        assert (views._shown(view, True).pictures[model] == 255).all()
        private = views._shown(view, False).pictures[model]
        np.testing.assert_array_equal(private[..., 0] == 255, view.counted)


def test_what_an_asset_is_called_is_no_part_of_the_page(page_file):
    data = data_of(page_file.read_text("utf-8"))
    label = "</script><script>alert(1)</script>"
    data["objects"][0]["label"] = label
    text = page(data)
    assert label not in text
    assert data_of(text)["objects"][0]["label"] == label


def test_views_that_evaluate_made_are_taken(room, page_file, tmp_path):
    low = usdbrdf.EvaluateOptions(samples_per_pixel=1, rays=8)
    made = usdbrdf.evaluate(room.asset, room.capture.manifest, tmp_path / "made", low)
    options = usdbrdf.ReportOptions(evaluation=tmp_path / "made")
    report(room.asset, tmp_path / "report.html", options)
    data = data_of((tmp_path / "report.html").read_text("utf-8"))
    assert [row["flip_full"] for row in data["plot"]] == [r["flip_full"] for r in made["frames"]]
    shown = data["views"][0]
    own = data_of(page_file.read_text("utf-8"))["views"][0]
    assert shown["size"] == own["size"]
    assert all(shown[name].startswith("data:image/jpeg") for name in ("photograph", "flip_full"))
    for document, words in (
        ({"asset": "another", "frames": made["frames"]}, "not of"),
        ({"frames": [{}]}, "no document of usdbrdf evaluate"),
    ):
        (tmp_path / "made/evaluation.json").write_text(json.dumps(document))
        with pytest.raises(InputRefused, match=rf"{words}.*\[report\.evaluation\]$"):
            report(room.asset, tmp_path / "other.html", options)
    assert not (tmp_path / "other.html").exists()


def test_pages_are_refused_where_they_may_not_lie(room, tmp_path):
    with pytest.raises(UsageError, match=r"\[report\.output\]$"):
        report(room.asset, room.asset / "report.html")
    with pytest.raises(UsageError, match=r"\.html"):
        report(room.asset, tmp_path / "report.pdf")
    (tmp_path / "taken.html").mkdir()
    with pytest.raises(OwnershipConflict, match="a folder has this name"):
        report(room.asset, tmp_path / "taken.html")
    assert not list(tmp_path.glob("*.pdf"))


@pytest.mark.parametrize("what", ["review", "views", "evaluation", "environment"])
def test_what_cannot_be_read_is_refused_before_the_long_work(room, tmp_path, monkeypatch, what):
    monkeypatch.setattr("usdbrdf.page.report.objects_in_frames", pytest.fail)
    folder = shutil.copytree(room.asset.parent, tmp_path / "made") / room.asset.name
    bad = tmp_path / "bad.exr"
    bad.write_bytes(b"none")
    given = {} if what == "review" else {what: bad}
    if what == "review":
        (folder / "review.usda").write_text("#usda 1.0\n( nonsense")
    elif what == "evaluation":
        (tmp_path / "evaluation.json").write_text("{}")
        given = {"evaluation": tmp_path}
    with pytest.raises(InputRefused, match=r"review\.usda|bad\.exr|evaluation\.json"):
        report(folder, tmp_path / "report.html", usdbrdf.ReportOptions(**given))
    assert not (tmp_path / "report.html").exists()


def test_a_page_that_cannot_be_written_is_refused_before_any_work(room, tmp_path, monkeypatch):
    monkeypatch.setattr("usdbrdf.page.report.page_data", pytest.fail)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(EnvironmentFailure, match=r"file.*\[environment\.io\]$"):
        report(room.asset, tmp_path / "file/report.html")
    assert (tmp_path / "file").read_text() == "mine"


def test_the_camera_of_a_part_sees_what_the_photograph_has_there(room, page_file):
    from usdbrdf.evaluation.evaluate_views import measured_atlas

    _, atlas = measured_atlas(room.asset)
    camera = atlas.frames.camera(0)
    part = part_around(camera, (0.5, 0.4, 0.7, 0.6))
    left, top, right, _ = part.pixels
    assert (left, top) <= (0.5 * camera.width, 0.4 * camera.height)
    shrink = part.camera.width / (right - left)
    points = camera.eye + np.random.default_rng(1).normal(size=(20, 3)) @ np.eye(3)
    points -= 9 * camera.world_from_camera[:3, 2]
    inside = (camera.project(points) - [left, top]) * shrink
    assert np.allclose(part.camera.project(points), inside, atol=0.02 * part.camera.width)


def test_the_texture_of_a_map_is_made_once_for_all_cameras():
    made = []
    values = np.full((4, 3), 0.5, np.float32)

    class Texture:
        def showing(self, _texels, shown):
            made.append(shown)
            return self

        def at(self, face, _u, _v):
            return np.where(face[:, None] >= 0, np.float32(0.5), np.float32(0)).repeat(3, axis=1)

    lit = SimpleNamespace(radiance=Texture(), texels=None)
    shown = SurfaceMap(name="lit", title="", legend="", values=values, direct=True)
    seen = [SimpleNamespace(face=np.array([0, -1]), u=None, v=None)] * 3
    pictures = list(pictures_of_map(lit, shown, seen, [(1, 2), (2, 1), (1, 2)]))
    assert len(made) == 1
    assert [picture.shape for picture in pictures] == [(1, 2, 3), (2, 1, 3), (1, 2, 3)]
    assert all((picture.reshape(2, 3)[0] == 128).all() for picture in pictures)
    assert all((picture.reshape(2, 3)[1] == _BACKGROUND).all() for picture in pictures)


def test_evidence_is_drawn_of_what_was_fitted_alone(monkeypatch):
    monkeypatch.setattr(objects, "_looked_at", lambda *_: None)
    monkeypatch.setattr(objects, "_pictures", lambda *_, **__: {})
    monkeypatch.setattr(objects, "_evidence", lambda *_: np.ones((1, 1)))
    drawn = [fit_of(status="measured"), fit_of(), fit_of(status="failed"),
             fit_of(contradiction=0.45)]  # fmt: skip
    left = [fit_of(evidence=math.nan), fit_of(directive="glass"), fit_of(model="transparent"),
            fit_of(status="lamp"), fit_of(status="unseen")]  # fmt: skip
    fits, count = drawn + left, len(drawn + left)
    monkeypatch.setattr(objects, "_numbers", lambda _a, i, *_: {"status": fits[i].status})
    where = Seen(
        share=np.full((1, count), 0.1, np.float32), box=np.zeros((1, count, 4), np.float32)
    )
    atlas = SimpleNamespace(frames=None, scene=SimpleNamespace(objects=[None] * count))
    rows = objects.object_rows(atlas, None, fits, where, [0], photographs=True, seed=0)
    assert ["costs" in row for row in rows] == [True] * len(drawn) + [False] * len(left)


def test_a_frame_is_read_and_traced_once_however_many_objects_it_shows(monkeypatch):
    """Object 0 has its target frame, 1 the frame that shows most of it, 3 that of frame 7 too; no
    frame shows 2."""
    read, traced, drawn = [], [], []
    pixels = SimpleNamespace(radiance=np.zeros((1, 1, 3)), valid=np.ones((1, 1), bool))
    monkeypatch.setattr(objects, "read_frame", lambda _, number: read.append(number) or pixels)
    monkeypatch.setattr(objects, "seen_in_frame", lambda _, view: traced.append(view.camera))
    monkeypatch.setattr(
        objects, "_numbers", lambda _a, i, *_: {"prim": i, "status": "undetermined"}
    )

    def pictures(frame, _seen, index, box, **_):
        assert frame.view.camera == frame.number
        drawn.append((index, frame.number, box.tolist()))
        return {"frame": frame.number}

    monkeypatch.setattr(objects, "_pictures", pictures)
    monkeypatch.setattr(objects, "_evidence", lambda *_: None)
    share = np.array([[0.1, 0.2, 0, 0.1], [0.3, 0.1, 0, 0.2]], np.float32)
    where = Seen(share=share, box=np.arange(8, dtype=np.float32).reshape(2, 4, 1))
    frames = SimpleNamespace(camera=int)
    atlas = SimpleNamespace(frames=frames, scene=SimpleNamespace(objects=[None] * 4))
    fits = [fit_of(target_frame=target) for target in (3, -1, -1, 7)]
    seen = SimpleNamespace(lit=None)
    rows = objects.object_rows(atlas, seen, fits, where, [3, 7], photographs=True, seed=0)
    assert [row["prim"] for row in rows] == [0, 1, 2, 3]
    assert [row.get("frame") for row in rows] == [3, 3, None, 7]
    assert drawn == [(0, 3, [0]), (1, 3, [1]), (3, 7, [7])]
    assert read == traced == [3, 7]


def test_of_more_lamps_than_a_page_can_light_the_weakest_are_one():
    lamps = [
        {"prim": f"/r/{i}", "label": str(i), "place": [float(i), 0, 0], "intensity": [p, p, 2 * p]}
        for i, p in enumerate((1.0, 9.0, 3.0, 8.0))
    ]
    assert with_the_weakest_as_one(lamps, 4) == lamps
    first, second, rest = with_the_weakest_as_one(lamps, 3)
    assert [first, second] == [lamps[1], lamps[3]]
    assert (rest["prim"], rest["label"]) == ("", "2 weaker lamps, as one")
    assert rest["place"] == [1.5, 0, 0]
    assert rest["intensity"] == [4, 4, 8]


def test_the_counts_of_all_objects_are_told_and_hundreds_of_lamps_in_one_sentence():
    words = ["measured", "undetermined", "failed", "failed", "unseen", "lamp"]
    lamps = {f"bulb_{i}": 1.0 for i in range(200)}
    found = {"texture": {}, "shade": {"estimated_emitters": lamps}}
    told = findings(found, words, True)
    assert "The fit of 2 failed: their photographs do not determine the numbers." in told
    assert len(told) == 6
    assert told[-1].startswith("The lamps bulb_0, bulb_1,")
    assert told[-1].endswith(" and 194 more clipped everywhere: their radiances are estimates.")
    alone = findings({"texture": {}, "shade": {"estimated_emitters": {"bulb": 1}}}, words, True)
    assert alone[-1] == "The lamp bulb clipped everywhere: its radiance is an estimate."
    hidden = {f"bulb_{i}" for i in range(199)} | {"stage"}
    shown, unseen = findings(found, words, True, hidden)[-2:]
    assert shown == "The lamp bulb_199 clipped everywhere: its radiance is an estimate."
    assert unseen.startswith("No photograph measures the lamps bulb_0, bulb_1,")
    assert unseen.endswith(" and 193 more: their radiances are estimates.")
    parts = findings({"texture": {}, "shade": {}}, ["lamp"], True, (), ["table", "shelf"])
    assert parts[1:] == ["1 is a lamp.", "Parts of table, shelf shine, too."]
    (one,) = (line for line in findings({"texture": {}, "shade": {}}, ["failed"], True)[1:])
    assert one == "The fit of 1 failed: its photographs do not determine the numbers."


def test_where_no_step_left_its_record_warnings_are_not_said_to_be_none():
    steps = ("ingest", "texture", "shade", "fit")
    nothing = {step: {} for step in steps}
    assert warnings_of(nothing) is None
    assert warnings_of({**nothing, "fit": {"objects": {}}}) == []
    assert warnings_of({**nothing, "shade": {"warnings": ["dark"]}}) == ["dark"]


def test_nothing_that_a_photograph_shows_is_said_to_be_in_none():
    share = np.array([[0, 0.1, 0], [0, 0, 0]], np.float32)
    assert Seen(share=share, box=np.zeros((2, 3, 4), np.float32)).in_sight.tolist() == [0, 1, 0]
    assert undetermined_because(fit_of(), "unseen", in_sight=True) == "glimpsed"
    assert undetermined_because(fit_of(), "unseen") == "unseen"
    told = findings({"texture": {}, "shade": {}}, ["unseen", "glimpsed", "glimpsed"], True)
    assert told[1:] == [
        "Photographs hardly show 2: nothing on them was measured, and everything but a colour is a "
        "guess.",
        "No photograph shows 1 of the objects.",
    ]
    assert why(fit_of(), "unseen", None, in_sight=False).startswith("No photograph shows it: ")
    assert why(fit_of(), "unseen", None, in_sight=True).startswith("Photographs hardly show it")
    assert why(fit_of(), "unseen", None, glimpsed=True) == (
        "Photographs show it only together with what is beside it: its colour is about that, and "
        "everything else about it is a guess."
    )
    texture = {"measured_fraction": 0.8, "clipped_fraction": 0.01, "glimpsed_fraction": 0.02}
    told = findings({"texture": texture, "shade": {}}, [], True)
    assert told[1] == (
        "Photographs measured 80.0% of the surface; 1.00% clipped in all that show it; 2.00% is "
        "too thin for that and was glimpsed; the rest is filled in from around it."
    )
    told = findings({"texture": {"measured_fraction": 0.8}, "shade": {}}, [], True)
    assert told[1] == (
        "Photographs measured 80.0% of the surface; 0.00% clipped in all that show it; the rest is "
        "filled in from around it."
    )


@pytest.mark.parametrize(
    ("status", "observed", "told"),
    [
        ("measured", True, "It shines; its radiance was measured."),
        ("estimated", True, "It shines and clipped in every photograph: its radiance is estimated "
         "from the light that it casts."),
        ("estimated", False, "It shines where no photograph measures it: its radiance is estimated "
         "from the light that it casts."),
        ("lowerBound", True, "It shines and clipped in every photograph: its radiance is a lower "
         "bound."),
    ],
)  # fmt: skip
def test_of_a_lamp_it_is_said_why_its_radiance_is_what_it_is(status, observed, told):
    shading = SimpleNamespace(radiance_status=status, directive="")
    assert why(fit_of(), "lamp", shading, observed=observed) == told


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_the_sky_lies_around_the_room_as_the_viewer_looks_it_up(up_axis):
    image = np.zeros((16, 32, 3), np.float32)
    image[5, 11] = 1
    looks = directions_of_pixels(16, 32, up_axis == "Z")[5, 11]
    x, y, z = turned_up(up_axis, "Y")[:3, :3] @ looks
    around = _around(Environment(image, up_axis == "Z"), turned_up(up_axis, "Y")[:3, :3])
    height, width, _ = around.shape
    row = (0.5 - np.arcsin(y) / np.pi) * height
    column = (0.5 + np.arctan2(z, x) / (2 * np.pi)) * width
    assert around[int(row), int(column)].tolist() == [1, 1, 1]
    assert around[..., 0].mean() == pytest.approx(image[..., 0].mean())


def test_daylight_is_told_with_what_it_brings_and_how_sure_that_is(room):
    asset, atlas = measured_atlas(room.asset)
    dark = viewed_asset(asset, atlas, "none").lit
    assert daylight(atlas, dark, "none", "Z", 1.0) is None
    sun = Sun(np.array([0.0, 0.6, 0.8]), np.array([3.0, 2.0, 1.0]))
    light = Environment(np.full((4, 8, 3), 0.5, np.float32), True).under(sun)
    nothing = SimpleNamespace(
        closest=lambda _, directions: empty_hits(len(directions))._replace(
            face=np.full(len(directions), -1, np.int32)
        )
    )
    told = daylight(atlas, replace(dark, environment=light, rays=nothing), "none", "Z", 1.0)
    assert not told["estimated"]
    assert told["sky"]["error"] is told["sun"]["error"] is None
    # Nothing is in the way here: the sky brings pi L, the sun its irradiance times the cosine.
    assert told["sky"]["direct"] == pytest.approx([np.pi / 2] * 3, rel=1e-5)
    assert told["sun"]["direction"] == pytest.approx(turned_up("Z", "Y")[:3, :3] @ sun.direction)
    texels = atlas.texels
    cosine = np.maximum(texels.normal @ sun.direction, 0)
    mean = np.average(cosine, weights=np.where(texels.interior, texels.area, 0))
    assert told["sun"]["direct"] == pytest.approx(mean * sun.irradiance, rel=0.05)
    assert (
        daylight(atlas, replace(dark, environment=light.under(NO_SUN)), "none", "Z", 1.0)["sun"]
        is None
    )


def test_an_object_without_a_name_is_called_by_its_identifier(room):
    _, atlas = measured_atlas(room.asset)
    objects_ = [replace(obj, label="  ") for obj in atlas.scene.objects]
    unnamed = SimpleNamespace(
        texels=atlas.texels,
        emission=atlas.emission,
        emissive=atlas.emissive,
        scene=SimpleNamespace(objects=objects_),
    )
    found = lamps(unnamed, "Z")
    assert found
    assert {lamp["label"] for lamp in found} <= {obj.identifier for obj in objects_}


def test_a_copy_without_its_photographs_is_told_what_it_lacks(room, tmp_path):
    copy = tmp_path / "elsewhere" / "deeper" / "room"
    shutil.copytree(room.asset, copy)
    with pytest.raises(
        InputRefused, match=r"room: (\d+) of its \1 photographs are not there"
    ) as no:
        report(copy, tmp_path / "page.html")
    assert "[report.photographs]" in str(no.value)
    # Which a version that was published without them has not.
    (copy / "layers/photographs.usdc").unlink()
    with pytest.raises(InputRefused, match=r"room: it has no layers/photographs\.usdc"):
        report(copy, tmp_path / "page.html")


@pytest.mark.parametrize("gone", ["contents.usda", "scan.interface.usda", "shading.usda"])
def test_an_asset_that_nobody_can_open_has_no_page(room, tmp_path, gone):
    shutil.copytree(room.asset, tmp_path / "room")
    (tmp_path / "room/layers" / gone).unlink()
    with pytest.raises(InputRefused, match=rf"{gone}: this layer.*\[asset\.incomplete\]$"):
        report(tmp_path / "room", tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_texels_that_mirror_daylight_are_no_lamp(room):
    _, atlas = measured_atlas(room.asset)
    strength = max(sum(lamp["intensity"]) for lamp in lamps(atlas, "Z"))
    assert lamps(atlas, "Z", 1e4 * strength) == []


def test_things_that_shine_in_part_are_no_lamps_by_name(room):
    _, atlas = measured_atlas(room.asset)
    shines = next(i for i in range(len(atlas.scene.objects)) if status_of(atlas, i, None) == "lamp")
    own, name = atlas.texels.of_object(shines), atlas.scene.objects[shines].name
    assert name in {lamp["label"] for lamp in lamps(atlas, "Z")}
    atlas.emission[own.start + (own.stop - own.start) // 8 : own.stop] = 0
    atlas.emissive[own.start + (own.stop - own.start) // 8 : own.stop] = False
    assert f"part of {name}" in {lamp["label"] for lamp in lamps(atlas, "Z")}
