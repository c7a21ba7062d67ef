"""Open Image Denoise (extra ``denoise``): whether it is there, and its lightmap filter over one
object's atlas."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import EnvironmentFailure

Float = npt.NDArray[np.float32]
AUTO: Final = "auto"
NONE: Final = "none"
OIDN: Final = "oidn"
CHOICES: Final = (AUTO, NONE, OIDN)


def chosen_filter(wanted: str) -> Literal["none", "oidn"]:
    """What ``--denoise`` means on this machine: auto is oidn where pyoidn can be imported.
    Raises EnvironmentFailure with the cure where oidn is wanted and cannot."""
    if wanted == NONE:
        return NONE
    try:
        import pyoidn  # noqa: F401
    except (ImportError, OSError) as error:  # OSError: a library of its own that does not load
        if wanted == AUTO:
            return NONE
        raise EnvironmentFailure(
            "--denoise oidn needs Open Image Denoise, which is not installed. "
            "Run: pip install 'usdbrdf[denoise]'. [shading.denoise]"
        ) from error
    return OIDN


def denoise_lightmap(picture: Float) -> Float:
    """Filtered copy of an HDR lightmap (H, W, 3) float32 whose gutters are dilated.

    The same bits in every run on one machine, with any number of threads. Raises
    EnvironmentFailure where Open Image Denoise gives up, as without memory.
    """
    import pyoidn

    try:
        filtered = pyoidn.denoise(np.ascontiguousarray(picture), filter_type="RTLightmap")
    except RuntimeError as error:
        raise EnvironmentFailure(
            f"Open Image Denoise failed on a lightmap of {picture.shape[1]} x {picture.shape[0]} "
            f"texels: {error}. Run again with --denoise none. [shading.denoise]"
        ) from error
    return np.maximum(np.asarray(filtered, np.float32), 0)
