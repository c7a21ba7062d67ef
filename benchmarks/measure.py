"""What the speed benchmarks share: command line, clocks, ratios measured side by side, figures,
their table and files."""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import LitScene

T = TypeVar("T")


class Spent(NamedTuple):
    """Seconds: of all threads of this process together, and on the clock."""

    cpu: float
    wall: float

    def over(self, other: Spent) -> Spent:
        return Spent(self.cpu / other.cpu, self.wall / other.wall)

    def __truediv__(self, count: float) -> Spent:
        return Spent(self.cpu / count, self.wall / count)

    def __add__(self, other: tuple[Any, ...]) -> Spent:
        return Spent(self.cpu + other[0], self.wall + other[1])


def timed(work: Callable[[], T]) -> tuple[T, Spent]:
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return result, Spent(time.process_time() - cpu, time.perf_counter() - wall)


def side_by_side(works: Sequence[Callable[[], Any]], repeats: int) -> list[list[Spent]]:
    """Each work's times, taken in turns: what else the machine does then falls on all alike."""
    times: list[list[Spent]] = [[] for _ in works]
    for _ in range(repeats):
        for own, work in zip(times, works, strict=True):
            own.append(timed(work)[1])
    return times


def ratio(numerator: Sequence[Spent], denominator: Sequence[Spent]) -> Spent:
    """Median of the turns' ratios."""
    turns = [a.over(b) for a, b in zip(numerator, denominator, strict=True)]
    return median(turns)


def median(times: Sequence[Spent]) -> Spent:
    return Spent(*(statistics.median(values) for values in zip(*times, strict=True)))


def figure(what: str, value: float, unit: str, least: float = -1e99, most: float = 1e99) -> dict:
    """One line of the table; bounds are what was asked for."""
    asked = f">= {least:g}" if least > -1e99 else f"<= {most:g}" if most < 1e99 else ""
    holds = least <= value <= most
    return {"figure": what, "value": value, "unit": unit, "asked": asked, "holds": bool(holds)}


def table(figures: Sequence[dict]) -> str:
    lines = ["| figure | measured | asked | holds |", "| --- | --- | --- | --- |"]
    for item in figures:
        holds = ("yes" if item["holds"] else "no") if item["asked"] else ""
        value = f"{item['value']:.3g} {item['unit']}".strip()
        lines.append(f"| {item['figure']} | {value} | {item['asked']} | {holds} |")
    return "\n".join(lines)


class Lit(NamedTuple):
    """An asset as shading sees it."""

    atlas: AssetMaps
    scene: LitScene


def lit_asset(folder: Path) -> Lit:
    atlas = AssetMaps(open_measured(Asset.at(folder)))
    return Lit(atlas, atlas.lit_scene(black_environment()))


def saved_plot(drawing: Any, path: Path) -> Path:
    """Write a figure of pyplot's to ``path``, and let it go."""
    from matplotlib import pyplot

    drawing.savefig(path, dpi=120)
    pyplot.close(drawing)
    return path


def parser_of(
    description: str | None, *paths: str, quick: str | None = None
) -> argparse.ArgumentParser:
    """The command line: ``paths`` by position, -o and --quick, which ``quick`` explains."""
    parser = argparse.ArgumentParser(description=(description or "").split("\n")[0])
    for name in paths:
        parser.add_argument(name, type=Path)
    parser.add_argument("-o", "--output", type=Path, help="folder for what is printed, and plots")
    parser.add_argument("--quick", action="store_true", help=quick)
    return parser


def report(
    name: str,
    results: dict[str, Any],
    folder: Path | None,
    plot: Callable[[dict[str, Any], Path], Path] | None = None,
) -> None:
    """Print ``results`` and the table of their figures; write NAME.json and the plot."""
    print(json.dumps(results, indent=2))
    print(table(results["figures"]))
    if folder is None or "skipped" in results:
        return
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(results, indent=2) + "\n")
    if plot is not None:
        plot(results, folder)
