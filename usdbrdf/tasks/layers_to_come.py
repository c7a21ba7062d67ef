"""The layers that ingest leaves for the tasks to come, so that the stage composes before them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from usdbrdf.asset.header import StageHeader
from usdbrdf.asset.layers.interface import write_contents, write_interface
from usdbrdf.asset.layers.scan_layer import write_choice_of_lighting, write_pending_layer
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.job.task import TaskRun


def write_layers_to_come(
    run: TaskRun, asset: Asset, lightings: Sequence[str], header: StageHeader
) -> None:
    """Empty ones; of several lightings those of each, and what chooses among them; and the layer
    that holds them all."""
    each = [replace(asset, lighting=name) for name in lightings] or [asset]
    chosen = ("texturing", "shading") if lightings else ()
    # What their sublayers will be is told to whoever asks what the asset needs.
    pending = {asset.uv_layer: "texturing", **{one.lights_layer: "shading" for one in each}}
    for role in ROLES[1:]:
        for one in each if role in chosen or not lightings else (asset,):
            pending |= {one.layer(role): role, one.interface(role): role}
    for layer, role in pending.items():
        write_pending_layer(run.output_once(f"layers/{layer.name}"), role, header)
    for role in chosen:
        place = run.output(f"layers/{asset.layer(role).name}")
        write_choice_of_lighting(place, role, asset, lightings, header)
        write_interface(run.output(f"layers/{asset.interface(role).name}"), place)
    write_contents(run.output(f"layers/{asset.contents_layer.name}"), asset, header)
