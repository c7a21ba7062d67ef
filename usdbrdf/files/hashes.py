"""What many files hold, in one number."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import environment_failures, sha256_of


def hash_of_files(files: Iterable[Path], root: Path | None = None) -> str:
    """One SHA-256 over names (relative to ``root``, if given) and contents of many files, wherever
    they lie, in the order in which they come; InputRefused where one is missing."""
    names = list(files)
    for name in names:
        if not name.is_file():
            raise InputRefused(
                f"{name}: this file, which was there at ingest, is missing. Run `usdbrdf convert` "
                "with the capture again, from where it lies now. [input.missing]"
            )
    with environment_failures("reading the inputs"), ThreadPoolExecutor() as pool:
        digests = list(pool.map(sha256_of, names))
    lines = [
        f"{name.relative_to(root).as_posix() if root else name.name}\0{digest}\n"
        for name, digest in zip(names, digests, strict=True)
    ]
    return hashlib.sha256("".join(lines).encode()).hexdigest()
