"""The page in a real browser: every part is there and works, by mouse, keys and screen reader."""

from __future__ import annotations

import re
import shutil

import pytest

from tests.page.conftest import SCREENS, data_of, shuts_out
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.review import Judgement, changes_since, read_review, write_review
from usdbrdf.delivery.publish import publish
from usdbrdf.options import PublishOptions
from usdbrdf.page.report import page, report, reviewed


def test_all_parts_are_there_and_nothing_is_asked_of_others(opened, page_file):
    data = data_of(page_file.read_text("utf-8"))
    shown = opened(page_file.as_uri())
    assert shown.locator("#table tbody tr:not(.detail)").count() == len(data["objects"])
    assert shown.locator("#map circle").count() == data["capture"]["frames"]
    assert shown.locator("#plots svg").count() == 2
    assert shown.locator("#map-name option").count() == len(data["maps"])
    assert shown.locator("#carries li").count() >= 4
    assert shown.locator("#room-body").get_attribute("data-state") == "model"
    broken = "[...document.images].filter(i => i.src && !i.naturalWidth).length"
    assert shown.evaluate(broken) == 0
    assert shown.faults == []
    elsewhere = [url for url in shown.asked if not url.startswith(("data:", "blob:"))]
    assert elsewhere == [page_file.as_uri()]


def test_objects_are_sorted_filtered_and_opened_by_keys(opened, page_file):
    objects = data_of(page_file.read_text("utf-8"))["objects"]
    shown = opened(page_file.as_uri())
    heading = shown.get_by_role("columnheader", name="Roughness").get_by_role("button")
    heading.press("Enter")
    assert shown.locator("th[aria-sort=ascending]").inner_text().startswith("Roughness")
    order = shown.locator("#table tbody tr:not(.detail)").evaluate_all(
        "rows => rows.map(row => row.dataset.prim)"
    )
    phi = {row["prim"]: 9 if row["phi"] is None else row["phi"] for row in objects}
    assert [phi[prim] for prim in order] == sorted(phi.values())
    shown.get_by_label("Name contains").fill(objects[0]["label"])
    assert shown.locator("#count").inner_text().endswith(f"of {len(objects)} objects")
    name = shown.get_by_role("button", name=objects[0]["label"], exact=True)
    name.press("Enter")
    assert name.get_attribute("aria-expanded") == "true"
    detail = shown.locator(f"#{name.get_attribute('aria-controls')}")
    assert objects[0]["prim"] in detail.inner_text()
    assert detail.locator("img").count() == 2


