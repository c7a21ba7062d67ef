"""An asset -> one self-contained HTML file: what was captured, what was found of every object and
how far to believe it, pictures beside photographs, and the room in three dimensions.

The page is data (JSON) and the parts of ``static``; nothing is loaded when it is opened."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.asset.advice import read_advice
from usdbrdf.asset.header import read_header
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import read_manifest
from usdbrdf.asset.maps import AssetMaps, camera_hits
from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.asset.readers.views import Views, photographs_of_views
from usdbrdf.asset.review import changes_since, read_review
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.evaluation.evaluate_views import ViewedAsset, measured_atlas, viewed_asset
from usdbrdf.evaluation.metrics import finite
from usdbrdf.files.atomic import environment_failures, refuse_unwritable, write_text_atomic
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.ownership import reading
from usdbrdf.job.stamp import code_version
from usdbrdf.model.arrays import Float
from usdbrdf.model.capture import Frames
from usdbrdf.options import ReportOptions
from usdbrdf.page.capture import findings, frame_rows, room_map, summaries, warnings_of
from usdbrdf.page.daylight import is_dark
from usdbrdf.page.objects import object_rows, undetermined_because
from usdbrdf.page.pictures import (
    data_uri,
    objects_in_frames,
    pictures_of_map,
    status_of,
    surface_maps,
)
from usdbrdf.page.room import room_model
from usdbrdf.page.static_parts import static_part
from usdbrdf.page.views import (
    SHOWN,
    SHOWN_WIDTH,
    evaluated_views,
    models_only,
    rendered_views,
    unnamed,
)

# Frames in which objects are looked for; and of a frame's pixels what makes an object plain in it:
# the room in 3D opens as the frame looks in which most are.
_SEARCHED, _PLAIN = 64, 0.002


def report(
    folder: str | Path, output: str | Path, options: ReportOptions | None = None
) -> dict[str, Any]:
    """Write the page of the asset in ``folder`` to the file ``output``; the asset is not changed.

    Returns a summary of plain values. Raises UsdBrdfError; ``output`` is then as it was.
    """
    place, asset = Path(output), Asset.made(Path(folder))
    if place.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{place}: a page is an .html file. Name one with -o. [report.output]")
    if place.is_dir():
        raise OwnershipConflict(f"{place}: a folder has this name. Choose another. [report.output]")
    asset.refuse_output(place, "report.output")
    refuse_unwritable(place)
    data = page_data(asset, options or ReportOptions())
    text = page(data)
    with environment_failures(str(place)):
        place.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(place, text)
    return {
        "output": str(place),
        "bytes": len(text.encode("utf-8")),
        "objects": len(data["objects"]),
        "views": len(data["views"]),
        "room": data["room"] is not None,
    }


def page(data: Mapping[str, Any], served: str = "") -> str:
    """The document. served: the address that takes verdicts, "" for a file."""
    text = json.dumps({**data, "served": served}, separators=(",", ":"), allow_nan=False)
    parts = {
        "STYLE": static_part("page.css"),
        "DATA": text.replace("<", "\\u003c").replace("\u2028", "\\u2028"),
        "ROOM": static_part("room.bundle.js").replace("</script", "<\\/script"),
        "SCRIPT": static_part("page.js"),
        "LICENCE": static_part("room.bundle.LICENCE.txt"),
    }
    document = static_part("page.html")
    for name, content in parts.items():
        before, mark, after = document.partition(f"/*{name}*/")
        assert mark, name
        document = before + content + after
    return document


def page_data(asset: Asset, options: ReportOptions) -> dict[str, Any]:
    """All that the page tells, as JSON."""
    with reading(asset.folder), scratch_folder() as folder:
        return _data_of(asset, options, folder)


def _data_of(asset: Asset, options: ReportOptions, folder: Path) -> dict[str, Any]:
    """folder: for frames of lenses. What may be refused is read before the long work."""
    place, atlas = measured_atlas(asset.folder, options.lighting)
    _refuse_without_photographs(place, atlas.frames)
    # Where none is asked for it is the one that the asset opens in.
    place = place.in_lighting(atlas.lighting or None)
    up_axis = read_header(place.layer("scan")).up_axis
    said, advice, pictures = reviewed(place), read_advice(place), options.photographs
    # Pictures of ``evaluate`` are the photograph where the model has nothing to show.
    folder_of_views = options.evaluation if pictures else None
    scored = None if folder_of_views is None else evaluated_views(folder_of_views, place)
    seen = viewed_asset(place, atlas, options.environment)
    views = _asked_views(place, atlas, options, folder)
    fits = [_in_own_frames(atlas, obj.prim_path) for obj in atlas.scene.objects]
    known = [fit for fit in fits if fit is not None]
    words = [status_of(atlas, i, fit) for i, fit in enumerate(fits)]
    frames, found = atlas.frames, summaries(place)
    chosen = _frames_to_search(len(frames), known)
    where = objects_in_frames(seen.lit.rays, atlas.scene.face_object, len(words), frames.at(chosen))
    reasons = [
        undetermined_because(fit, word, in_sight=bool(where.in_sight[i]))
        for i, (fit, word) in enumerate(zip(fits, words, strict=True))
    ]
    widest = chosen[shows_most(where.share)]
    colours = next((n for n in ("base_color", "albedo") if atlas.has(n)), "lit")
    shown, rows = scored or rendered_views(seen, views, pictures)
    return {
        "name": place.name,
        "published": read_manifest(place.folder).version if place.is_published else "",
        "version": code_version(),
        "photographs": pictures,
        "capture": _of_capture(atlas, str(found["ingest"].get("adapter", ""))),
        "findings": _found_out(
            atlas, fits, words, reasons, found, is_dark(seen.lit.environment, atlas)
        ),
        "warnings": _tellable(warnings_of(found), frames, pictures),
        "rows": [unnamed(row, pictures) for row in frame_rows(frames)],
        "map": room_map(
            atlas,
            seen.lit,
            atlas.map_where_present(colours, 3),
            up_axis,
            advice[0] if advice else (),
        ),
        "objects": object_rows(
            atlas, seen, known, where, chosen, photographs=pictures, seed=options.seed
        ),
        "views": [view.told(pictures) for view in shown],
        "plot": models_only(rows),
        "maps": _maps(atlas, seen, known, _overviews(views.frames)),
        "room": room_model(
            place, atlas, seen.lit, frames.camera(widest), up_axis, options.environment
        ),
        "advice": None if advice is None else {"poses": advice[0], "current": advice[1]},
        **said,
    }


def _of_capture(atlas: AssetMaps, adapter: str) -> dict[str, Any]:
    """What went in."""
    frames = atlas.frames
    return {
        "frames": len(frames),
        "resolution": frames.resolution[0].tolist(),
        "encoding": frames.encoding,
        "lighting": atlas.lighting,
        "radiometric": bool(frames.radiometric),
        "adapter": adapter,
        "triangles": len(atlas.scene.triangles),
        "texels": len(atlas.texels),
    }


def _found_out(
    atlas: AssetMaps,
    fits: Sequence[FittedObject | None],
    words: Sequence[str],
    reasons: Sequence[str],
    found: Mapping[str, Mapping[str, Any]],
    dark_outside: bool,
) -> list[str]:
    """The sentences of ``findings``; words are those of ``status_of``, of each object."""
    named = [obj.identifier for obj in atlas.scene.objects]
    lamps = {name for name, word in zip(named, words, strict=True) if word == "lamp"}
    shining = _with_texels(atlas, lambda own: bool(atlas.emissive[own].any()))
    metals = [
        name for name, fit in zip(named, fits, strict=True) if fit is not None and fit.is_metal
    ]
    return findings(
        found,
        reasons,
        bool(atlas.frames.radiometric),
        _with_texels(atlas, lambda own: not atlas.coverage.observed[own].any()),
        [name for name in shining if name not in lamps],
        metals=[name for name in metals if name not in lamps],
        dark_outside=dark_outside,
    )


def _refuse_without_photographs(asset: Asset, frames: Frames) -> None:
    gone = [path for path in frames.image_paths if not path.is_file()]
    if gone:
        which = f"{len(gone)} of its {len(frames)} photographs are not there, such as {gone[0]}"
        if not asset.photographs_layer.is_file():
            which = f"it has no layers/{asset.photographs_layer.name}, which tells of photographs"
        raise InputRefused(
            f"{asset.folder}: {which}, and the page is made from them. Make it of the asset beside "
            "its capture, or of a version that was published with them. [report.photographs]"
        )


def reviewed(asset: Asset) -> dict[str, Any]:
    """What people said of the objects by now, of which numbers, and what changed since."""
    said = {path: asdict(one) for path, one in read_review(asset).items()}
    return {
        "review": {
            path: {**one, "phi": finite(one["phi"]), "psi": finite(one["psi"])}
            for path, one in said.items()
        },
        "changed": changes_since(asset),
    }


def _tellable(warnings: list[str] | None, frames: Frames, photographs: bool) -> list[str] | None:
    """Without those that name a photograph, unless these may be shown."""
    if warnings is None or photographs:
        return warnings
    return [w for w in warnings if not any(path.name in w for path in frames.image_paths)]


def _with_texels(atlas: AssetMaps, holds: Callable[[slice], bool]) -> list[str]:
    """Identifiers of objects of whose texels something holds."""
    return [
        obj.identifier
        for i, obj in enumerate(atlas.scene.objects)
        if holds(atlas.texels.of_object(i))
    ]


def _in_own_frames(atlas: AssetMaps, prim_path: str) -> FittedObject | None:
    """A fit with its target frame counted among the frames of the lighting that is shown; -1 where
    it is one of another."""
    fit, own = read_fit(atlas.stage, prim_path), atlas.own_frames
    if fit is None:
        return None
    inside = fit.target_frame in own
    return replace(fit, target_frame=fit.target_frame - own.start if inside else -1)


def shows_most(share: Float) -> int:
    """Which of N frames shows most objects plainly, and of these most of their surface: share (N,
    num_objects) of the frame's pixels."""
    plain = (share >= _PLAIN).sum(axis=1)
    return int(np.lexsort((share.sum(axis=1), plain))[-1])


