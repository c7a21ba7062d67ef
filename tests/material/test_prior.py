"""What is usual for a class."""

from __future__ import annotations

import pytest

from usdbrdf.material.verdict import usual_lobe


@pytest.mark.parametrize(
    ("class_name", "label", "wanted"),
    [
        ("wall", "", (0.6, 0.3)),
        ("", "Office-Chair 3", (0.4, 0.5)),
        # Of a compound the last word says what the thing is; the class is stronger than the name.
        ("", "paper towel", (0.9, 0.1)),
        ("", "towel paper", (0.7, 0.3)),
        ("screen", "wall", (0.02, 0.5)),
        ("thing", "mirror", (0.01, 1.0)),
        ("thing", "unheard of", None),
    ],
)
def test_the_class_is_found_by_its_words(class_name: str, label: str, wanted):
    assert usual_lobe(class_name, label) == wanted
