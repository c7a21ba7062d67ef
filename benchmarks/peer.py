"""Against gradient-based inverse rendering with Mitsuba 3, on the same capture and cores.

    export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*/libLLVM.so.19*|head -1)
    python benchmarks/peer.py ASSET TRUTH_FOLDER [-o FOLDER] [--quick]

ASSET was shaded, TRUTH_FOLDER holds its capture's true phi and psi, as `samples/study/truth` does.
The peer optimises the same two parameters of the same lobe (usdbrdf/relighting/lobe_plugin.py, so
nothing has to be converted) against the same frames. It is lit by the lit texture L_d, as our fit
is. As the diffuse radiance, which our fit eliminates, it is given the asset's refined map
`diffuse`, free of specular light: the best case for the peer, which owes it to our fit and does not
pay for it (where ours used a class prior, the map holds that prior's). `--diffuse lit` gives it L_d
there too, the best that is known before any fit. Its settings:

    variant     llvm_ad_rgb; integrator prb (detached sampling) with one reflection, L_d as a
                textured area emitter on every mesh, multiple importance sampling
    parameters  phi and psi of all objects that do not shine, together, from 0.5 each, kept within
                [0.02, 1] and [0, 1]
    optimiser   mi.ad.Adam, learning rate 0.03, a third of it after three checks
    step        eight frames in full resolution as one batch of cameras, one path per pixel, other
                seeds in each; relative squared error without clipped pixels, lamps and the outlines
                of objects
    stop        when the parameters' means over 15 steps (all frames twice) differ by less than 0.01
                on average from those of the check before, or at a limit

Four paths per pixel of four frames a step came no closer on the sample in the same time.

Time is CPU seconds of all threads, without loading scene and frames and without compiling. The
peer's is counted until it stops, and in hindsight until its errors are within 0.01 of its last.
Ours is the fit step's own fit: one pass over the frames, reading them included, and every object's
rays, grid and uncertainties. Both are read without class priors. Errors are means over the objects
that ours calls measured, and over all.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from fitting import Fitted, fitted
from measure import figure, lit_asset, parser_of, report, saved_plot
from peer_optimiser import Settings, optimised

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.evaluation.truth import known_objects
from usdbrdf.relighting.variant import mitsuba_variant

SETTINGS = Settings()
QUICK = Settings(most_checks=1, limit_s=60.0)


def main() -> int:
    parser = parser_of(__doc__, "asset", "truth")
    parser.add_argument("--diffuse", choices=("diffuse", "lit"), default="diffuse")
    options = parser.parse_args()
    results = measure(options.asset, options.truth, options.quick, options.diffuse)
    report("peer", results, options.output, plot)
    return 0


def measure(asset: Path, truth: Path, quick: bool, diffuse: str = "diffuse") -> dict[str, Any]:
    settings = QUICK if quick else SETTINGS
    try:
        mi = mitsuba_variant()
    except EnvironmentFailure as error:
        return {"skipped": str(error), "figures": []}
    if mi.variant() != "llvm_ad_rgb":
        reason = "no LLVM library of version 17 or newer; set DRJIT_LIBLLVM_PATH"
        return {"skipped": reason, "figures": []}
    lit = lit_asset(asset)
    known = known_objects(truth, lit.atlas)
    surveying, objects = fitted(asset)
    ours = sum((one.spent for one in objects.values()), surveying)
    labels = [name for name, one in objects.items() if np.isfinite(one.found["numbers"][0])]
    measured = [name for name in labels if objects[name].record.status == "measured"]
    found = {name: parameters(objects[name]) for name in labels}
    compiling, checks = optimised(mi, asset, lit, diffuse, labels, settings)

    def errors(values: dict[str, Any], names: list[str]) -> list[float]:
        off = [np.abs(np.subtract(values[n], (known[n]["phi"], known[n]["psi"]))) for n in names]
        return [float(mean) for mean in np.mean(off, axis=0)]

    def both(values: dict[str, Any]) -> dict[str, list[float]]:
        return {"measured": errors(values, measured), "all": errors(values, labels)}

    last = checks[-1]
    course = [{**check.spent._asdict(), "errors": both(check.values)} for check in checks]
    results = {
        "diffuse": diffuse,
        "objects": len(labels),
        "measured": measured,
        "settings": settings._asdict(),
        "ours": {**ours._asdict(), "errors": both(found)},
        "peer": {
            **last.spent._asdict(),
            "converged": last.converged,
            "steps": len(checks) * settings.steps_per_check,
            "compiling": compiling._asdict(),
            "settled": settled(course),
            "errors": both(last.values),
            "course": course,
        },
    }
    results["parameters"] = {
        name: {
            "truth": [known[name]["phi"], known[name]["psi"]],
            "ours": [round(float(v), 3) for v in found[name]],
            "peer": [round(float(v), 3) for v in last.values[name]],
        }
        for name in labels
    }
    results["figures"] = figures(results)
    return results


def parameters(one: Fitted) -> tuple[float, float]:
    phi, psi = one.found["numbers"][:2]
    return float(phi), float(psi)


def settled(course: list[dict[str, Any]]) -> dict[str, float]:
    """Time of the first check from which on the mean errors stay within 0.01 of the last ones."""
    off = np.array([one["errors"]["measured"] for one in course]).mean(axis=1)
    within = off < off[-1] + 0.01
    first = len(within) - int(np.argmin(within[::-1])) if not within.all() else 0
    return {clock: course[first][clock] for clock in ("cpu", "wall")}


def figures(results: dict[str, Any]) -> list[dict[str, Any]]:
    ours, peer = results["ours"], results["peer"]
    how = "converged" if peer["converged"] else "stopped at its limit"
    rows = [
        figure(
            f"peer's time over ours, CPU (peer {how})", peer["cpu"] / ours["cpu"], "x", least=10
        ),
        figure("the same by the clock", peer["wall"] / ours["wall"], "x"),
        figure("the same until it had settled, CPU", peer["settled"]["cpu"] / ours["cpu"], "x"),
        figure("ours, CPU", ours["cpu"], "s"),
        figure("peer, CPU", peer["cpu"], "s"),
    ]
    for which in ("measured", "all"):
        for k, name in enumerate(("phi", "psi")):
            mine, theirs = (side["errors"][which][k] for side in (ours, peer))
            what = f"mean error of {name}, {which} objects"
            rows.append(figure(f"{what}: ours", mine, "", most=round(theirs, 4)))
            rows.append(figure(f"{what}: peer", theirs, ""))
    return rows


def plot(results: dict[str, Any], folder: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    ours, course = results["ours"], results["peer"]["course"]
    drawing, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for k, (name, colour) in enumerate((("phi", "C0"), ("psi", "C1"))):
        errors = [step["errors"]["measured"][k] for step in course]
        axes.plot(
            [step["cpu"] for step in course], errors, ".-", color=colour, label=f"peer, {name}"
        )
        axes.plot(ours["cpu"], ours["errors"]["measured"][k], "*", ms=12, color=colour,
                  label=f"ours, {name}")  # fmt: skip
    axes.set(xlabel="CPU seconds", ylabel="mean error, measured objects", xscale="log")
    axes.set_ylim(bottom=0)
    axes.legend()
    return saved_plot(drawing, folder / "peer.png")


if __name__ == "__main__":
    sys.exit(main())
