"""Noise and bias of the irradiance against a converged one, and what equal noise costs.

Used by ``shading.py``. All on some texels that were seen and do not emit, evenly spread over an
asset; what is filtered is traced and filtered as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from measure import Lit, timed

from usdbrdf.options import Sampling
from usdbrdf.shading.shaded import denoised_irradiance
from usdbrdf.transport import irradiance
from usdbrdf.transport.denoise import OIDN, chosen_filter
from usdbrdf.transport.irradiance import Irradiance, irradiance_at, tiles_of_texels

PAPERS_RAYS = 10_000
COUNTS = (16, 32, 64, 100, 128)
FILTERED_COUNTS = (4, 8, 16, 64)


class Sizes(NamedTuple):
    """How much is measured: texels and turns of the throughput; texels and rays of the noise
    study's reference; seeds of the test for bias."""

    traced: int
    turns: int
    texels: int
    reference_rays: int
    seeds: int


def some_texels(lit: Lit, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` scored texels, evenly spread in the order of their tiles, and the numbers
    of these: a few of each patch."""
    order, tile = tiles_of_texels(lit.atlas.texels)
    usable = np.flatnonzero(scored(lit)[order])
    chosen = usable[np.linspace(0, len(usable) - 1, min(count, len(usable))).astype(int)]
    return order[chosen], tile[chosen]


def scored(lit: Lit) -> np.ndarray:
    """(T,) bool: seen three times, inside a triangle, not emissive."""
    emits = (lit.atlas.map_where_present("emission", 3) > 0).any(axis=1)
    seen = lit.atlas.map("samples")[:, 0] >= 3
    return np.asarray(seen & lit.atlas.texels.interior & ~emits)


def shaded(
    lit: Lit, order: np.ndarray, tile: np.ndarray, sampling: Sampling, rays: Any = None
) -> Irradiance:
    texels, scene = lit.atlas.texels, lit.scene
    with first_round_of(
        max(irradiance._FIRST_ROUND, sampling.max_rays)
        if sampling.standard_error == 0
        else irradiance._FIRST_ROUND
    ):
        return irradiance_at(
            rays or scene.rays, scene.radiance, scene.lights, scene.environment,
            texels.position[order], texels.normal[order], tile, sampling, scene.diagonal_m,
        )  # fmt: skip


@contextmanager
def first_round_of(rays: int) -> Iterator[None]:
    """Any number of rays at once, where the product doubles from 64."""
    before = irradiance._FIRST_ROUND
    irradiance._FIRST_ROUND = rays
    try:
        yield
    finally:
        irradiance._FIRST_ROUND = before


def noise(lit: Lit, sizes: Sizes) -> dict[str, Any]:
    """Relative RMSE and seconds per texel of each way; rays and time for equal noise."""
    order, tile = some_texels(lit, sizes.texels)
    every, every_tile = tiles_of_texels(lit.atlas.texels)
    converged = Sampling(standard_error=0, max_rays=sizes.reference_rays, seed=977)
    reference = shaded(lit, order, tile, converged).mean.mean(axis=1)
    good = reference > 0

    def rmse(mean: np.ndarray) -> float:
        relative = mean.mean(axis=1)[good] / reference[good] - 1
        return float(np.sqrt((relative**2).mean()))

    papers = Sampling(estimator="cosine", max_rays=PAPERS_RAYS, seed=5)
    found, time = timed(lambda: shaded(lit, order, tile, papers).mean)
    papers_rmse, papers_time = rmse(found), time / len(order)

    def of_rays(rays: int) -> Sampling:
        return Sampling(standard_error=0, max_rays=rays, seed=3)

    ours = [
        {"rays": rays, "rmse": rmse(shaded(lit, order, tile, of_rays(rays)).mean)}
        for rays in COUNTS
    ]
    filtered = []
    for rays in FILTERED_COUNTS if chosen_filter("auto") == OIDN else ():
        found, tracing = timed(lambda n=rays: shaded(lit, every, every_tile, of_rays(n)).mean)
        mean = np.empty_like(found)
        mean[every] = found
        smooth, filtering = timed(lambda m=mean: denoised_irradiance(lit.atlas.texels, m))
        tracing, filtering = tracing / len(every), filtering / len(every)
        filtered.append(
            {
                "rays": rays,
                "rmse": rmse(smooth[order]),
                "s_per_texel": {"tracing": tracing._asdict(), "filter": filtering._asdict()},
                "tracing": papers_time.over(tracing)._asdict(),
                "total": papers_time.over(tracing + filtering)._asdict(),
            }
        )
    equal = rays_for(papers_rmse, ours)
    traced = of_rays(2 * round(equal / 2))
    _, time = timed(lambda: shaded(lit, every, every_tile, traced).mean)
    return {
        "texels": int(good.sum()),
        "reference_rays": sizes.reference_rays,
        "paper": {"rays": PAPERS_RAYS, "rmse": papers_rmse, "s_per_texel": papers_time._asdict()},
        "ours": ours,
        "filtered": filtered,
        "rays_for_equal_noise": equal,
        "unfiltered_tracing": papers_time.over(time / len(every))._asdict(),
    }


def rays_for(target: float, ours: list[dict[str, Any]]) -> float:
    """Rays at which the RMSE reaches the target, linear in the logarithms."""
    slope, offset = np.polyfit(
        np.log([one["rays"] for one in ours]), np.log([one["rmse"] for one in ours]), 1
    )
    return float(np.exp((np.log(target) - offset) / slope))


def bias(lit: Lit, sizes: Sizes) -> dict[str, Any]:
    """Mean over texels of S / reference - 1, its standard error over seeds, and their ratio z, for
    the raw estimate and with the stopping rule of the default."""
    order, tile = some_texels(lit, sizes.texels // 4)

    def estimates(sampling: Sampling, seeds: range) -> np.ndarray:
        return np.stack(
            [shaded(lit, order, tile, replace(sampling, seed=s)).mean.mean(axis=1) for s in seeds]
        )

    references = estimates(
        Sampling(standard_error=0, max_rays=sizes.reference_rays), range(900, 904)
    )
    level = references.mean(axis=0)
    good = level > 0

    def mean_and_error(values: np.ndarray) -> tuple[float, float]:
        means = (values[:, good] / level[good] - 1).mean(axis=1)
        return float(means.mean()), float(means.std(ddof=1) / len(means) ** 0.5)

    _, references_error = mean_and_error(references)
    found: dict[str, Any] = {"texels": int(good.sum()), "seeds": sizes.seeds}
    for name, sampling in (
        ("64 rays", Sampling(standard_error=0, max_rays=64)),
        ("stopping rule", Sampling()),
    ):
        difference, own_error = mean_and_error(estimates(sampling, range(sizes.seeds)))
        error = float(np.hypot(own_error, references_error))
        found[name] = {
            "mean_relative_difference": difference,
            "standard_error": error,
            "z": difference / error,
        }
    return found
