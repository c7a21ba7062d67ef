"""Strict JSON: what is refused, where, and that our own documents pass."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.files import documents
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.files.tables import csv_rows


@pytest.fixture
def read(tmp_path):
    def run(text):
        path = tmp_path / "doc.json"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_json(path)

    return run


def test_plain_documents(read):
    text = '\ufeff{"a": [1, -2.5e3, true, null, "x\\"[", "NaN"], "b": {"a": 9223372036854775807}}'
    assert read(text) == {
        "a": [1, -2500.0, True, None, 'x"[', "NaN"],
        "b": {"a": 9223372036854775807},
    }


@pytest.mark.parametrize(
    "number", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "9223372036854775808", "1" * 5000]
)
def test_numbers_that_are_not_finite(read, number):
    text = f'{{"a": "NaN 1e999",\n\n "b": [1.0, {number}]}}'
    with pytest.raises(InputRefused, match=r"doc\.json:3: the number .+\[document\.nonfinite\]$"):
        read(text)


@pytest.mark.fault("C13")
@pytest.mark.parametrize(
    "text",
    [
        '{"a": 1,\n"b": {"a": 2},\n"a": 3}',
        '[{"x": []},\n{"a": {"b": 1},\n"\\u0061": 3}]',
        '{"a": 1, "x": {"b": 1},\n"b": {"c": [{"b": 2}], "d": 3}, "d": 1,\n"a": 3}',
    ],
)
def test_key_twice(read, text):
    with pytest.raises(InputRefused, match=r"doc\.json:3: the key 'a' .+\[document\.duplicate\]$"):
        read(text)


@pytest.mark.fault("C13")
@pytest.mark.parametrize("text", ["", "{", '{"a": 1,}', "[1, 2", "nan", "{'a': 1}", '{"a": 1} x'])
def test_malformed(read, text):
    with pytest.raises(InputRefused, match=r"doc\.json:1: not valid JSON.+\[document\.json\]$"):
        read(text)


def test_line_of_malformed(read):
    with pytest.raises(InputRefused, match=r"doc\.json:3: "):
        read('{"a": 1,\n"b": 2\n"c": 3}')


def test_not_utf8(read):
    with pytest.raises(InputRefused, match=r"byte 2 is not UTF-8.+\[document\.json\]$"):
        read(b'["\xff"]')


@pytest.mark.parametrize("damaged", ["[1]".encode("utf-16")[:-1], b"\xff\xfe[\x00\x00\xd8"])
def test_damaged_utf16_is_called_so(read, damaged):
    with pytest.raises(InputRefused, match=r"is not UTF-16, as its mark says\. Save.+json\]$"):
        read(damaged)


@pytest.mark.parametrize("row", ['"a.jpg,1,2', 'a.jpg,"1,2\nb.jpg,3,4'])
def test_a_quote_that_nobody_closes_is_refused(tmp_path, row):
    (tmp_path / "a.csv").write_text(f"name,x,y\n0.jpg,0,0\n{row}\n")
    said = r"a\.csv: .*quote.* '" + row[:4] + r".*\[document\.table\]$"
    with pytest.raises(InputRefused, match=said):
        csv_rows(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text('name,x,y\n"a ""b"", c",1,"2"\n')
    assert csv_rows(tmp_path / "a.csv") == ({"name": 'a "b", c', "x": "1", "y": "2"},)


def test_a_name_is_no_number_with_a_decimal_comma(tmp_path):
    (tmp_path / "a.csv").write_text("#name;x\n1,5;2,5\n")
    assert csv_rows(tmp_path / "a.csv") == ({"name": "1,5", "x": "2.5"},)


@pytest.mark.fault("C13")
def test_depth(read, monkeypatch):
    assert read("[" * 64 + "]" * 64)
    for depth in (65, 200_000):
        with pytest.raises(InputRefused, match=r"deeper than 64 levels.+\[document\.depth\]$"):
            read("[" * depth + "]" * depth)
    monkeypatch.setattr(documents, "MAX_DEPTH", 1)
    assert read('{"a": 1}')
    with pytest.raises(InputRefused, match="deeper than 1 "):
        read('{"a": {}}')


@pytest.mark.fault("C13")
def test_size(read, monkeypatch):
    monkeypatch.setattr(documents, "MAX_BYTES", 10)
    with pytest.raises(InputRefused, match=r"11 bytes.+limit of 10.+\[document\.size\]$"):
        read('["1234567"]')


@pytest.mark.fault("I13")
def test_not_a_regular_file(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path, tmp_path / "fifo", tmp_path / "none", tmp_path / ("x" * 300)):
        with pytest.raises(InputRefused, match=r"\[document\.missing\]$"):
            read_json(path)


def test_a_disk_that_fails_is_not_the_document_s_fault(tmp_path, monkeypatch):
    def fails(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    (tmp_path / "doc.json").write_text("{}")
    monkeypatch.setattr(Path, "read_bytes", fails)
    with pytest.raises(EnvironmentFailure, match=r"doc\.json: .*\[environment\.io\]$"):
        read_json(tmp_path / "doc.json")


def test_written_documents_read_back_and_do_not_depend_on_order(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    write_json(one, {"b": np.float64(0.1), "a": ("椅子", np.int32(3), True)})
    write_json(two, {"a": ["椅子", 3, np.bool_(True)], "b": 0.1})
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes().endswith(b"}\n")
    assert read_json(one) == {"a": ["椅子", 3, True], "b": 0.1}


@pytest.mark.parametrize("value", [float("nan"), object(), np.zeros(3)])
def test_what_is_not_json_is_our_bug(tmp_path, value):
    with pytest.raises(UsdBrdfError, match=r"\[document\.write\]$"):
        write_json(tmp_path / "x", {"a": value})
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_are_not_finite_where_the_caller_judges_them(tmp_path):
    path = tmp_path / "document.json"
    path.write_text('{"frames": [{"pose": [[NaN, 1e999, -Infinity]]}], "w": 1.0}')
    found = read_json(path, nonfinite_below=("pose",))
    assert not np.isfinite(found["frames"][0]["pose"]).any()
    with pytest.raises(InputRefused, match=r"document\.nonfinite"):
        read_json(path)
    path.write_text('{"frames": [{"pose": [NaN]}],\n "w": NaN}')
    with pytest.raises(InputRefused, match=r"document\.nonfinite"):
        read_json(path, nonfinite_below=("pose",))
    path.write_text('{"pose": [NaN, 99999999999999999999999]}')
    with pytest.raises(InputRefused, match=r"document\.nonfinite"):
        read_json(path, nonfinite_below=("pose",))
