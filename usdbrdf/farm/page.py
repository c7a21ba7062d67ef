"""One page over all scans, in the look of their reports, with a link to each: text and its style,
no script, nothing that is loaded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from urllib.parse import quote

from usdbrdf.farm.table import Row, counted, time_told
from usdbrdf.job.stamp import code_version
from usdbrdf.page.static_parts import static_part

# Of a status -> the class whose colour the reports give to what is alike.
_LOOKS = {
    "good": "measured", "invalid": "failed", "refused": "failed", "crashed": "failed",
    "defect": "failed", "unfinished": "undetermined", "begun": "undetermined", "waiting": "unseen",
}  # fmt: skip


def page_of(rows: Sequence[Row], name: str) -> str:
    """The document; what scans or people wrote is escaped."""
    objects, measured = (sum(getattr(row, key) for row in rows) for key in ("objects", "measured"))
    spent = time_told(sum(row.seconds for row in rows))
    parts = {
        "STYLE": static_part("page.css"),
        "NAME": escape(name),
        "LEAD": escape(
            f"{counted(rows)}; {measured} of {objects} objects measured, {spent} of work"
        ),
        "ROWS": "\n".join(map(_row, sorted(rows, key=lambda row: row.status == "good"))),
        "VERSION": escape(code_version()),
    }
    return re.sub(r"/\*([A-Z]+)\*/", lambda mark: parts[mark[1]], static_part("scans.html"))


def _row(row: Row) -> str:
    name = escape(row.name)
    if row.page:
        name = f'<a href="{escape(quote(row.page))}">{name}</a>'
    figures = ["", "", ""]
    if row.status in ("good", "invalid"):
        figures = [f"{row.measured} of {row.objects}", str(row.warnings), time_told(row.seconds)]
    cells = "".join(f'<td class="number">{escape(figure)}</td>' for figure in figures)
    return (
        f'<tr><th scope="row">{name}</th>'
        f'<td><span class="status {_LOOKS[row.status]}">{escape(row.status)}</span></td>{cells}'
        f'<td>{escape(row.sentence)}</td><td class="soft">{escape(row.scan)}</td></tr>'
    )
