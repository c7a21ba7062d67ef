"""The layers that ingest leaves for the tasks to come, so that the stage composes before them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from usdbrdf.asset.header import StageHeader
from usdbrdf.asset.layers.scan_layer import write_choice_of_lighting, write_pending_layer
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.job.task import TaskRun


def write_layers_to_come(
    run: TaskRun, asset: Asset, lightings: Sequence[str], header: StageHeader
) -> None:
    """Empty ones; of several lightings those of each, and what chooses among them."""
    own, chosen = [asset.layer(role) for role in ROLES[1:]], ("texturing", "shading")
    if lightings:
        each = [replace(asset, lighting=name) for name in lightings]
        own = [asset.layer("material"), asset.uv_layer]
        own += [one.layer(role) for one in each for role in chosen]
    for layer in own:
        role = layer.name.split(".")[0]
        pending = role if role in ROLES else "texturing"
        write_pending_layer(run.output_once(f"layers/{layer.name}"), pending, header)
    for role in chosen if lightings else ():
        place = run.output(f"layers/{asset.layer(role).name}")
        write_choice_of_lighting(place, role, asset, lightings, header)
