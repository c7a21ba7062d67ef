"""Mitsuba 3 (extra ``render``), imported only where something is rendered."""

from __future__ import annotations

from typing import Any

from usdbrdf.errors import EnvironmentFailure

# Older ones abort the process while they compile Mitsuba's kernels.
_MIN_LLVM = 17
VARIANTS = ("llvm_ad_rgb", "scalar_rgb")


def mitsuba_variant(variant: str | None = None) -> Any:
    """The module ``mitsuba`` with its variant set: llvm_ad_rgb where a usable LLVM library is
    found (environment variable DRJIT_LIBLLVM_PATH), else scalar_rgb; or as asked."""
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise EnvironmentFailure(
            "relight needs Mitsuba 3, which is not installed. Run: pip install 'usdbrdf[render]'. "
            "[relight.mitsuba]"
        ) from error
    if variant is None:
        usable = drjit.has_backend(drjit.JitBackend.LLVM)
        usable = usable and drjit.detail.llvm_version()[0] >= _MIN_LLVM
        variant = VARIANTS[0] if usable else VARIANTS[1]
    mitsuba.set_variant(variant)
    # Its log goes to stdout, which belongs to --json.
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba
