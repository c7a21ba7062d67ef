"""Verdicts are kept beside the edits, tell what changed since, and change nothing else."""

from __future__ import annotations

import math
import os
import re
from dataclasses import replace

import pytest
from pxr import Sdf, Usd

from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.review import (
    Judgement,
    changes_since,
    judgements_of,
    notes_for_run,
    read_review,
    review_file,
    write_review,
)
from usdbrdf.errors import InputRefused
from usdbrdf.page.capture import findings
from usdbrdf.page.objects import undetermined_because, why

CHAIR, WALL = "/room/geo/Stuhl_No_1/Stuhl_No_1", "/room/geo/wall/wall"


def fit(**numbers):
    usual = {"status": "measured", "phi": 0.25, "psi": 0.5, "evidence": 0.5}
    return FittedObject(
        prim_path=CHAIR, identifier="chair", cost=0.0, target_frame=0,
        num_pixels=9, method="views", **usual | numbers,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({}, r"by directive\.$"),
        (
            {"status": "undetermined"},
            r"by directive\. Dielectrics explain the photographs no worse\.$",
        ),
        (
            {"status": "undetermined", "psi_confidence": "low"},
            r"\. Its numbers are not known well\.$",
        ),
        (
            {"status": "undetermined", "f0_error": math.nan},
            r"One frame cannot tell whether it is one\.$",
        ),
        ({"status": "undetermined", "model": "dielectric"}, r"photographs do not show enough\.$"),
    ],
)
def test_of_a_metal_by_directive_the_page_says_no_more_than_is_known(numbers, told):
    sure = {"phi_confidence": "high", "psi_confidence": "high", "f0_error": 0.01}
    found = fit(**{"directive": "metal", "model": "conductor", **sure, **numbers})
    assert re.search(told, why(found, found.status, None))


def test_of_what_is_seen_through_page_and_run_say_so():
    found = fit(status="undetermined", contradiction=0.45)
    assert "Its views contradict by 45% that it is a surface" in why(found, "undetermined", None)
    assert "shows the outside through it" not in why(fit(), "undetermined", None)
    pane = why(fit(status="undetermined", model="transparent"), "undetermined", None)
    assert pane.startswith("Photographs show the outside through it")
    assert not fit().doubts
    (told,) = found.doubts
    assert told.startswith("chair: 45% of its light changes between views ")


@pytest.mark.parametrize(
    ("numbers", "reason", "told"),
    [
        ({}, "undetermined", "1 is not determined: no photograph shows a clear highlight"),
        ({"evidence": math.nan}, "sparse", "1 is seen in too few pixels for a fit"),
        ({"contradiction": 0.45}, "contradicted", "The views of 1 contradict that it is a surface"),
        ({"directive": "glass", "evidence": math.nan}, "told", "1 was not fitted, by directive."),
        ({"model": "transparent"}, "pane", "1 is a pane before the outside."),
    ],
)
def test_the_page_tells_apart_why_numbers_are_not_determined(numbers, reason, told):
    found = fit(status="undetermined", **numbers)
    assert undetermined_because(found, "undetermined") == reason
    assert undetermined_because(found, "lamp") == "lamp"
    steps = {"texture": {}, "shade": {}}
    (said,) = findings(steps, [reason], True)[1:]
    assert said.startswith(told)
    assert findings(steps, [reason] * 3, True)[1].replace("The views of 3", "3").startswith("3 ")


def test_what_is_said_comes_back_and_is_metadata_alone(built):
    asset = built.asset
    said = {
        CHAIR: {"verdict": "reject", "comment": 'too "green"\n\\ really é', "directive": "metal"},
        WALL: {"verdict": "", "comment": "", "directive": ""},
    }
    write_review(asset, judgements_of(asset, said))
    found = read_review(asset)
    assert set(found) == {CHAIR}
    assert found[CHAIR].comment == said[CHAIR]["comment"]
    assert (found[CHAIR].verdict, found[CHAIR].directive) == ("reject", "metal")
    stage = Usd.Stage.Open(str(asset.root_layer))
    prim = stage.GetPrimAtPath(CHAIR)
    assert found[CHAIR].status == prim.GetAttribute("usdBrdf:fit:status").Get()
    layer = Sdf.Layer.FindOrOpen(str(review_file(asset)))
    specs = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: specs.append(path))
    assert not any(path.IsPropertyPath() for path in specs)
    assert layer.defaultPrim == "room"


def test_equal_words_are_equal_bytes_and_the_edits_stay(built):
    asset = built.asset
    edits = asset.edits_layer.read_bytes()
    said = {CHAIR: {"verdict": "accept"}, WALL: {"comment": "flat,\n\t平 \u202eflat"}}
    write_review(asset, judgements_of(asset, said))
    first = review_file(asset).read_bytes()
    write_review(asset, judgements_of(asset, dict(reversed(said.items()))))
    assert review_file(asset).read_bytes() == first
    assert asset.edits_layer.read_bytes() == edits


