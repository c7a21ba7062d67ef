"""FLIP of what `relight` makes of held-out views, against the true pictures of them.

    usdbrdf relight ASSET --views TRUTH_FOLDER/views.json -o FOLDER
    python benchmarks/relit_views.py TRUTH_FOLDER FOLDER [--json FILE]

TRUTH_FOLDER holds pictures of linear radiance, as `samples/study/truth` does: `view_00.exr` and so
on; FOLDER those with the same names. One exposure serves all views: the 90th percentile of the mean
of R, G and B of all true pictures is shown as 0.8. Printed per view are mean FLIP and, over the
pixels that are not shown white, the median relative error and its absolute value's.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.evaluation.metrics import Pair, flip_maps, median_relative
from usdbrdf.files.colour import display_exposure, to_display_srgb
from usdbrdf.files.images import read_exr


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("rendered", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    names = sorted(path.name for path in options.truth.glob("*.exr"))
    missing = [name for name in names if not (options.rendered / name).is_file()]
    if not names or missing:
        what = f"{options.truth}: no .exr" if not names else f"{options.rendered}: no {missing[0]}"
        parser.error(f"{what}. Render the views of the truth's views.json with `usdbrdf relight`")
    results = measure(names, options.truth, options.rendered)
    text = json.dumps(results, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")
    return 0


def measure(names: list[str], truth: Path, rendered: Path) -> dict[str, Any]:
    """Figures of each view, and the mean of their FLIP."""
    true = [read_exr(truth / name)[..., :3] for name in names]
    ours = [read_exr(rendered / name)[..., :3] for name in names]
    exposure = display_exposure(np.concatenate([image.mean(axis=2).ravel() for image in true]))

    def shown(image: np.ndarray) -> np.ndarray:
        return to_display_srgb(np.maximum(image, 0), exposure_scale=exposure)

    pairs = [Pair(shown(a), shown(b)) for a, b in zip(true, ours, strict=True)]
    flip = [float(errors.mean()) for errors in flip_maps(pairs, str(rendered))]
    views = {}
    for name, reference, image, error in zip(names, true, ours, flip, strict=True):
        dark = reference.max(axis=2) * exposure < 1
        absolute, signed = median_relative(image[dark], reference[dark])
        views[name] = {"flip": error, "relative": signed, "absolute_relative": absolute}
    return {"exposure": exposure, "flip": float(np.mean(flip)), "views": views}


if __name__ == "__main__":
    sys.exit(main())
