"""Which test proves which row of the fault list: ``python tests/faults/listing.py`` writes
docs/faults.md from rows.json and from the markers ``@pytest.mark.fault(row, *cases)`` in tests/.

A marker without cases speaks for all cases of its test, within ``pytest.param`` for that one.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
PAGE = TESTS.parent / "docs" / "faults.md"
_HEAD = """# What happens when something is wrong

Made by `python tests/faults/listing.py` from the tests that prove it; a test holds it up to date.
Exit 0 with a warning is 7 with `--strict`. Tests are named by their file below `tests/`, of several
cases those in brackets.

| row | fault | what happens | exit | tests |
| --- | --- | --- | --- | --- |
"""


def rows() -> dict[str, dict[str, str]]:
    """The fault list: row -> fault, happens, exit."""
    found: dict[str, dict[str, str]] = json.loads(
        (TESTS / "faults" / "rows.json").read_text("utf-8")
    )
    return found


def marks() -> Iterator[tuple[str, str, str, tuple[str, ...]]]:
    """Row, file, test and cases of every marker."""
    for file in sorted(TESTS.rglob("test_*.py")):
        name = file.relative_to(TESTS).as_posix()
        for function in ast.parse(file.read_text("utf-8")).body:
            if not isinstance(function, ast.FunctionDef):
                continue
            for decorator in function.decorator_list:
                for node in ast.walk(decorator):
                    if isinstance(node, ast.Call) and _is_mark(node.func):
                        row, *cases = [str(ast.literal_eval(value)) for value in node.args]
                        yield row, name, function.name, tuple(cases)


def _is_mark(function: ast.expr) -> bool:
    return isinstance(function, ast.Attribute) and ast.unparse(function) == "pytest.mark.fault"


def page() -> str:
    """The text of docs/faults.md."""
    tests: dict[str, dict[str, None]] = {row: {} for row in rows()}
    for row, file, function, cases in marks():
        shown = f" ({'; '.join(cases)})" if cases else ""
        tests[row][f"`{file}` {function.removeprefix('test_')}{shown}"] = None
    lines = [
        f"| {row} | {said['fault']} | {said['happens']} | {said['exit']} "
        f"| {'<br>'.join(tests[row])} |"
        for row, said in rows().items()
    ]
    return _HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
