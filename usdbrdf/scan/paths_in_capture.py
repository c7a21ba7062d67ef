"""Files that a capture names, kept inside the capture or the folders that the user allows."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.files.paths import contained
from usdbrdf.scan.ingest_options import IngestOptions


def path_in_capture(root: Path, candidate: str, options: IngestOptions) -> Path:
    """The absolute path of ``candidate``; InputRefused if it leaves root and --allow-outside."""
    if candidate and "\0" not in candidate:
        for folder in options.allow_outside:
            path = (root / candidate).resolve()
            if path.is_relative_to(folder.resolve()):
                return path
    return contained(root, candidate)
