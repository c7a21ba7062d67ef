"""Identifiers from hostile labels."""

import random
import re

import pytest
from pxr import Sdf

from usdbrdf.files.naming import identifier_from, readable_label, unique_identifiers


@pytest.mark.parametrize(
    ("label", "identifier"),
    [
        ("chair", "chair"),
        ("chair_1", "chair_1"),
        ("Stuhl Nº 1", "Stuhl_No_1"),
        ("fenêtre/à gauche", "fenetre_a_gauche"),
        ("3rd chair", "_3rd_chair"),
        ("椅子", "object"),
        ("", "object"),
        ("../../etc/passwd", "etc_passwd"),
        ("</root>{look=lit}.attr", "root_look_lit_attr"),
        ("nul", "_nul"),
        ("a" * 500, "a" * 64),
    ],
)
def test_one_label(label, identifier):
    assert identifier_from(label) == identifier


@pytest.mark.fault("G11")
def test_labels_that_collide_get_a_suffix_and_the_exact_one_keeps_its_name():
    names = unique_identifiers(["a b", "a_b", "a-b", "A_B", "a_b"])
    assert names[1] == "a_b"
    assert len({name.lower() for name in names}) == 5
    assert all(re.fullmatch(r"[aA]_[bB]_[0-9a-f]{8}", n) for i, n in enumerate(names) if i != 1)


def test_names_depend_on_the_labels_alone():
    labels = ["chair", "chair", "椅子", "机", "Chair"]
    assert unique_identifiers(labels) == unique_identifiers(labels)
    assert unique_identifiers(labels)[:1] == ["chair"]


def random_label(rng):
    """Any code points, control characters and lone surrogates among them, often colliding."""
    ranges = [(0x20, 0x7F), (0, 0x300), (0xD800, 0xE000), (0x4E00, 0x9FFF), (0, 0x110000)]
    return "".join(
        chr(rng.randrange(*rng.choice(ranges))) for _ in range(rng.choice([0, 1, 3, 90]))
    )


@pytest.mark.fault("G11")
@pytest.mark.parametrize("seed", range(50))
def test_any_labels_give_legal_unique_names(seed):
    rng = random.Random(seed)
    labels = [random_label(rng) for _ in range(40)]
    names = unique_identifiers(labels)
    assert len({name.lower() for name in names}) == len(labels)
    for label, name in zip(labels, names, strict=True):
        assert Sdf.Path.IsValidIdentifier(name)
        assert len(name) <= 64
        assert name.isascii()
        readable_label(label).encode("utf-8")
        assert "\0" not in readable_label(label)


def test_a_good_label_is_stored_unchanged():
    assert readable_label("Stuhl Nº 1 椅子") == "Stuhl Nº 1 椅子"
