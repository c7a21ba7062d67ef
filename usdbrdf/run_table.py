"""What a run found, as the table that a person reads at its end: from the summaries of its steps
alone, those that ``--json`` prints."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

_MOST_ROWS = 12
# Of what status an object is -> how the table calls it, and what to do about those that need it.
_WORDS = {
    "measured": ("measured", ""),
    "lamp": ("lamps", ""),
    "unfitted": ("not fitted, as a person asked", ""),
    "pane": ("panes before the outside", ""),
    "bounded": ("bounded", ""),
    "undetermined": ("not determined", "frames that see highlights on them would tell"),
    "unseen": ("unseen", "frames show too little of them: all about them but a colour is a guess"),
    "failed": ("failed", "the target frame does not determine them"),
}
_NOT_FITTED = ("ignore", "glass")


def table(steps: Mapping[str, Mapping[str, Any]], root: Path) -> list[str]:
    """Lines about objects by their status, those that need a look, how much of the surface was
    seen, warnings, and where to go on; steps: of ``convert``, by name.

    Empty where a step is missing."""
    if not {"texture", "shade", "fit"} <= steps.keys():
        return []
    statuses = statuses_of(steps)
    rows = [("objects", f"{len(statuses)}: {', '.join(_counted(statuses))}")]
    rows += [("lamps", line) for line in _of_lamps(steps["shade"])]
    rows += [("a look", line) for line in _worth_a_look(steps["fit"]["objects"], statuses)]
    rows += [("surface", line) for line in _of_surface(steps["texture"])]
    doubts = sum(len(step.get("warnings", ())) for step in steps.values())
    if doubts:
        rows.append(("warnings", f"{doubts}, told above as they came; --json lists them"))
    rows.append(
        ("page", shlex.join(["usdbrdf", "report", str(root.parent), "-o", f"{root.parent}.html"]))
    )
    rows.append(("stage", str(root)))
    width = max(len(name) for name, _ in rows)
    before = ["", *(name for name, _ in rows)]
    return [
        f"  {name if name != last else '':{width}}  {text}"
        for last, (name, text) in zip(before, rows, strict=False)
    ]


def statuses_of(steps: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Of each object; a lamp's is that it shines, a pane's that a person said so."""
    parts = _parts(steps["shade"]).values()
    lamps = {name for part in parts for name in part.get("emitters", ())}
    return {
        name: "lamp"
        if name in lamps
        else "unfitted"
        if found.get("directive") in _NOT_FITTED
        else "pane"
        if found.get("model") == "transparent"
        else str(found["status"])
        for name, found in steps["fit"]["objects"].items()
    }


def _parts(step: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
    """The summaries of a step by its lightings, that of the only one by ""."""
    parts: Mapping[str, Mapping[str, Any]] = step.get("lightings", {"": step})
    return parts


def _of_lamps(shade: Mapping[str, Any]) -> Iterator[str]:
    """How many shine in each of several lightings: an object is a lamp that shines in any."""
    for lighting, part in _parts(shade).items():
        if lighting:
            yield f"{len(part.get('emitters', ()))} in {lighting}"


def _counted(statuses: Mapping[str, str]) -> Iterator[str]:
    found = [*statuses.values()]
    for status in dict.fromkeys((*_WORDS, *found)):
        if count := found.count(status):
            word = _WORDS.get(status, (status, ""))[0]
            yield f"{count} {word.removesuffix('s') if count == 1 else word}"


def _worth_a_look(objects: Mapping[str, Any], statuses: Mapping[str, str]) -> Iterator[str]:
    """Objects of each status that is none to rely on, with what is known of them."""
    for status, (word, advice) in _WORDS.items():
        names = [name for name, own in statuses.items() if own == status]
        if not advice or not names:
            continue
        yield f"{word}: {advice}"
        if status != "undetermined":
            yield from _listed(names)
            continue
        wide = max(len(name) for name in names[:_MOST_ROWS])
        yield from (f"  {name:{wide}}  {_known(objects[name])}" for name in names[:_MOST_ROWS])
        if len(names) > _MOST_ROWS:
            yield f"  and {len(names) - _MOST_ROWS} more"


def _listed(names: Sequence[str]) -> Iterator[str]:
    more = f" and {len(names) - _MOST_ROWS} more" if len(names) > _MOST_ROWS else ""
    yield f"  {', '.join(names[:_MOST_ROWS])}{more}"


def _known(found: Mapping[str, Any]) -> str:
    """phi and psi with their errors; of psi the bound, where it says more."""
    texts = []
    for name in ("phi", "psi"):
        value, error = found.get(name), found.get(f"{name}_error")
        known = "?" if value is None else f"{value:.2f}"
        texts.append(f"{name} {known} +- {error:.2f}" if error is not None else f"{name} {known}")
    upper = found.get("psi_upper")
    return ", ".join(texts) + (f", psi below {upper:.2f}" if upper and upper < 0.995 else "")


def _of_surface(texture: Mapping[str, Any]) -> Iterator[str]:
    for lighting, part in _parts(texture).items():
        clipped = part["clipped_fraction"]
        text = f"{part['measured_fraction']:.0%} of the texels measured"
        text += f" in {lighting}" if lighting else ""
        yield text + (f", {clipped:.1%} clipped in every frame" if clipped >= 0.0005 else "")