@pytest.mark.parametrize(
    "said",
    [
        [],
        {"/room/geo/nobody": {"verdict": "accept"}},
        {CHAIR: {"verdict": "maybe"}},
        {CHAIR: {"directive": "gold"}},
        {CHAIR: {"comment": "x" * 2001}},
        {CHAIR: {"comment": "what follows a zero byte \0 a layer loses"}},
        {CHAIR: {"comment": "half a character \ud83d"}},
        {CHAIR: {"comment": "\x1b]0;what a terminal obeys\a"}},
        {CHAIR: {"comment": 3}},
        {CHAIR: "accept"},
    ],
)
def test_what_a_page_may_not_say_is_refused_and_nothing_written(built, said):
    with pytest.raises(InputRefused, match=r"\[review\.\w+\]$"):
        judgements_of(built.asset, said)
    assert not review_file(built.asset).exists()


def test_a_verdict_says_what_changed_since():
    judged = Judgement(verdict="accept", status="measured", phi=0.25, psi=0.5)
    assert judged.change(fit()) == ""
    assert judged.change(fit(phi=0.2501)) == ""
    told = judged.change(fit(status="undetermined", phi=0.4))
    assert told == (
        "accepted as measured, phi 0.25, psi 0.50; now not determined, phi 0.40, psi 0.50."
    )
    assert Judgement(phi=0.1, psi=0.1).change(fit()) == ""
    assert "now unknown" in judged.change(None)


def test_a_changed_number_is_found_in_the_asset(built):
    asset = built.asset
    write_review(asset, judgements_of(asset, {CHAIR: {"verdict": "accept"}}))
    assert changes_since(asset) == {}
    write_review(asset, {CHAIR: Judgement(verdict="accept", status="measured", phi=0.9, psi=0.1)})
    assert set(changes_since(asset)) == {CHAIR}
    # Said again without a new word, the verdict stays about what was judged then.
    again = judgements_of(asset, {CHAIR: {"verdict": "accept"}})
    assert again[CHAIR].phi == 0.9
    assert math.isnan(Judgement().phi)


def test_a_run_tells_what_changed_and_what_was_asked_for(built):
    asset = built.asset
    said = Judgement(verdict="accept", directive="metal", status="measured", phi=0.9, psi=0.1)
    write_review(asset, {CHAIR: said})
    changed, asked = notes_for_run(asset)
    assert changed.startswith(f"<{CHAIR}> accepted as measured, phi 0.90, psi 0.10; now ")
    will = "which the step fit will follow when it runs."
    assert asked == f"<{CHAIR}> asks for 'metal', {will}"
    built.fitted = tuple(
        replace(item, directive="metal") if item.prim_path == CHAIR else item
        for item in built.fitted
    )
    built.write_layer("material")
    assert notes_for_run(asset)[1] == f"<{CHAIR}> was made as 'metal', as the directive asks."


def test_a_run_tells_of_objects_that_are_gone(built):
    write_review(built.asset, {"/room/geo/sofa/sofa": Judgement(directive="metal")})
    gone = "</room/geo/sofa/sofa> is no object any more: what is said of it is passed over."
    assert notes_for_run(built.asset) == [gone]


def test_what_was_said_of_an_object_that_is_gone_can_be_taken_back_and_nothing_else(built):
    gone, chair = "/room/geo/sofa/sofa", Judgement(verdict="accept", phi=0.9)
    write_review(built.asset, {gone: Judgement(directive="metal"), CHAIR: chair})
    with pytest.raises(InputRefused, match=r"no object of this asset.*\[review\.page\]$"):
        judgements_of(built.asset, {gone: {"verdict": "accept"}})
    write_review(built.asset, judgements_of(built.asset, {gone: {"verdict": ""}}))
    assert read_review(built.asset) == {CHAIR: chair}
    with pytest.raises(InputRefused, match=r"no object of this asset"):
        judgements_of(built.asset, {gone: {"verdict": ""}})


@pytest.mark.parametrize(
    "content",
    [
        "#usda 1.0\n( nonsense",
        "PXR-USDC",
        "#usda 1.0\n" + 'over "a" {\n' * 100_000 + "}\n" * 100_000,
    ],
)
def test_a_review_that_is_no_layer_is_named(built, content):
    review_file(built.asset).write_text(content)
    with pytest.raises(InputRefused, match=r"review\.usda.*\[review\.layer\]$"):
        read_review(built.asset)
    assert changes_since(built.asset) == {}


def test_a_review_that_is_too_large_is_called_so(built):
    review_file(built.asset).write_text("#usda 1.0\n" + "# words\n" * (1 << 20))
    with pytest.raises(InputRefused, match=r"review\.usda: this has 8,388,618 bytes, at most"):
        read_review(built.asset)
    assert changes_since(built.asset) == {}


@pytest.mark.fault("I13")
@pytest.mark.parametrize("what", ["folder", "pipe", "link that leads nowhere"])
def test_what_is_in_the_place_of_a_review_is_named_and_not_taken_for_none(built, what):
    file = review_file(built.asset)
    file.unlink(missing_ok=True)
    if what == "folder":
        file.mkdir()
    elif what == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("gone/review.usda")
    with pytest.raises(InputRefused, match=r"review\.usda: this is no regular file.*\[review"):
        read_review(built.asset)
    file.rmdir() if what == "folder" else file.unlink()
