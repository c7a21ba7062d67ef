"""Every row of the fault list has its test, and the page that says so is that of the tests."""

from __future__ import annotations

import pytest

from tests.faults.listing import PAGE, TESTS, marks, page, rows


def test_every_row_has_a_test_and_every_marker_a_row():
    marked = {row for row, *_ in marks()}
    assert rows().keys() - marked == set(), "rows without a test"
    assert marked - rows().keys() == set(), "markers of no row"
    assert len(rows()) == 86


def test_cases_that_are_named_are_there():
    for row, file, function, cases in marks():
        text = (TESTS / file).read_text("utf-8")
        for case in cases:
            # Once in the marker, once in the table of cases.
            assert text.count(f'"{case}"') >= 2, (row, file, function, case)


def test_the_page_is_up_to_date():
    if PAGE.read_text("utf-8") != page():
        pytest.fail("docs/faults.md is old: run python tests/faults/listing.py")
