"""Move the outputs of a stage from its work folder into the asset; every step can be repeated."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from usdbrdf.files.atomic import fault_point, flush_folder, move, sha256_of
from usdbrdf.job.stamp import Stamp, journal_path, stamp_path, write_stamp

# What a layer points at is there before the layer: textures, binary layers, text layers.
_RANK = {".usdc": 1, ".usd": 1, ".usda": 2}


def can_publish(asset: Path, staged: Path, journal: Stamp) -> bool:
    """Whether every output of an interrupted publish is in the asset or still waits, intact."""
    return all(
        _has(asset / relative, sha256) or _has(staged / relative, sha256)
        for relative, sha256 in journal.outputs.items()
    ) and all(
        (asset / relative).is_file() or (staged / relative).is_file() for relative in journal.once
    )


def publish_stage(asset: Path, folder: Path, journal: Stamp, order: int) -> None:
    """Replace the outputs, delete those that are no longer made, write the stamp, clean up."""
    name = journal.stage
    for _, outputs in groupby(sorted(journal.outputs, key=_place_in_order), key=_rank):
        folders = set()
        for relative in outputs:
            folders.add((asset / relative).parent)
            _move(folder / "staged" / relative, asset / relative)
            fault_point(f"stage:{name}:mid_publish")
        for changed in folders:
            flush_folder(changed)
    for relative in journal.once:
        if not (asset / relative).exists():
            _move(folder / "staged" / relative, asset / relative)
            flush_folder((asset / relative).parent)
    for relative, hashes in journal.earlier.items():
        retired = asset / relative
        # A file that somebody edited is not deleted, it is no longer only ours.
        if relative not in journal.outputs and retired.is_file() and sha256_of(retired) in hashes:
            retired.unlink()
    fault_point(f"stage:{name}:after_publish")
    path = stamp_path(asset, order, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    fault_point(f"stage:{name}:before_stamp")
    write_stamp(path, replace(journal, earlier={}))
    journal_path(asset, name).unlink()
    shutil.rmtree(folder, ignore_errors=True)


def _move(staged: Path, final: Path) -> None:
    if staged.is_file():
        final.parent.mkdir(parents=True, exist_ok=True)
        move(staged, final)


def _rank(relative: str) -> int:
    return _RANK.get(Path(relative).suffix, 0)


def _place_in_order(relative: str) -> tuple[int, str]:
    return _rank(relative), relative


def _has(path: Path, sha256: str) -> bool:
    return path.is_file() and sha256_of(path) == sha256
