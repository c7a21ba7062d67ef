"""Every reader of foreign bytes: its seeds, how it is called, and which of the package's lines it
is made of."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from tests.fuzzing import seeds
from tests.fuzzing.seeds import Seed
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import read_manifest
from usdbrdf.asset.review import read_review
from usdbrdf.capture.adapters import read_scan
from usdbrdf.command_parser import _matrix
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.metrics import known_objects
from usdbrdf.files.documents import load_arrays
from usdbrdf.files.exif import exif_exposure
from usdbrdf.files.images import (
    colour_tag,
    image_size,
    is_eight_bit,
    read_exr,
    read_radiance,
    stored_space,
)
from usdbrdf.files.published_images import copy_without_metadata
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.stamp import read_stamp
from usdbrdf.options import IngestOptions
from usdbrdf.transport.environment import environment_from_file
from usdbrdf.untrusted import (
    colmap_models,
    e57_files,
    mesh_files,
    raw_files,
    replica_files,
    usd_cameras,
    usd_files,
    video_files,
)

# Refusals of bytes that are not the format at all; what is refused by another rule was read.
OF_THE_FORM = frozenset((
    "adapter.none", "arrays.damaged", "colmap.model", "document.depth", "document.duplicate",
    "document.json", "document.missing", "document.nonfinite", "document.size", "document.table",
    "document.xml", "e57.read", "image.format", "image.limits", "image.unreadable", "mesh.read",
    "publish.manifest", "raw.read", "review.layer", "stage.input", "video.read",
))  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Reader:
    """One reader.

    seeds     of ``seeds``: writes sound files into a folder
    read      what is called with a seed's entry
    lines     modules whose functions it is made of, of single functions "module:name,name"
    in_child  the product reads it in a child process, so that it may crash
    unknown   attributes that may hold NaN, as what they stand for may not be known
    """

    name: str
    seeds: Callable[[Path], list[Seed]]
    read: Callable[[Path], object]
    lines: tuple[str, ...]
    in_child: bool = False
    unknown: frozenset[str] = frozenset()


_IMAGES = (
    "usdbrdf.files.images:read_radiance,read_exr,image_size,colour_tag,open_image,"
    "_seek_colour,_check_limits,pixels_of,_in_display_window,_message,is_eight_bit,stored_space"
)
_DOCUMENT = "usdbrdf.files.documents:read_json,read_text,_parsed,_line_of_fault"
_NAMED = "usdbrdf.capture.formats.named_pictures"


def _whole_picture(path: Path) -> object:
    """All that is ever asked of a picture. NaN is what a picture may hold, its size not."""
    told = (image_size(path), colour_tag(path), exif_exposure(path), stored_space(path))
    shape = read_exr(path).shape
    return told, is_eight_bit(path), shape, shape[2] < 3 or read_radiance(path).shape


def _published(path: Path) -> object:
    target = path.parent / f"published{path.suffix}"
    copy_without_metadata(path, target)
    target.unlink()
    return None


def _scan(adapter: str, *, photographs: bool = False) -> Callable[[Path], object]:
    # Nothing of any capture lies in the folder that is allowed too.
    options = IngestOptions(assume_srgb=photographs, allow_outside=(Path("/nowhere/at/all"),))
    return lambda path: read_scan(path, options, adapter, plugins=False)


def _frames_of_video(path: Path) -> object:
    with scratch_folder() as folder:
        return video_files.read_here(path, (0, 2), str(folder))


def _mesh_and_model(path: Path) -> object:
    return mesh_files.read_mesh_here(path), mesh_files.read_model_here(path)


def _stage(reader: str) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        return usd_files.read_here(path, reader, [str(path.parent.resolve())])

    return read


def _whole_stage(path: Path) -> object:
    """Its layers, its meshes both ways and once more, and its cameras."""
    layers = [os.fspath(layer) for layer in usd_files.layers_of_usd(path, ())]
    whole = usd_files.meshes_from_usd(path)
    parts = usd_files.meshes_from_usd(path, subsets=True)
    usd_files.refuse_broken_meshes(path)
    return layers, whole, parts, usd_cameras.cameras_from_usd(path)


def _review(folder: Path) -> object:
    return read_review(Asset(folder, "room"))


def _with_check(path: Path) -> None:
    """Records hold a hash of themselves; what damaged them also made that good."""
    try:
        record = json.loads(path.read_bytes())
        body = {k: v for k, v in record.items() if k not in ("schema", "check")}
        text = json.dumps(body, allow_nan=False, indent=2, sort_keys=True) + "\n"
        record["check"] = hashlib.sha256(text.encode()).hexdigest()
        path.write_text(json.dumps(record))
    except (ValueError, AttributeError, RecursionError):
        pass


def _stamp(path: Path) -> object:
    _with_check(path)
    stamp = read_stamp(path)
    if stamp is None:  # what is no stamp counts as absent
        raise InputRefused(f"{path}: no stamp. [arrays.damaged]")
    return asdict(stamp)


def _manifest(folder: Path) -> object:
    _with_check(next(folder.iterdir()))
    return asdict(read_manifest(folder))


def _known(folder: Path) -> object:
    scene = SimpleNamespace(objects=[SimpleNamespace(label="box")])
    return known_objects(folder, cast(Any, SimpleNamespace(scene=scene)))


def _environment(path: Path) -> object:
    return environment_from_file(path, "Z")


def _of_capture(name: str, *, photographs: bool = False, **more: Any) -> Reader:
    """The adapter of a format, whose name in the package is the same, but for the hyphen."""
    module = name.replace("-", "_")
    lines = more.pop("lines", (f"usdbrdf.capture.formats.{module}",))
    return Reader(
        name=more.pop("called", name),
        seeds=more.pop("seeds", None) or getattr(seeds, module),
        read=_scan(name, photographs=photographs),
        lines=lines,
        unknown=frozenset(("exposure",)),
        **more,
    )


READERS = {
    reader.name: reader
    for reader in (
        *(
            Reader(name=kind, seeds=getattr(seeds, kind), read=_whole_picture, lines=(_IMAGES,))
            for kind in ("exr", "hdr", "png", "jpeg", "tiff")
        ),
        Reader(
            name="published",
            seeds=seeds.pictures,
            read=_published,
            lines=(
                "usdbrdf.files.published_images:copy_without_metadata,_tells_more,_plain_spec,"
                "_hdr_without_metadata,_check_same",
            ),
        ),
        Reader(
            name="environment",
            seeds=seeds.lights,
            read=_environment,
            lines=(
                "usdbrdf.untrusted.pictures:read_here,picture_from_file",
                "usdbrdf.transport.environment:environment_from_file,with_sun_apart",
            ),
            in_child=True,
        ),
        Reader(
            name="raw",
            seeds=seeds.dng,
            read=raw_files.read_here,
            lines=("usdbrdf.untrusted.raw_files:read_here,_rec709_from_camera",),
            in_child=True,
            unknown=frozenset(("exposure",)),
        ),
        Reader(
            name="video",
            seeds=seeds.video,
            read=_frames_of_video,
            lines=("usdbrdf.untrusted.video_files:read_here,_upright",),
            in_child=True,
        ),
        *(
            Reader(
                name=kind,
                seeds=getattr(seeds, kind),
                read=_mesh_and_model,
                lines=("usdbrdf.untrusted.mesh_files", *of_kind),
                in_child=True,
                unknown=frozenset(("corner_normals",)),
            )
            for kind, of_kind in (
                ("ply", ("usdbrdf.untrusted.mesh_ply", "usdbrdf.untrusted.ply_numbers")),
                ("obj", ("usdbrdf.untrusted.mesh_text",)),
                ("glb", ("usdbrdf.untrusted.mesh_gltf:geometry_not_read,_bent",)),
            )
        ),
        Reader(
            name="labelled-ply",
            seeds=seeds.labelled_ply,
            read=replica_files.read_here,
            lines=("usdbrdf.untrusted.replica_files",),
            in_child=True,
        ),
        Reader(
            name="colmap-text",
            seeds=seeds.colmap_text,
            read=lambda path: colmap_models.read_here(path / "sparse" / "0" / "images.txt"),
            lines=("usdbrdf.untrusted.colmap_models",),
            in_child=True,
            unknown=frozenset(("parameters", "camera_from_world")),
        ),
        Reader(
            name="colmap-binary",
            seeds=seeds.colmap_binary,
            read=lambda path: colmap_models.read_here(path / "sparse" / "0" / "images.bin"),
            lines=("usdbrdf.untrusted.colmap_models",),
            in_child=True,
            unknown=frozenset(("parameters", "camera_from_world")),
        ),
        Reader(
            name="e57-file",
            seeds=seeds.e57,
            read=e57_files.read_here,
            lines=("usdbrdf.untrusted.e57_files",),
            in_child=True,
            unknown=frozenset(("world_from_camera",)),
        ),
        Reader(
            name="usd",
            seeds=seeds.stages,
            read=_whole_stage,
            lines=(
                "usdbrdf.untrusted.usd_files",
                "usdbrdf.untrusted.usd_paths",
                "usdbrdf.untrusted.usd_cameras",
            ),
            in_child=True,
            unknown=frozenset(("corner_normals", "times", "lens", "world_from_camera")),
        ),
        Reader(
            name="usd-materials",
            seeds=seeds.materials,
            read=_stage("usdbrdf.relighting.relit_scene:read_published_here"),
            lines=(
                "usdbrdf.asset.readers.surfaces",
                "usdbrdf.asset.readers.render_scene:render_scene_from_stage",
            ),
            in_child=True,
        ),
        _of_capture("transforms"),
        _of_capture("transforms", called="photographs", photographs=True, seeds=seeds.photographs),
        _of_capture(
            "transforms",
            called="objects",
            seeds=seeds.objects,
            lines=("usdbrdf.capture.parts:label_table,segmentation,objects_with_faces",),
        ),
        _of_capture("colmap", photographs=True, seeds=seeds.colmap),
        _of_capture("scanner-app"),
        _of_capture("eyeful-tower"),
        _of_capture("fipt"),
        _of_capture("llff", photographs=True),
        _of_capture("nice-slam", photographs=True),
        _of_capture(
            "nice-slam",
            called="replica",
            photographs=True,
            seeds=seeds.replica,
            lines=("usdbrdf.capture.formats.replica_semantics",),
        ),
        _of_capture("scannetpp", photographs=True),
        _of_capture("scannet", photographs=True),
        _of_capture("metashape", photographs=True),
        _of_capture("realityscan", photographs=True),
        *(
            _of_capture(
                name,
                photographs=True,
                lines=(f"usdbrdf.capture.reconstructions.{name.replace('-', '_')}",),
            )
            for name in ("arkitscenes", "blocks-exchange", "bundler", "opf", "pix4d", "visualsfm")
        ),
        _of_capture(
            "rgbd-scan",
            photographs=True,
            lines=(
                "usdbrdf.capture.reconstructions.rgbd_scans",
                "usdbrdf.capture.reconstructions.trajectories",
            ),
        ),
        _of_capture("e57", photographs=True),
        _of_capture(
            "usd",
            called="usd-stage",
            seeds=seeds.stage_with_pictures,
            lines=("usdbrdf.capture.formats.usd_stage",),
        ),
        Reader(
            name="review",
            seeds=seeds.review,
            read=_review,
            lines=("usdbrdf.asset.review:read_review,_is_plain,_judgement",),
            unknown=frozenset(("phi", "psi")),
        ),
        Reader(
            name="stamp", seeds=seeds.stamps, read=_stamp, lines=("usdbrdf.job.stamp:read_stamp",)
        ),
        Reader(
            name="manifest",
            seeds=seeds.manifests,
            read=_manifest,
            lines=("usdbrdf.asset.manifest:read_manifest",),
        ),
        Reader(
            name="arrays",
            seeds=seeds.arrays,
            read=lambda path: [array.shape for array in load_arrays(path).values()],
            lines=("usdbrdf.files.documents:load_arrays",),
        ),
        Reader(
            name="truth",
            seeds=seeds.known_objects,
            read=_known,
            lines=("usdbrdf.evaluation.metrics:known_objects",),
        ),
        Reader(
            name="matrix",
            seeds=seeds.matrices,
            read=lambda path: _matrix(str(path)),
            lines=("usdbrdf.command_parser:_matrix",),
        ),
    )
    if not seeds.missing(reader.seeds.__name__)
}
