"""Options of the command ``paper``."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path

from usdbrdf.option import Options, option
from usdbrdf.options import CompareOptions, Denoise, EvaluateOptions

_COUNT = (1, 2**31 - 1)


class PaperOptions(Options):
    """What the paper's tables and figures are made of. Which lighting of A is shown ``compare``
    says; what ``evaluate`` says holds for both assets, truth included."""

    views: Path | None = option("--views FILE", None, unset="frames of its capture", file=True)
    "nerfstudio document (transforms.json) of views of ASSET, for figures 8 and 9"
    other_views: Path | None = option(
        "--other-views FILE", None, unset="frames of its capture", file=True
    )
    "the same of OTHER"
    frames: int = option("--frames N", 24, _COUNT)
    "of each capture, spread evenly, where no views are named"
    relight: bool = option("--no-relight", True)
    "leave figure 10 out, which needs usdbrdf[render]"
    samples: int = option("--samples N", 128, (1, 1 << 24))
    "paths per pixel of figure 10"
    denoise: Denoise = option("--denoise", "auto")
    "filter figure 10; oidn needs usdbrdf[denoise], auto takes it where it is there"
    compare: CompareOptions = field(default_factory=CompareOptions)
    evaluate: EvaluateOptions = field(default_factory=EvaluateOptions)
