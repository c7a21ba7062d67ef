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

Ours is the fit step's own fit: one pass over the frames and every object's rays, grid and
uncertainties; by default, and with fewer rays, frames and texels, each over several seeds. Errors
are of phi and psi without class priors, means over seeds and over the objects that our default
calls measured with any of the seeds, and over all. An effort that leaves one of these objects
without a fit does not count. Compared are

    at equal error     the peer's time at a check over that of our fastest effort whose errors of
                       phi and of psi are at most the peer's there: where the peer's had settled (in
                       hindsight within 0.01 of its last), at its stop, and the least of all checks
    at our error       the peer's time until both its errors are at most our default's
    as they are        the peer's time over that of our default

Time is CPU seconds of all threads, without compiling and without loading the scene.

In favour of the peer: it is given the frames, uncounted, while ours reads them; it is given
`diffuse`; where it settled is known in hindsight; it states no uncertainties, and so cannot tell
lobes that the frames show from those that they do not. In favour of ours: the objects are those on
which it trusts itself; of its efforts the fastest is chosen in hindsight, while the peer has one
setting and one seed (its errors waver from check to check; the least of all checks counts that
against ours); and it is written for this problem, while the peer is a renderer.

`--peer FILE` takes the peer's course from the peer.json of an earlier run.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from fitting import DEFAULT, Effort, Fitted, fitted
from measure import Lit, Spent, figure, lit_asset, parser_of, report, saved_plot
from peer_optimiser import Check, Course, Settings, optimised

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.evaluation.metrics import known_objects
from usdbrdf.relighting.render import mitsuba_variant
from usdbrdf.transport.lobe_radiance import Mixture

SETTINGS = Settings()
QUICK = Settings(most_checks=1, limit_s=60.0)

_SOME = Mixture(per_lobe=2, lights=8, cosine=4)
_FEW = Mixture(per_lobe=1, lights=4, cosine=2)
# From the default, the first, on.
EFFORTS = {
    "default": DEFAULT,
    "528 rays, half of the texels": Effort(_SOME, of_texels=2),
    "528 rays, a quarter of the texels": Effort(_SOME, of_texels=4),
    "264 rays": Effort(_FEW),
    "264 rays, half of the texels": Effort(_FEW, of_texels=2),
    "264 rays, a quarter of the texels": Effort(_FEW, of_texels=4),
    "264 rays, half of the frames, a quarter of the texels": Effort(_FEW, 2, 4),
    "264 rays, a quarter of frames and texels": Effort(_FEW, 4, 4),
}
SEEDS = 4


def main() -> int:
    parser = parser_of(__doc__, "asset", "truth")
    parser.add_argument("--diffuse", choices=("diffuse", "lit"), default="diffuse")
    parser.add_argument("--peer", type=Path, metavar="FILE", help="peer.json of an earlier run")
    options = parser.parse_args()
    results = measure(options.asset, options.truth, options.quick, options.diffuse, options.peer)
    report("peer", results, options.output, plot)
    return 0


def measure(
    asset: Path, truth: Path, quick: bool, diffuse: str = "diffuse", earlier: Path | None = None
) -> dict[str, Any]:
    settings = QUICK if quick else SETTINGS
    lit = lit_asset(asset)
    known = {name: (one.phi, one.psi) for name, one in known_objects(truth, lit.atlas).items()}
    ours, measured, labels = our_efforts(lit, asset, 1 if quick else SEEDS)
    if earlier is not None:
        course = stored_course(earlier, diffuse)
    else:
        try:
            mi = peers_mitsuba()
        except EnvironmentFailure as error:
            return {"skipped": str(error), "figures": []}
        course = optimised(mi, asset, lit, diffuse, labels, settings)

    def both(many: list[dict[str, Any]]) -> dict[str, list[float] | None]:
        return {
            "measured": mean_errors(many, known, measured),
            "all": mean_errors(many, known, labels),
        }

    efforts = [{**one, "errors": both(one["values"])} for one in ours]
    checks = [
        {**check._asdict(), **check.spent._asdict(), "errors": both([check.values])}
        for check in course.checks
    ]
    results = {
        "diffuse": diffuse,
        "objects": len(labels),
        "measured": measured,
        "settings": settings._asdict(),
        "ours": efforts,
        "peer": {
            "converged": checks[-1]["converged"],
            "steps": len(checks) * settings.steps_per_check,
            "compiling": course.compiling._asdict(),
            "course": checks,
        },
        "compared": compared(efforts, checks),
        "parameters": {
            name: {
                "truth": known[name],
                "ours": [[round(v, 3) for v in one[name]] for one in efforts[0]["values"]],
                "peer": [round(float(v), 3) for v in checks[-1]["values"][name]],
            }
            for name in labels
        },
    }
    results["figures"] = figures(results)
    return results


