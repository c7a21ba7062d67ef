"""Rows of numbers, CSV and XML: what counts as one, where it ends, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.files import tables
from usdbrdf.files.tables import (
    beginning_of,
    beginning_of_text,
    csv_rows,
    files_of,
    number_in,
    number_rows,
    numbers_among,
    numbers_of,
    read_xml,
)


def test_files_are_those_of_a_folder_that_end_so_in_any_case(tmp_path: Path):
    for name in ("b.CSV", "a.csv", "c.txt", "csv"):
        (tmp_path / name).touch()
    (tmp_path / "d.csv").mkdir()
    assert [file.name for file in files_of(tmp_path, {".csv"})] == ["a.csv", "b.CSV"]
    assert files_of(tmp_path / "c.txt", {".csv", ".txt"}) == [tmp_path / "c.txt"]
    assert files_of(tmp_path / "c.txt", {".csv"}) == []
    assert files_of(tmp_path / "none.csv", {".csv"}) == []


def test_a_glance_reads_the_beginning_and_of_what_is_no_file_nothing(tmp_path: Path):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1999 + b"yz")
    assert beginning_of(path) == b"x" * 1999 + b"y"
    assert beginning_of(path, 3) == b"xxx"
    assert beginning_of(tmp_path) == beginning_of(tmp_path / "none") == b""
    path.write_bytes("größe".encode("utf-16"))
    assert beginning_of_text(path).strip("\ufeff") == "größe"
    path.write_bytes(b"a\xffb")
    assert beginning_of_text(path) == "a\ufffdb"


def test_rows_of_numbers_are_what_remarks_leave(tmp_path: Path):
    path = tmp_path / "rows.txt"
    path.write_text("# 1 2\n\n1 2.5,3e2 # 4\n  \n,nan\t-inf,\n7\n")
    rows = number_rows(path)
    assert [row.tolist() for row in rows[::2]] == [[1, 2.5, 300], [7]]
    assert np.isnan(rows[1][0])
    assert rows[1][1] == -np.inf
    assert rows[0].dtype == np.float64
    assert [len(number_rows(path, most=most)) for most in (0, 1, 2, 3, 9)] == [0, 1, 2, 3, 3]
    path.write_text("1 2\n\n3 x\n")
    with pytest.raises(InputRefused, match=r"rows\.txt:3: not a row.*'3 x'.*\[document.table\]$"):
        number_rows(path)
    # What comes after those that are wanted is nobody's matter.
    assert [row.tolist() for row in number_rows(path, most=1)] == [[1, 2]]


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("a,b\n1,2\n", [("1", "2")]),
        ("a;b\n1,5;2\n", [("1.5", "2")]),
        ("a\tb\n1\t-2,5e-3\n", [("1", "-2.5e-3")]),
        ("sep=;\na;b\n1,5;x,y\n", [("1.5", "x,y")]),
        ("\ufeffSEP=|\n# A | b\n 1 | 2 \n", [("1", "2")]),
        # Before the header, between the rows, and below them.
        ("made by hand\na,b\n\n1,2\n# 3,4,5\n,\nend\n3,4\n", [("1", "2"), ("3", "4")]),
        ("x,y\na,b\n1,2\n", [("1", "2")]),
        # As many of one as of the other: the first counts.
        ("a,b;c\n1,2;3\n", [("1", "2;3")]),
        ("a,b\n", []),
    ],
)
def test_tables_as_programs_write_them(tmp_path: Path, text: str, rows: list[tuple[str, str]]):
    path = tmp_path / "a.csv"
    path.write_text(text, "utf-8")
    wanted = "b;c" if "b;c" in text else "b"
    found = csv_rows(path, {"a", wanted})
    assert [tuple(row.values()) for row in found] == rows
    assert all(list(row) == ["a", wanted] for row in found)


@pytest.mark.parametrize("text", ["", "\n", "a\n1\n", "a,c\n1,2\n", "sep=,\n"])
def test_a_table_without_the_header_is_refused(tmp_path: Path, text: str):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputRefused, match=r"a\.csv: no table with a header.*\[document.table\]$"):
        csv_rows(tmp_path / "a.csv", {"a", "b"})


@pytest.mark.parametrize("row", ["1,2,3", "x,2,3", "1"])
def test_a_row_with_numbers_of_another_length_is_refused(tmp_path: Path, row: str):
    (tmp_path / "a.csv").write_text(f"a,b\n1,2\n{row}\n")
    said = rf"'{row.replace(',', ', ')}' has {len(row.split(','))} values under 2 names"
    with pytest.raises(InputRefused, match=said):
        csv_rows(tmp_path / "a.csv")


def test_xml_is_its_root_however_long_the_document(tmp_path: Path):
    path = tmp_path / "a.xml"
    path.write_text("<a x='1'>" + "<b>2</b>" * 20_000 + "</a>")
    root = read_xml(path)
    assert (root.tag, root.get("x"), len(root), root[-1].text) == ("a", "1", 20_000, "2")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<!DOCTYPE a><a/>", "with a document type"),
        ("<a><!entity x 'y'></a>", "with a document type"),
        ("<a><b></a>", "not valid XML"),
        ("<a>", "not valid XML"),
        ("", "XML"),
    ],
)
def test_xml_that_is_none_is_refused(tmp_path: Path, text: str, said: str):
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(InputRefused, match=said + r".*\[document\.xml\]$"):
        read_xml(tmp_path / "a.xml")


def test_xml_is_nested_as_deeply_as_other_documents_may_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tables, "MAX_DEPTH", 3)
    path = tmp_path / "a.xml"
    path.write_text("<a><b><c/><c/></b><b><c/></b></a>")
    assert len(read_xml(path)) == 2
    path.write_text("<a><b><c><d/></c></b></a>")
    with pytest.raises(InputRefused, match=r"deeper than 3 levels.*\[document\.depth\]$"):
        read_xml(path)


def test_numbers_are_as_many_as_asked_for_and_finite(tmp_path: Path):
    path = tmp_path / "a.xml"
    path.write_text("<a><b> 1 -2.5\n3 </b><b>1 2 nan</b><b>1 x 2</b><b/></a>")
    numbers, not_finite, words, empty = read_xml(path)
    found = numbers_of(numbers, 3)
    assert found is not None
    assert found.tolist() == [1, -2.5, 3]
    for element, count in ((numbers, 2), (numbers, 4), (not_finite, 3), (words, 3), (empty, 1)):
        assert numbers_of(element, count) is None
    assert numbers_of(None, 1) is None
    none = numbers_of(None, 0)
    assert none is not None
    assert none.size == 0


@pytest.mark.parametrize(
    ("value", "count", "found"),
    [
        ([1, 2.5], 2, [1, 2.5]),
        ([[1, "2"], ["3", 4]], 4, [1, 2, 3, 4]),
        (7, 1, [7]),
        ("7e1", 1, [70]),
        ([1, 2], 1, None),
        ([1, 2], 3, None),
        ([1, None], 2, None),
        ([1, float("inf")], 2, None),
        ([1, "x"], 2, None),
        ([1, [2, 3]], 3, None),
        ([10**400], 1, None),
        ({"a": 1}, 1, None),
    ],
)
def test_numbers_among_others_are_as_many_as_asked_for(
    value: object, count: int, found: list[float] | None
):
    numbers = numbers_among(value, count)
    assert (None if numbers is None else numbers.tolist()) == found


def test_the_number_of_a_row_stands_under_the_first_name_that_it_has():
    row = {"a": "", "b": "1.5", "c": "x", "d": "inf", "e": None, "f": "0"}
    assert number_in(row, "a", "e", "g", "b", "c") == 1.5
    assert number_in(row, "f", "b") == 0
    for names in (("c", "b"), ("d",), ("a",), ("g",), ()):
        assert number_in(row, *names) is None
