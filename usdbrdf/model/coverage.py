"""What the frames know of each texel's lit radiance."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from usdbrdf.model.arrays import Bool, Float


class Coverage(IntEnum):
    """FILLED: no frame shows the texel, its radiance is taken from around it; CLIPPED: frames show
    it, every one of them saturated, so that its radiance is a lower bound; MEASURED: at least one
    frame gives its radiance."""

    FILLED = 0
    CLIPPED = 1
    MEASURED = 2


@dataclass(frozen=True)
class CoverageMap:
    """kind (T,) int8: the ``Coverage`` of every texel."""

    kind: npt.NDArray[np.int8]

    @classmethod
    def of(cls, measured: Bool, clipped: Bool) -> CoverageMap:
        """measured, clipped (T,): a frame measured the texel; all that show it saturated."""
        kinds = (Coverage.MEASURED, Coverage.CLIPPED)
        return cls(np.select([measured, clipped], kinds, Coverage.FILLED).astype(np.int8))

    @classmethod
    def from_stored(cls, values: Float) -> CoverageMap:
        """The inverse of ``stored``."""
        return cls(np.rint(values[:, 0] * Coverage.MEASURED).astype(np.int8))

    def stored(self) -> Float:
        """(T,) float32 as the map "coverage" has it: 0 filled, 0.5 clipped, 1 measured."""
        return self.kind.astype(np.float32) / np.float32(Coverage.MEASURED)

    @property
    def measured(self) -> Bool:
        """(T,): a frame gives the texel's radiance."""
        return np.asarray(self.kind == Coverage.MEASURED, np.bool_)

    @property
    def clipped(self) -> Bool:
        """(T,): what is known of the texel's radiance is a lower bound."""
        return np.asarray(self.kind == Coverage.CLIPPED, np.bool_)

    @property
    def observed(self) -> Bool:
        """(T,): measured or clipped; a frame shows the texel."""
        return np.asarray(self.kind != Coverage.FILLED, np.bool_)
