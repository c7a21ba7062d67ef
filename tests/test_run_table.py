"""The table at the end of a run says what its steps found."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.run_table import table


def _fit(status: str, **known: float | None) -> dict[str, object]:
    none = {"phi": None, "psi": None, "phi_error": None, "psi_error": None, "psi_upper": None}
    return {"status": status, **none, **known}


STEPS = {
    "ingest": {"warnings": ["one frame is dropped"]},
    "texture": {"measured_fraction": 0.79, "clipped_fraction": 0.002, "warnings": []},
    "shade": {"emitters": ["globe"], "warnings": ["S is noisy"]},
    "fit": {
        "objects": {
            "chair": _fit("measured", phi=0.2, psi=0.5, phi_error=0.02, psi_error=0.03),
            "globe": _fit("undetermined", phi=0.5, psi=0.5, phi_error=0.29, psi_error=0.29),
            "rug": _fit(
                "undetermined", phi=0.9, psi=0.0, phi_error=0.29, psi_error=0.1, psi_upper=0.2
            ),
            "shelf": _fit("unseen"),
        }
    },
}
ROOT = Path("out/room/room.usda")


def test_objects_by_status_and_what_needs_a_look():
    lines = table(STEPS, ROOT)
    assert lines[0].split(maxsplit=1)[1] == "4: 1 measured, 1 lamp, 1 not determined, 1 unseen"
    text = "\n".join(lines)
    assert "rug  phi 0.90 +- 0.29, psi 0.00 +- 0.10, psi below 0.20" in text
    assert "shelf" in text
    # What is sure needs no look, and a lamp's lobe is nobody's business.
    assert "chair" not in text
    assert "globe" not in text
    assert "79% of the texels measured, 0.2% clipped in every frame" in text
    assert any(line.split() == ["warnings", *line.split()[1:]] and " 2," in line for line in lines)
    assert lines[-2].endswith("usdbrdf report out/room -o out/room.html")
    spaced = table(STEPS, Path("our room/it.usda"))[-2]
    assert spaced.endswith("usdbrdf report 'our room' -o 'our room.html'")
    assert lines[-1].split() == ["stage", str(ROOT)]


def test_what_a_person_left_out_needs_no_look():
    objects = {
        "pane": {**_fit("undetermined"), "directive": "glass"},
        "a": _fit("measured", phi=0.1),
    }
    lines = table({**STEPS, "fit": {"objects": objects}}, ROOT)
    assert lines[0].endswith("2: 1 measured, 1 not fitted, as a person asked")
    assert "pane" not in "\n".join(lines)


def test_a_pane_needs_no_look():
    objects = {
        "pane": {**_fit("undetermined"), "model": "transparent"},
        "a": _fit("measured", phi=0.1),
    }
    lines = table({**STEPS, "fit": {"objects": objects}}, ROOT)
    assert lines[0].endswith("2: 1 measured, 1 panes before the outside")
    assert "a look" not in "\n".join(lines)


def test_a_long_list_is_cut():
    objects = {f"thing_{i:02d}": _fit("undetermined", phi=0.5, psi=0.5) for i in range(40)}
    lines = table({**STEPS, "fit": {"objects": objects}}, ROOT)
    assert sum("thing_" in line for line in lines) == 12
    assert any("and 28 more" in line for line in lines)


def test_several_lightings():
    day, night = STEPS["shade"], {"emitters": ["rug"], "warnings": []}
    parts = {"day": STEPS["texture"], "night": {**STEPS["texture"], "measured_fraction": 0.5}}
    steps = {
        **STEPS,
        "shade": {"lightings": {"day": day, "night": night}, "warnings": []},
        "texture": {"lightings": parts, "warnings": []},
    }
    lines = table(steps, ROOT)
    assert "2 lamps" in lines[0]
    shown = [" ".join(line.split()) for line in lines]
    assert shown[1:3] == ["lamps 1 in day", "1 in night"]
    assert sum("of the texels measured in night" in line for line in shown) == 1


def test_of_a_single_step_there_is_none():
    assert table({"shade": STEPS["shade"]}, ROOT) == []