def _frames_to_search(count: int, fits: Sequence[FittedObject]) -> list[int]:
    """Frames spread evenly, and all target frames."""
    targets = {fit.target_frame for fit in fits if 0 <= fit.target_frame < count}
    return sorted({*spread_evenly(count, _SEARCHED), *targets})


def _asked_views(asset: Asset, atlas: AssetMaps, options: ReportOptions, folder: Path) -> Views:
    """Those of the document that was named, which may need ``folder`` for frames of lenses, else
    the capture's frames."""
    if options.views is not None:
        return photographs_of_views(
            options.views, asset, atlas.stage, atlas.scene, folder, options.allow_outside
        )
    names = tuple(path.name for path in atlas.frames.image_paths)
    return Views(names=names, frames=atlas.frames)


def _overviews(frames: Frames) -> Frames:
    return frames.at(spread_evenly(len(frames), SHOWN))


def _maps(
    atlas: AssetMaps, seen: ViewedAsset, fits: Sequence[FittedObject], frames: Frames
) -> list[dict[str, Any]]:
    """Every map as the cameras of ``frames`` see it."""
    cameras = [frames.camera(i) for i in range(len(frames))]
    small = [camera.at_width(min(SHOWN_WIDTH, camera.width)) for camera in cameras]
    hits = [
        camera_hits(seen.lit.rays, frames, i, camera.width, camera.height)
        for i, camera in enumerate(small)
    ]
    return [
        {
            "name": shown.name,
            "title": shown.title,
            "legend": shown.legend,
            "pictures": [
                data_uri(picture)
                for picture in pictures_of_map(
                    seen.lit, shown, hits, [(camera.height, camera.width) for camera in small]
                )
            ],
        }
        for shown in surface_maps(atlas, fits)
    ]
