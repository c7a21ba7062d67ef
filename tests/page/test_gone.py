"""What was said of objects that are gone is on the page, for everybody, and can be taken back."""

from __future__ import annotations

from tests.page.conftest import SCREENS, data_of, shuts_out
from usdbrdf.asset.review import Judgement, read_review, review_file, write_review
from usdbrdf.page.report import page, reviewed

GONE = "/room/geo/sofa/sofa"


def test_what_was_said_of_an_object_that_is_gone_is_shown_and_taken_back(opened, served, tmp_path):
    asset, data, address = served
    prim, kept = (
        data["objects"][0]["prim"],
        Judgement(verdict="accept", status="undetermined", phi=0.5),
    )
    sofa = Judgement(
        verdict="reject", comment="not ours\nask Anna", directive="metal", status="undetermined"
    )
    write_review(asset, {prim: kept, GONE: sofa})
    # A page that is a file hands all of it over, as long as nobody takes it back.
    (tmp_path / "page.html").write_text(page({**data, **reviewed(asset)}), "utf-8")
    for address_of_page in ((tmp_path / "page.html").as_uri(), address):
        shown = opened(address_of_page)
        item = shown.locator("#gone li")
        told = [
            GONE,
            "rejected",
            "for the next run: metal",
            "Take back",
            "",
            "not ours",
            "ask Anna",
        ]
        assert item.inner_text().split("\n") == told
        if address_of_page == address:
            break
        with shown.expect_download() as download:
            shown.get_by_role("button", name="Save verdicts").click()
        download.value.save_as(asset.folder / "review.usda")
        assert read_review(asset) == {prim: kept, GONE: sofa}
    shown.get_by_role("button", name=f"Take back what was said of {GONE}").press("Enter")
    undo = shown.get_by_role("button", name=f"Taken back: undo of what was said of {GONE}")
    assert undo.evaluate("x => x === document.activeElement")
    assert shown.locator("#saved").inner_text() == "not saved yet"
    undo.press("Enter")
    assert shown.locator("#saved").inner_text() == ""
    shown.get_by_role("button", name=f"Take back what was said of {GONE}").press("Enter")
    shown.get_by_role("button", name="Save verdicts").click()
    shown.get_by_text("saved in review.usda").wait_for()
    assert shown.locator("#gone *").count() == 0
    assert read_review(asset) == {prim: kept}
    assert shown.faults == []
    assert opened(address).locator("#gone li").count() == 0


@SCREENS
def test_what_was_said_of_what_is_gone_shuts_nobody_out(opened, page_file, tmp_path, width, scheme):
    data = data_of(page_file.read_text("utf-8"))
    nothing = {"verdict": "", "comment": "", "directive": ""}
    data["review"] = {
        GONE: {**nothing, "verdict": "reject", "comment": "x" * 200},
        "/room/geo/" + "y" * 200: {**nothing, "verdict": "accept"},
        **{f"/room/geo/o{i}": {**nothing, "directive": "metal"} for i in range(200)},
    }
    (tmp_path / "page.html").write_text(page(data), "utf-8")
    shown = opened(
        (tmp_path / "page.html").as_uri(),
        viewport={"width": width, "height": 900}, color_scheme=scheme,
    )  # fmt: skip
    gone = shown.locator("#gone")
    gone.get_by_role("button").first.press("Enter")
    wide = "x => x.scrollWidth - x.clientWidth"
    assert shown.locator("html").evaluate(wide) <= 0
    for part in ("ul", "li"):
        assert gone.locator(part).first.evaluate(wide) <= 0, part
    # However much it is, verdicts can be saved without a way past all of it.
    assert gone.bounding_box()["height"] < 900
    assert shuts_out(shown) == {}


def test_verdicts_on_a_version_are_handed_over_and_not_refused_once_they_are_given(opened, served):
    asset, data, address = served
    data["published"] = "v001"  # which writes nothing
    shown, label = opened(address), data["objects"][0]["label"]
    shown.get_by_role("button", name=label, exact=True).click()
    shown.get_by_role("group", name=f"Your verdict on {label}").get_by_label("accept").check()
    with shown.expect_download() as download:
        shown.get_by_role("button", name="Save verdicts").click()
    assert (
        "of the asset that this version was published from" in shown.locator("#saved").inner_text()
    )
    assert not review_file(asset).exists()
    download.value.save_as(review_file(asset))
    assert read_review(asset)[data["objects"][0]["prim"]].verdict == "accept"
    assert shown.faults == []