def peers_mitsuba() -> Any:
    """Mitsuba with derivatives. Raises EnvironmentFailure where there is none."""
    mi = mitsuba_variant()
    if mi.variant() != "llvm_ad_rgb":
        raise EnvironmentFailure("no LLVM library of version 17 or newer; set DRJIT_LIBLLVM_PATH")
    return mi


def mean_errors(
    many: list[dict[str, Any]], known: dict[str, tuple[float, float]], names: list[str]
) -> list[float] | None:
    """Mean |phi - truth| and |psi - truth| of the objects ``names`` over ``many`` sets of values;
    None where one of these lacks one of them."""
    if any(name not in values for values in many for name in names):
        return None
    off = [np.abs(np.subtract(values[name], known[name])) for values in many for name in names]
    return [float(mean) for mean in np.mean(off, axis=0)]


def our_efforts(
    lit: Lit, asset: Path, seeds: int
) -> tuple[list[dict[str, Any]], list[str], list[str]]:
    """Of each effort the mean time and, by seed, phi and psi of every object; the objects that are
    measured by default with any seed, and all that can be fitted."""
    efforts, measured, labels = [], set(), []
    for name, effort in EFFORTS.items():
        spent, values = Spent(0, 0), []
        for seed in range(seeds):
            surveying, objects = fitted(lit, asset, None, effort, seed)
            spent = sum((one.spent for one in objects.values()), surveying + spent)
            values.append({n: one for n, one in parameters(objects).items() if np.isfinite(one[0])})
            if not efforts:
                measured |= {n for n, one in objects.items() if one.record.status == "measured"}
        labels = labels or list(values[0])
        efforts.append({"effort": name, **(spent / seeds)._asdict(), "values": values})
        print(f"ours: {name}, {efforts[-1]['cpu']:.1f} CPU seconds", file=sys.stderr)
    return efforts, sorted(measured), labels


def parameters(objects: dict[str, Fitted]) -> dict[str, list[float]]:
    return {name: [one.found.phi, one.found.psi] for name, one in objects.items()}


def stored_course(path: Path, diffuse: str) -> Course:
    document = json.loads(path.read_text())
    if document["diffuse"] != diffuse:
        raise SystemExit(f"{path}: the peer was given {document['diffuse']!r}. Run it again.")
    checks = [
        Check(Spent(one["cpu"], one["wall"]), one["values"], one["converged"])
        for one in document["peer"]["course"]
    ]
    return Course(Spent(**document["peer"]["compiling"]), checks)


def settled(course: list[dict[str, Any]]) -> int:
    """The first check from which on the mean errors stay within 0.01 of the last ones."""
    off = np.array([one["errors"]["measured"] for one in course]).mean(axis=1)
    within = off < off[-1] + 0.01
    return len(within) - int(np.argmin(within[::-1])) if not within.all() else 0


