"""paper.md: the tables in words and the figures with their captions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from usdbrdf.paper.tables import QUANTITIES, albedo_rows

_SOURCE = (
    "B. Haefner et al., *Recovering Real-World Reflectance Properties and Shading From HDR "
    "Imagery*, 3DV 2021"
)
_CAPTIONS = {
    "fig5_errors.png": """Albedo of B against that of A; radiance of A predicted with the albedo of
        B; radiance of B predicted with the albedo of A. Relative errors, pale: 25 % or more, grey:
        not compared. The paper states less than 10 % for albedos and well below 5 % for
        predictions.""",
    "fig6_albedo_shading.png": """Rows of A and of B in turn: albedo, shading, diffuse radiance
        measured, and predicted with the other's albedo.""",
    "fig7_textures.png": """Rows of A and of B in turn: diffuse radiance, albedo, shading.""",
    "fig8_a.png": "A, per view: diffuse baseline and full model against the photographs.",
    "fig8_b.png": "B, per view: diffuse baseline and full model against the photographs.",
    "fig9_a.png": """A: photograph, diffuse baseline, full model; L2 errors of display values of
        baseline and full model (pale: 0.25 or more); FLIP of both. Rows: the view that the full
        model improves most, the one that it improves least or harms, the first, the last.""",
    "fig9_b.png": "B: the same.",
    "fig10_relighting.png": """Path traced. Above: A in its own light and in that of B. Below: B in
        the light of A and in its own.""",
}


def paper_text(found: Mapping[str, Any], files: Sequence[str]) -> str:
    """The document; figures that are not among ``files`` are left out."""
    first, second = found["assets"]
    lightings = [f" ({name})" if name else "" for name in found.get("lightings", ("", ""))]
    parts = [
        f"# A = {first}{lightings[0]}, B = {second}{lightings[1]}",
        f"Tables and figures as in {_SOURCE}, sections 4.1 to 4.3.",
        "## Albedo and shading (Fig. 5 to 7)",
        f"{found['texels']:,} texels of A were seen three times in both.",
        _table(
            ["maps", "compared", "NRMSE", "median \\|relative\\|", "median relative"],
            [
                [row["maps"], row["compared"], *(_percent(row[name]) for name in _FIGURES)]
                for row in albedo_rows(dict(found))
            ],
        ),
        *_figures(files, "fig5", "fig6", "fig7"),
        "## Specular appearance (Fig. 8 and 9)",
        _table(
            ["asset", "metric", "views", "baseline", "full", "change", "better", "worse"],
            [
                row
                for name, side in zip("AB", found["views"], strict=True)
                for row in _view_rows(name, side)
            ],
        ),
        "Better and worse: views in which the full model is so, and by how much in their mean.",
        *_figures(files, "fig8", "fig9"),
        "## Roughness and specular of the objects",
        _materials(found["materials"]),
        *_against_truth(found["views"]),
        "## Relighting (Fig. 10)",
        _relighting(found["relighting"]),
        *_figures(files, "fig10"),
    ]
    return "\n\n".join(parts) + "\n"


_FIGURES = ("nrmse", "median_abs_relative", "median_signed")


def _view_rows(name: str, side: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for metric, title in (("l2", "relative L2"), ("flip", "FLIP")):
        if (means := side["summary"].get(metric)) is None:
            continue
        change = side["changes"][metric]
        rows.append(
            [
                name,
                title,
                str(change["views"]),
                f"{means['baseline']:.4f}",
                f"{means['full']:.4f}",
                f"{means['change_percent']:+.1f} %" if "change_percent" in means else "",
                _counted(change["better_views"], change["mean_improvement"]),
                _counted(change["worse_views"], change["mean_deterioration"]),
            ]
        )
    return rows


def _counted(views: int, mean: float | None) -> str:
    return f"{views} ({mean:.4f})" if mean is not None else str(views)


def _materials(rows: Sequence[Mapping[str, Any]]) -> str:
    return _table(
        ["object", "phi A", "phi B", "psi A", "psi B", "status A", "status B"],
        [
            [
                row["object"],
                *(
                    _with_error(row[f"{number}_{name}"], row[f"{number}_error_{name}"])
                    for number in ("phi", "psi")
                    for name in "ab"
                ),
                row["status_a"],
                row["status_b"],
            ]
            for row in rows
        ],
    )


def _against_truth(sides: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is known of captures with truth."""
    known = {name: side["truth"] for name, side in zip("AB", sides, strict=True) if "truth" in side}
    if not known:
        return []
    numbers = ("mean_abs_phi", "mean_abs_psi", "measured_mean_abs_phi", "measured_mean_abs_psi")
    head = [
        "asset", "albedo NRMSE", "mean error of phi", "of psi", "of the measured: phi", "psi",
    ]  # fmt: skip
    rows = []
    for name, truth in known.items():
        values = (truth["material"][number] for number in numbers)
        told = ("" if value is None else f"{value:.4f}" for value in values)
        rows.append([name, _percent(truth["albedo"]["nrmse"]), *told])
    return ["Against the truth:", _table(head, rows)]


def _relighting(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "Not rendered."
    forth, back = (found[name] for name in ("a_in_light_of_b", "b_in_light_of_a"))
    return (
        f"Relative L2 of A in the light of B against B in its own: {_percent(forth)}; of B in the "
        f"light of A against A in its own: {_percent(back)} ({found['samples']} paths per pixel)."
    )


def _figures(files: Sequence[str], *stems: str) -> list[str]:
    shown = []
    for name, caption in _CAPTIONS.items():
        if name.split("_")[0].removesuffix(".png") in stems and f"figures/{name}" in files:
            shown.append(f"![{name}](figures/{name})\n\n{' '.join(caption.split())}")
    return shown


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.2f} %"


def _with_error(value: float | None, error: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}" if error is None else f"{value:.3f} +- {error:.3f}"


def paper_line(found: Mapping[str, Any]) -> str:
    """One line for people: what Fig. 5 comes to, of the last set of maps."""
    last = {row["compared"]: row["nrmse"] for row in albedo_rows(dict(found))}
    told = ", ".join(f"{name} {_percent(last[name])}" for name in QUANTITIES.values())
    return f"{found['texels']:,} texels, NRMSE: {told}"
