"""Identifiers from hostile labels."""

import hashlib
import random
import re

import pytest
from pxr import Sdf

from usdbrdf.files.naming import ends_of, identifier_from, readable_label, unique_identifiers


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


def suffix(text):
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:8]


def test_suffixes_are_of_the_label_and_of_how_often_it_occurred():
    names = unique_identifiers(["a b", "a b", "A-B", "a b", "c"])
    assert names == [
        "a_b", f"a_b_{suffix('1:a b')}", f"A_B_{suffix('0:A-B')}", f"a_b_{suffix('2:a b')}", "c",
    ]  # fmt: skip
    # Whose suffix is a label of its own.
    taken = f"a_b_{suffix('1:a b')}"
    assert unique_identifiers(["a b", "a b", taken]) == ["a_b", f"a_b_{suffix('2:a b')}", taken]


def test_known_names_are_nobodys():
    assert unique_identifiers(["chair", "x"], known=["Chair"]) == [
        f"chair_{suffix('0:chair')}",
        "x",
    ]
    assert unique_identifiers(["", "\u6905"], fallback="part") == [
        "part",
        f"part_{suffix('0:' + chr(0x6905))}",
    ]


def test_long_names_keep_room_for_their_suffix():
    whole = "a" * 64
    first, second, third = unique_identifiers([whole, whole + "b", whole + "c"])
    assert first == whole
    assert (second, third) == tuple("a" * 55 + "_" + suffix(f"0:{whole}{c}") for c in "bc")


@pytest.mark.parametrize("name", ["aux", "CON", "Nul", "prn", "com0", "COM9", "lpt0", "lpt9"])
def test_names_of_devices_are_no_files(name):
    assert identifier_from(name) == f"_{name}"
    assert identifier_from(name + "0") == name + "0"


def test_labels_keep_what_usd_can_store():
    assert readable_label("Stuhl\tN\u00ba 1\x7f\x85") == "Stuhl\ufffdN\u00ba 1\ufffd\ufffd"
    assert readable_label("\ud800a") == "?a"


@pytest.mark.parametrize(
    ("path", "ends"),
    [
        ("/home/me/a.exr", ["home/me/a.exr", "me/a.exr", "a.exr"]),
        ("C:\\scans\\a.exr", ["scans/a.exr", "a.exr"]),
        ("~/scan//./a.exr", ["scan/a.exr", "a.exr"]),
        ("../old/images/a.exr", ["old/images/a.exr", "images/a.exr"]),
        ("x/../../a.exr", []),
        ("/etc/..", []),
        ("https://host/images/a.exr", []),
        ("", []),
    ],
)
def test_ends_of_paths_that_lead_elsewhere(path, ends):
    assert ends_of(path) == ends


def test_of_endless_paths_few_ends_are_asked():
    assert len(ends_of("/x" * 5000)) <= 16
