"""Every path that a layer names, wherever it stands."""

from __future__ import annotations

from pxr import Sdf, UsdUtils


def named_files(layer: Sdf.Layer) -> set[str]:
    """Asset paths as written: sublayers, references, payloads, clips, attributes, metadata, of all
    variants. The layer is not changed."""
    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(layer)
    found: set[str] = set()

    def seen(path: str) -> str:
        found.add(path)
        return path

    UsdUtils.ModifyAssetPaths(copy, seen)
    return found - {""}
