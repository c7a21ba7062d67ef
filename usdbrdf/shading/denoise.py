"""Open Image Denoise's lightmap filter over one object's atlas (extra ``denoise``)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import EnvironmentFailure

Float = npt.NDArray[np.float32]


def require_oidn() -> None:
    """Raises EnvironmentFailure with the cure if pyoidn cannot be imported."""
    try:
        import pyoidn  # noqa: F401
    except ImportError as error:
        raise EnvironmentFailure(
            "--denoise oidn needs Open Image Denoise, which is not installed. "
            "Run: pip install 'usdbrdf[denoise]'. [shading.denoise]"
        ) from error


def denoise_lightmap(picture: Float) -> Float:
    """Filtered copy of an HDR lightmap (H, W, 3) float32 whose gutters are dilated."""
    import pyoidn

    filtered = pyoidn.denoise(np.ascontiguousarray(picture), filter_type="RTLightmap")
    return np.maximum(np.asarray(filtered, np.float32), 0)
