"""What lies behind a thing and shows through it.

A pane may reflect as a surface does and still be none: most of what its pixels hold is what their
rays meet behind it. That moves over the pane as the camera does, by the parallax of what is behind,
and no lobe and no error of a surface's samples moves with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from usdbrdf.material.view_model import UPDATES, ViewModel, ViewSamples
from usdbrdf.model.arrays import Float
from usdbrdf.transport.environment import radiance_from
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, hits_behind


class Through(NamedTuple):
    """share: of the radiance behind that is seen, from 0 to 1; error: its standard deviation;
    behind: that radiance in units of what is seen, on the mean."""

    share: float
    error: float
    behind: float = 0.0

    @property
    def at_least(self) -> float:
        """What of the light seen is from behind, more with a probability of 97.7 %. Of darkness, as
        in a cupboard, much may show through that is next to nothing."""
        return min(max(self.share - 2 * self.error, 0.0) * self.behind, 1.0)


NOTHING = Through(0.0, math.inf)


def radiance_behind(lit: LitScene, points: SurfacePoints, index: int) -> Float:
    """(R, 3) W/(m^2 sr): what the rays from the camera meet behind object ``index``, of which
    ``points`` are, and past panes; 0 where that is nothing, and nothing is known of the
    surroundings."""
    beyond, hits = hits_behind(lit, points, np.full(len(points.face), index, np.int32))
    behind = lit.radiance.at(hits.face, hits.u, hits.v)
    missed = beyond & (hits.face < 0)
    behind[missed] = radiance_from(lit.environment, -points.to_camera[missed])
    return behind


def seen_through(
    samples: ViewSamples,
    behind: Float,
    basis: Callable[[Sequence[float]], tuple[Float, Float]],
    phi: float,
    psi: float,
    most_psi: float = 1.0,
) -> Through:
    """How much of ``behind`` (P, 3) the samples show beside diffuse light, free for each texel, and
    a lobe of roughness ``phi``: both factors by least squares, with the errors that samples of a
    frame share.

    basis: roughnesses (K,) -> (base, slope) of I_nd = base + psi slope, (P, 3, K) each; psi: about
    what it is, and ``most_psi`` what it may be.
    """
    base, slope = (one[..., 0] for one in basis([phi]))
    rest = samples.radiance - base
    model = ViewModel(samples)
    through = NOTHING
    for _ in range(UPDATES):
        model.update(base + np.float32(psi) * slope + np.float32(through.share) * behind)
        psi, through = _least_squares(model, rest, slope, behind)
        psi = min(psi, most_psi)
    seen, far = (model.sums_of_texels(one.astype(np.float64)) for one in (samples.radiance, behind))
    # No more shows than as much light as there is.
    most = np.where(far > 0, seen / np.where(far > 0, far, 1), np.inf).min(axis=1)
    return through._replace(
        share=min(through.share, float(np.median(most))),
        behind=float(far.sum() / max(seen.sum(), 1e-30)),
    )


def _least_squares(
    model: ViewModel, rest: Float, slope: Float, behind: Float
) -> tuple[float, Through]:
    """psi, which is not negative, and how much shows through, from 0 to 1."""
    left, lobe, far = model.reduced(np.stack([rest, slope, behind], axis=2)).parts(3)
    of_lobe, of_far = (float(model.product(one, one)[0]) for one in (lobe, far))
    both = float(model.product(lobe, far)[0])
    lobe_left, far_left = (float(model.product(one, left)[0]) for one in (lobe, far))
    per_lobe = 1 / of_lobe if of_lobe > 0 else 0.0
    through, alone = NOTHING, of_far - both**2 * per_lobe
    # Where what is behind looks alike from everywhere, or as the lobe does, nothing tells.
    if alone > 1e-9 * of_far:
        share = (far_left - both * lobe_left * per_lobe) / alone
        through = Through(min(max(share, 0.0), 1.0), 1 / math.sqrt(alone))
    psi = (lobe_left - through.share * both) * per_lobe
    return max(psi, 0.0), through
