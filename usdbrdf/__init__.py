"""usdbrdf: measured materials for captured rooms and objects, as non-destructive USD layers.

What is named below is loaded when it is first used. ``import usdbrdf`` alone loads nothing, and
makes OpenUSD know the schemas, whether that is loaded before or afterwards.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

    from usdbrdf.advice.advise import advise as advise
    from usdbrdf.cluster.options import ClusterOptions as ClusterOptions
    from usdbrdf.cluster.session import workers_of as workers_of
    from usdbrdf.delivery.package import package as package
    from usdbrdf.delivery.publish import publish as publish
    from usdbrdf.evaluation.compare_assets import compare as compare
    from usdbrdf.evaluation.evaluate_views import evaluate as evaluate
    from usdbrdf.options import AdviseOptions as AdviseOptions
    from usdbrdf.options import CompareOptions as CompareOptions
    from usdbrdf.options import ConvertOptions as ConvertOptions
    from usdbrdf.options import EvaluateOptions as EvaluateOptions
    from usdbrdf.options import FitOptions as FitOptions
    from usdbrdf.options import IngestOptions as IngestOptions
    from usdbrdf.options import Insert as Insert
    from usdbrdf.options import PackageOptions as PackageOptions
    from usdbrdf.options import PublishOptions as PublishOptions
    from usdbrdf.options import RelightOptions as RelightOptions
    from usdbrdf.options import ReportOptions as ReportOptions
    from usdbrdf.options import Sampling as Sampling
    from usdbrdf.options import ShadeOptions as ShadeOptions
    from usdbrdf.options import TextureOptions as TextureOptions
    from usdbrdf.page.report import report as report
    from usdbrdf.paper.options import PaperOptions as PaperOptions
    from usdbrdf.paper.write_paper import write_paper as write_paper
    from usdbrdf.pipeline import convert as convert
    from usdbrdf.pipeline import fit as fit
    from usdbrdf.pipeline import ingest as ingest
    from usdbrdf.pipeline import shade as shade
    from usdbrdf.pipeline import texture as texture
    from usdbrdf.pipeline import working_on as working_on
    from usdbrdf.relighting.relight import relight as relight

_HOMES = {
    "usdbrdf.options": (
        *("AdviseOptions", "CompareOptions", "ConvertOptions", "EvaluateOptions", "FitOptions"),
        *("IngestOptions", "Insert"),
        *("PackageOptions", "PublishOptions", "RelightOptions", "ReportOptions"),
        *("Sampling", "ShadeOptions", "TextureOptions"),
    ),
    "usdbrdf.pipeline": ("convert", "fit", "ingest", "shade", "texture", "working_on"),
    "usdbrdf.advice.advise": ("advise",),
    "usdbrdf.cluster.options": ("ClusterOptions",),
    "usdbrdf.cluster.session": ("workers_of",),
    "usdbrdf.delivery.package": ("package",),
    "usdbrdf.delivery.publish": ("publish",),
    "usdbrdf.evaluation.compare_assets": ("compare",),
    "usdbrdf.evaluation.evaluate_views": ("evaluate",),
    "usdbrdf.page.report": ("report",),
    "usdbrdf.paper.options": ("PaperOptions",),
    "usdbrdf.paper.write_paper": ("write_paper",),
    "usdbrdf.relighting.relight": ("relight",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})


class _WithUsd:
    """Finds ``pxr.Usd`` in its usual place, and has the schemas registered as soon as it is loaded:
    before anybody can ask USD's schema registry, and with it build it."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None, /
    ) -> ModuleSpec | None:
        if name != "pxr.Usd":
            return None
        sys.meta_path.remove(self)
        from importlib.util import find_spec

        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            load = loader.exec_module

            def exec_module(module: ModuleType) -> None:
                load(module)
                import_module("usdbrdf.asset")

            loader.exec_module = exec_module
        return spec


if "pxr.Usd" in sys.modules:
    import_module("usdbrdf.asset")
else:
    sys.meta_path.insert(0, _WithUsd())