def test_no_error_reads_as_none_and_what_shines_is_not_said_to_lack_pixels(
    opened, page_file, tmp_path
):
    data = data_of(page_file.read_text("utf-8"))
    data["objects"][0] |= {"status": "measured", "f0": None, "phi": 0.0042, "phi_error": 0.0031}
    data["objects"][1] |= {"status": "lamp"}
    data["objects"][1].pop("costs", None)
    (tmp_path / "page.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "page.html").as_uri())
    row = shown.locator(f"#table tbody tr[data-prim='{data['objects'][0]['prim']}']")
    assert "0.004 \u00b1 0.003" in row.inner_text()
    name = shown.get_by_role("button", name=data["objects"][1]["label"], exact=True)
    name.press("Enter")
    detail = shown.locator(f"#{name.get_attribute('aria-controls')}")
    assert "What shines by itself is not fitted." in detail.inner_text()


def test_every_column_and_number_of_the_trade_is_explained(opened, page_file):
    shown = opened(page_file.as_uri())
    headings = shown.locator("#table thead th").all_inner_texts()
    shown.get_by_text("What the columns mean").click()
    told = shown.locator("#words dt").all_inner_texts()
    assert set(headings) - set(told) == {"Picture", "Object", "Verdict"}
    shown.get_by_text("What these words mean").click()
    for word in ("FLIP", "Relative L2", "Diffuse baseline", "Full model"):
        assert shown.locator("#slider dt", has_text=word).is_visible()
    compared = shown.locator("#slider p").inner_text()
    assert re.search(r"[0-9]\.[0-9] % of the pixels are compared\.$", compared)


def test_the_slider_moves_over_the_views(opened, page_file):
    shown = opened(page_file.as_uri())
    slider, compared = shown.locator("#at"), shown.locator(".compare")
    before = shown.locator(".compare .over").bounding_box()
    slider.focus()
    for _ in range(10):
        slider.press("ArrowLeft")
    assert compared.evaluate("x => x.style.getPropertyValue('--at')") == "40%"
    clip = shown.locator(".compare .over").evaluate("x => getComputedStyle(x).clipPath")
    assert "60%" in clip
    first = shown.locator(".compare img").first.get_attribute("src")
    shown.get_by_role("button", name="next").click()
    assert shown.locator(".compare img").first.get_attribute("src") != first
    shown.get_by_role("combobox", name=re.compile("^Left")).select_option("baseline")
    assert shown.locator(".compare .tag.left").inner_text() == "diffuse baseline"
    assert before["width"] > 100


def test_picking_tells_the_numbers_of_what_is_picked(opened, page_file):
    objects = {row["prim"]: row for row in data_of(page_file.read_text("utf-8"))["objects"]}
    shown = opened(page_file.as_uri())
    canvas, picked = shown.locator("canvas"), {}
    for prim in objects:
        shown.evaluate("prim => usdbrdfModel.look(prim)", prim)
        canvas.press("Enter")
        found = picked[prim] = canvas.get_attribute("data-picked")
        row, text = objects[found], shown.locator(".picked").inner_text()
        assert row["label"] in text
        assert row["status"] == "lamp" or f"{row['phi']:.2f}" in text
    # Nothing stands between the box and where one stands first; the middle of the walls is air.
    box = next(prim for prim, row in objects.items() if row["label"] == "box")
    assert picked[box] == box
    assert len(set(picked.values())) >= 2
    for look in ("lit", "base_color", "phi", "psi", "status", "verdict", "shaded"):
        shown.locator("#look").select_option(look)
        explained = shown.locator("#look-legend").inner_text()
        assert bool(explained) == (look in ("phi", "psi", "status", "verdict")), look
    shown.get_by_role("group", name="Captured lamps").get_by_role("checkbox").first.uncheck()
    shown.get_by_label("strength").fill("1.5")
    shown.wait_for_timeout(300)
    assert shown.faults == []


def test_daylight_is_switched_on_and_off_and_named_for_what_it_is(opened, page_file, tmp_path):
    data = data_of(page_file.read_text("utf-8"))
    plain = opened(page_file.as_uri())
    assert plain.get_by_role("group", name=re.compile("Daylight")).count() == 0
    assert plain.locator("#look option").first.inner_text() == "lit by its lamps"
    sun = {"direction": [0.0, 1.0, 0.0], "irradiance": [3, 2, 1], "direct": [0.3, 0.2, 0.1]}
    sky = {"picture": data["views"][0]["full"], "direct": [0.2, 0.2, 0.4], "error": None}
    data["room"]["outside"] = {"estimated": True, "sky": sky, "sun": {**sun, "error": 0.11}}
    (tmp_path / "day.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "day.html").as_uri())
    assert shown.locator("#look option").first.inner_text() == "lit by its lamps and daylight"
    group, canvas = (
        shown.get_by_role("group", name="Daylight, as estimated"),
        shown.locator("canvas"),
    )
    assert group.get_by_role("checkbox").count() == 2
    canvas.scroll_into_view_if_needed()

    def picture():
        shown.wait_for_timeout(500)
        return canvas.screenshot()

    pictures = [picture()]
    for name in ("sun \u00b1 11 %", "sky"):
        group.get_by_role("checkbox", name=name, exact=True).uncheck()
        pictures.append(picture())
    assert len(set(pictures)) == 3
    assert shown.faults == []


def test_advice_and_warnings_are_written_in_signs(opened, page_file, tmp_path):
    data = data_of(page_file.read_text("utf-8"))
    pose = {"where": "Stand there.", "reason": "psi +-0.29 -> +-0.22; 61 m^2 that no frame shows."}
    data["advice"] = {"poses": [pose], "current": True}
    data["warnings"] = ["lamp: its radiance is 6.72, +-44 %."]
    (tmp_path / "advice.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "advice.html").as_uri())
    assert "6.72, \u00b144 %" in shown.locator("#warnings").inner_text()
    told = shown.locator("#advised li").inner_text()
    assert "psi \u00b10.29 \u2192\u00a0\u00b10.22; 61 m\u00b2" in told


def test_without_webgl_there_are_pictures(opened, page_file):
    shown = opened(
        page_file.as_uri(), script="HTMLCanvasElement.prototype.getContext = () => null;"
    )
    assert shown.locator("#room-body").get_attribute("data-state") == "pictures"
    assert shown.locator("#room-body img").count() > 0
    assert shown.faults == []


def judge(shown, label, words):
    shown.get_by_role("button", name=label, exact=True).click()
    group = shown.get_by_role("group", name=f"Your verdict on {label}")
    group.get_by_label("accept").check()
    group.get_by_label("Comment").fill(words)
    group.get_by_label("For the next run").select_option("refit")


def test_a_verdict_of_a_file_is_handed_over_as_a_layer(opened, page_file, room, tmp_path):
    row = next(r for r in data_of(page_file.read_text("utf-8"))["objects"] if r["phi"] is not None)
    shown = opened(page_file.as_uri())
    words = 'a "fine" one\\\nreally é'
    judge(shown, row["label"], words)
    with shown.expect_download() as download:
        shown.get_by_role("button", name="Save verdicts").click()
    folder = tmp_path / "room"
    shutil.copytree(room.asset, folder)
    download.value.save_as(folder / download.value.suggested_filename)
    found = read_review(Asset.made(folder))
    assert set(found) == {row["prim"]}
    said = found[row["prim"]]
    assert (said.verdict, said.comment, said.directive) == ("accept", words, "refit")
    assert (said.status, said.phi) == (row["fit"], pytest.approx(row["phi"]))


def test_verdicts_that_a_page_only_repeats_stay_of_what_was_judged(
    opened, page_file, room, tmp_path
):
    folder = tmp_path / "room"
    shutil.copytree(room.asset, folder)
    asset, data = Asset.made(folder), data_of(page_file.read_text("utf-8"))
    first, second = data["objects"][:2]
    write_review(
        asset,
        {first["prim"]: Judgement(verdict="reject", status="undetermined", phi=0.11, psi=0.22)},
    )
    (tmp_path / "again.html").write_text(page({**data, **reviewed(asset)}), "utf-8")
    shown = opened((tmp_path / "again.html").as_uri())
    judge(shown, second["label"], "good")
    shown.get_by_role("button", name=first["label"], exact=True).click()
    group = shown.get_by_role("group", name=f"Your verdict on {first['label']}")
    group.get_by_label("accept").check()
    group.get_by_label("reject").check()
    with shown.expect_download() as download:
        shown.get_by_role("button", name="Save verdicts").click()
    download.value.save_as(folder / "review.usda")
    found = read_review(asset)
    assert (found[first["prim"]].status, found[first["prim"]].phi) == ("undetermined", 0.11)
    assert found[second["prim"]].status == second["fit"]
    assert first["prim"] in changes_since(asset)


def test_a_verdict_of_a_served_page_is_saved_and_comes_back(opened, served):
    asset, data, address = served
    label = data["objects"][0]["label"]
    shown = opened(address)
    judge(shown, label, "good")
    shown.get_by_role("button", name="Save verdicts").click()
    shown.get_by_text("saved in review.usda").wait_for()
    assert shown.faults == []
    again = opened(address)
    again.locator("#filter-verdict").select_option("accept")
    assert again.locator("#count").inner_text() == f"1 of {len(data['objects'])} objects"
    assert read_review(asset)[data["objects"][0]["prim"]].comment == "good"


def test_a_page_that_was_opened_before_takes_nothing_back_that_others_said(opened, served):
    asset, data, address = served
    first, second = data["objects"][:2]
    write_review(asset, {first["prim"]: Judgement(verdict="accept", status="undetermined")})
    shown = opened(address)
    write_review(asset, {first["prim"]: Judgement(verdict="reject", status="undetermined")})
    judge(shown, second["label"], "good")
    shown.get_by_role("button", name="Save verdicts").click()
    shown.get_by_text("saved in review.usda").wait_for()
    found = read_review(asset)
    assert found[first["prim"]].verdict == "reject"
    assert found[second["prim"]].verdict == "accept"


@SCREENS
def test_nobody_is_shut_out(opened, page_file, width, scheme):
    shown = opened(
        page_file.as_uri(), viewport={"width": width, "height": 900}, color_scheme=scheme
    )
    shown.locator("button.name").first.click()
    assert shown.evaluate("document.documentElement.scrollWidth") <= width
    assert shuts_out(shown) == {}


@pytest.mark.parametrize("width", [1440, 390, 320])
def test_the_steps_between_views_stay_side_by_side(opened, page_file, width):
    shown = opened(page_file.as_uri(), viewport={"width": width, "height": 900})
    before, after = (
        shown.get_by_role("button", name=name, exact=True).bounding_box()
        for name in ("previous", "next")
    )
    assert before["y"] == after["y"]
    assert after["x"] - before["x"] - before["width"] < 12


@pytest.mark.parametrize("width", [1440, 390])
def test_figures_can_be_read_on_a_screen_of_any_width(opened, page_file, width):
    shown = opened(page_file.as_uri(), viewport={"width": width, "height": 900})
    texts = shown.locator("figure svg text").all()
    assert min(text.bounding_box()["height"] for text in texts) >= 10


@pytest.mark.parametrize("width", [1440, 390])
def test_long_names_do_not_widen_the_page(opened, page_file, tmp_path, width):
    long, data = 300 * "x", data_of(page_file.read_text("utf-8"))
    for named in (*data["objects"], *data["room"]["lamps"]):
        named["label"] = long
    for view in data["views"]:
        view["row"]["view"] = long
    data["warnings"], data["findings"] = [long], [long]
    (tmp_path / "long.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "long.html").as_uri(), viewport={"width": width, "height": 900})
    shown.locator("button.name").first.click()
    assert shown.evaluate("document.documentElement.scrollWidth") <= width
    for part in ("#table", "#capture", "#views", "#room fieldset"):
        inside = "x => x.scrollWidth <= x.clientWidth + 1"
        assert shown.locator(part).first.evaluate(inside), part


def test_metals_guesses_and_many_warnings_look_like_what_they_are(opened, page_file, tmp_path):
    data = data_of(page_file.read_text("utf-8"))
    metal, guess, *_ = (row for row in data["objects"] if row["status"] != "lamp")
    metal.update(f0=[0.9, 0.6, 0.3], psi=1.0, psi_confidence="high")
    unsure = {"f0": None, "phi_confidence": "none", "psi_confidence": "none"}
    guess.update(unsure, psi=0.0, psi_error=0.29, psi_upper=0.96)
    data["warnings"] = [f"number {i} is wrong" for i in range(12)]
    (tmp_path / "metal.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "metal.html").as_uri())
    cells = {
        prim: shown.locator(f'tr[data-prim="{prim}"] td.number')
        for prim in (metal["prim"], guess["prim"])
    }
    assert cells[metal["prim"]].nth(1).inner_text() == "metal"
    assert "F0 high" in shown.locator(f'tr[data-prim="{metal["prim"]}"]').inner_text()
    assert cells[guess["prim"]].nth(1).inner_text() == "0.00, below 0.96"
    colour = "x => getComputedStyle(x).color"
    assert cells[guess["prim"]].nth(1).evaluate(colour) == shown.locator("#lead").evaluate(colour)
    assert shown.locator("#warnings .warning:visible").count() == 8
    shown.get_by_text("4 more warnings").click()
    assert shown.locator("#warnings .warning:visible").count() == 12
    assert shown.faults == []


def test_what_is_bounded_is_found_by_its_status_and_tells_its_bound(opened, page_file, tmp_path):
    """The bound is told of the numbers that are hardly known, too, as the columns' words say."""
    data = data_of(page_file.read_text("utf-8"))
    bounded = next(row for row in data["objects"] if row["status"] != "lamp" and row.get("costs"))
    bounded |= {"status": "bounded", "because": "bounded", "f0": None, "material": "diffuse"}
    bounded |= {"psi": 0.16, "psi_error": 0.11, "psi_confidence": "low", "psi_upper": 0.37}
    bounded |= {"evidence": -0.001, "target": bounded["frame"]}
    (tmp_path / "bounded.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "bounded.html").as_uri())
    shown.get_by_label("Status").select_option("bounded")
    row = shown.locator("#table tbody tr:not(.detail):visible")
    assert row.count() == 1
    assert row.locator("td.number").nth(1).inner_text() == "0.16, below 0.37"
    assert row.locator("td.number").nth(2).inner_text() == "0 %"
    shown.get_by_role("button", name=bounded["label"], exact=True).click()
    detail = shown.locator("#table tbody tr.detail:visible").inner_text()
    assert "where a highlight would show best" in detail
    shown.get_by_label("Status").select_option("")
    shown.get_by_role("columnheader", name="Status").get_by_role("button").click()
    last = shown.locator("#table tbody tr:not(.detail) td:nth-child(3)").all_inner_texts()
    assert "bounded" in last
    assert set(last[last.index("bounded") + 1 :]) <= {"measured"}
    assert shown.faults == []


def test_what_was_not_fitted_says_why_and_shows_no_numbers(opened, page_file, tmp_path):
    data = data_of(page_file.read_text("utf-8"))
    pane, seen_through, *_ = (row for row in data["objects"] if row["status"] != "lamp")
    pane |= {"status": "undetermined", "because": "pane", "f0": None}
    pane.pop("costs", None)
    seen_through |= {"status": "undetermined", "because": "contradicted"}
    (tmp_path / "pane.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "pane.html").as_uri())
    row = shown.locator(f"#table tbody tr[data-prim='{pane['prim']}']")
    assert "clear glass" in row.inner_text()
    assert row.locator("td.number").first.inner_text() == "\u2013"
    shown.get_by_role("button", name=pane["label"], exact=True).click()
    detail = shown.locator("#table tbody tr.detail:visible").inner_text()
    assert "Clear glass is not fitted." in detail
    assert "confidence" not in detail
    shown.get_by_label("Status").select_option("contradicted")
    assert shown.locator("#table tbody tr:not(.detail):visible").count() == 1
    assert "seen through" in shown.locator("#table tbody tr:not(.detail):visible").inner_text()
    assert shown.faults == []


def test_the_page_of_a_version_says_which_it_is(opened, page_file, room, tmp_path):
    asset = Asset.made(room.asset)
    assert data_of(page_file.read_text("utf-8"))["published"] == ""
    for name in ("v001", "v002"):
        publish(
            asset.folder, tmp_path / "dest", PublishOptions(version=name, uri=f"studio://{name}")
        )
    report(tmp_path / "dest" / "v002", tmp_path / "second.html")
    shown = opened((tmp_path / "second.html").as_uri())
    assert shown.locator("h1").inner_text() == f"{asset.name} v002"
    assert shown.title().startswith(f"{asset.name} v002: ")


@pytest.mark.parametrize(
    ("warnings", "told"), [([], "No warnings."), (None, "What was warned of is not known here")]
)
def test_no_warning_is_told_apart_from_none_known(opened, page_file, tmp_path, warnings, told):
    data = {**data_of(page_file.read_text("utf-8")), "warnings": warnings, "room": None}
    (tmp_path / "quiet.html").write_text(page(data), "utf-8")
    shown = opened((tmp_path / "quiet.html").as_uri())
    assert shown.locator("#warnings").inner_text().startswith(told)
    assert shown.faults == []


def test_a_table_of_hundreds_leaves_the_rest_of_the_page_within_reach(opened, page_file, tmp_path):
    data = data_of(page_file.read_text("utf-8"))
    kinds = data["objects"]
    data["objects"] = [
        {**kinds[i % len(kinds)], "id": f"o{i}", "prim": f"/r/o{i}", "label": f"o {i}"}
        for i in range(300)
    ]
    (tmp_path / "many.html").write_text(page({**data, "room": None}), "utf-8")
    shown = opened((tmp_path / "many.html").as_uri(), viewport={"width": 1440, "height": 900})
    assert shown.locator("#objects").bounding_box()["height"] < 2 * 900
    region = shown.get_by_role("region", name="Table of objects")
    region.evaluate("x => { x.scrollTop = x.scrollHeight; }")
    box = region.bounding_box()
    heading = shown.get_by_role("columnheader", name="Roughness").bounding_box()
    assert box["y"] <= heading["y"] < box["y"] + 10
    assert shown.locator("#table tbody tr:not(.detail)").last.is_visible()
