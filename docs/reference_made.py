"""What mkdocs writes into the reference: commands from the command line's own help, attributes from
the table of properties."""

from __future__ import annotations

from typing import Any

from usdbrdf.asset.properties import RECORDS, facts_of
from usdbrdf.command_parser import EXIT_CODES, help_text
from usdbrdf.commands import COMMANDS


def on_page_markdown(markdown: str, **_named: Any) -> str:
    """Fill the places of a page that say what is to be made there."""
    for name, make in (("commands", commands), ("attributes", attributes)):
        place = f"<!-- made: {name} -->"
        if place in markdown:
            markdown = markdown.replace(place, make())
    return markdown


def commands() -> str:
    parts = []
    for name in COMMANDS:
        page = (help_text([name, "--help"], COMMANDS) or "").replace(EXIT_CODES, "").rstrip()
        parts.append(f"### {name}\n\n```text\n{page}\n```\n")
    return "\n".join([*parts, f"```text\n{EXIT_CODES}\n```\n"])


def attributes() -> str:
    rows = ["| attribute | type | meaning |", "| --- | --- | --- |"]
    for record in RECORDS:
        for _, fact in facts_of(record):
            about = " ".join(fact.doc.split()).replace("|", "\\|")
            rows.append(f"| `{fact.attribute()}` | `{fact.type}` | {about} |")
    return "\n".join(dict.fromkeys(rows)) + "\n"