def compared(efforts: list[dict[str, Any]], course: list[dict[str, Any]]) -> dict[str, Any]:
    """The peer's times over ours, see above; None where no effort is as good, or the peer never.
    An effort that leaves an object without a fit is not as good."""

    def as_good(one: dict[str, Any], other: dict[str, Any]) -> bool:
        errors, others = one["errors"]["measured"], other["errors"]["measured"]
        if errors is None or others is None:
            return False
        return all(a <= b for a, b in zip(errors, others, strict=True))

    def at(check: dict[str, Any]) -> dict[str, Any] | None:
        able = [one for one in efforts if as_good(one, check)]
        if not able:
            return None
        best = min(able, key=lambda one: one["cpu"])
        return {
            "effort": best["effort"],
            "cpu": check["cpu"] / best["cpu"],
            "wall": check["wall"] / best["wall"],
            "ours": {"cpu": best["cpu"], "errors": best["errors"]["measured"]},
            "peer": {"cpu": check["cpu"], "errors": check["errors"]["measured"]},
        }

    every = [at(check) for check in course]
    reached = [check["cpu"] for check in course if as_good(check, efforts[0])]
    return {
        "settled": every[settled(course)],
        "stop": every[-1],
        "least": min((one["cpu"] for one in every if one), default=None),
        "checks_without": every.count(None),
        "peer_at_our_error_s": reached[0] if reached else None,
        "as_they_are": {
            "settled": course[settled(course)]["cpu"] / efforts[0]["cpu"],
            "stop": course[-1]["cpu"] / efforts[0]["cpu"],
        },
    }


def figures(results: dict[str, Any]) -> list[dict[str, Any]]:
    ours, peer, found = results["ours"], results["peer"]["course"][-1], results["compared"]
    rows = []
    for which, words in (("settled", "where the peer settled"), ("stop", "at the peer's stop")):
        one = found[which]
        if one is None:
            rows.append(figure(f"efforts of ours with the peer's error, {words}", 0, "", least=1))
            continue
        what = f"peer over ours at equal or smaller error, {words}"
        rows.append(figure(f"{what}, CPU", one["cpu"], "x", least=10))
        rows.append(figure("the same by the clock", one["wall"], "x"))
        rows.append(figure(f"ours there ({one['effort']}), CPU", one["ours"]["cpu"], "s"))
        for k, name in enumerate(("phi", "psi")):
            rows.append(figure(f"mean error of {name} there: ours", one["ours"]["errors"][k], ""))
            rows.append(figure(f"mean error of {name} there: peer", one["peer"]["errors"][k], ""))
    if found["least"] is not None:
        rows.append(figure("the least of all of the peer's checks, CPU", found["least"], "x"))
    rows.append(figure("checks where no effort of ours is as good", found["checks_without"], ""))
    reached = found["peer_at_our_error_s"]
    what = "peer until its errors are our default's"
    what += ", CPU" if reached else ": never within, CPU"
    rows.append(figure(what, reached or peer["cpu"], "s"))
    for which, ratio in found["as_they_are"].items():
        rows.append(figure(f"peer ({which}) over our default, CPU", ratio, "x"))
    rows.append(figure("our default, CPU", ours[0]["cpu"], "s"))
    for which in ("measured", "all"):
        for who, errors in (("our default", ours[0]["errors"]), ("peer's last", peer["errors"])):
            for name, value in zip(("phi", "psi"), errors[which] or (), strict=False):
                rows.append(figure(f"mean error of {name}, {which} objects: {who}", value, ""))
    return rows


def plot(results: dict[str, Any], folder: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawing, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    fits = [one for one in results["ours"] if one["errors"]["measured"]]
    for who, line, steps in (("peer", ".-", results["peer"]["course"]), ("ours", "*", fits)):
        for k, (name, colour) in enumerate((("phi", "C0"), ("psi", "C1"))):
            axes.plot(
                [step["cpu"] for step in steps], [step["errors"]["measured"][k] for step in steps],
                line, color=colour, label=f"{who}, {name}",
            )  # fmt: skip
    axes.set(xlabel="CPU seconds", ylabel="mean error, measured objects", xscale="log")
    axes.set_ylim(bottom=0)
    axes.legend()
    return saved_plot(drawing, folder / "peer.png")


if __name__ == "__main__":
    sys.exit(main())
