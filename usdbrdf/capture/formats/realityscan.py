"""RealityScan (RealityCapture): the CSV export "Internal/External camera parameters", or XMP files
beside the pictures; pictures and the exported model.

The CSV has the camera's place (x, y, alt) and heading, pitch and roll in degrees: with all three 0
the camera looks straight down with north up, and heading turns clockwise from above. The focal
length is that of a full-frame camera, in mm, along the longer side of the picture; the principal
point, parts of the longer side from the picture's middle. XMP has a rotation, world to camera in
OpenCV's axes, and the camera's position.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.camera_checks import with_doubts_about_unit
from usdbrdf.capture.checks import Findings, FrameRecord, clause_of
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import (
    FOLDERS,
    Pictures,
    drop_without_picture,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
    warn_of_unused,
)
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.images import image_size
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import (
    Element,
    beginning_of,
    beginning_of_text,
    csv_rows,
    files_of,
    number_in,
    read_xml,
)
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.options import CaptureOptions

NAME = "realityscan"
DESCRIPTION = DESCRIPTIONS[NAME]
_NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_DESCRIBED = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"
_COLUMNS = frozenset(("name", "x", "y", "alt"))
_DIRECTIONS, _FOCAL = ("heading", "yaw"), ("f", "f_35mm", "focallength35mm")
_XMP = "*.[xX][mM][pP]"
_FULL_FRAME_MM = 36.0
_NO_SKEW = 1e-6  # what scripts that write XMP leave of 0
# Models without terms; what is read as one of Brown's is called so, brown3t2 for example.
_NO_TERMS = ("none", "perspective")
_EXPORT = 'Export the registration as "Internal/External camera parameters"'


def matches(path: Path) -> bool:
    """A CSV of cameras or XMP files of this program, or a folder with such."""
    return bool(_tables(path)) or bool(_sidecars(path))


def _tables(path: Path) -> list[Path]:
    """Tables of cameras; those of control points and flight logs only where there are no others."""
    columns = {file: _columns(file) for file in files_of(path, [".csv"])}
    places = [file for file, names in columns.items() if names >= _COLUMNS]
    return [file for file in places if columns[file].intersection(_FOCAL)] or places


def _columns(file: Path) -> set[str]:
    """The names of a table's columns, none where it has not those of places."""
    lines = beginning_of_text(file).lower().splitlines()
    names = ({word.strip(' #"') for word in re.split("[,;\t]", line)} for line in lines)
    return next((found for found in names if found >= _COLUMNS), set())


def _sidecars(path: Path) -> list[Path]:
    """XMP files of this program in a folder, else in those below it and all below its pictures'."""
    deep = (path / name for name in FOLDERS if name)
    below = chain(path.glob(f"*/{_XMP}"), *(folder.rglob(_XMP) for folder in deep))
    found = (sorted({*seen_of(files, below=path)}) for files in (path.glob(_XMP), below))
    return next((files for files in found if any(map(_is_sidecar, files))), [])


def _is_sidecar(file: Path) -> bool:
    # Other programs may have written before it.
    return b"capturingreality.com/ns/xcr" in beginning_of(file, 1 << 16)


def read(path: Path, options: CaptureOptions) -> Scan:
    path = path.resolve()
    tables, findings = _tables(path), Findings()
    folder = path if path.is_dir() else path.parent
    sidecars = [] if tables else _sidecars(path)
    if len(tables) > 1 or not (tables or sidecars):
        raise InputRefused(
            f"{path}: {len(tables) or 'no'} CSV exports of cameras. {_EXPORT}, and name that file. "
            "[capture.format]"
        )
    source = tables[0] if tables else folder
    pictures = pictures_of(folder, options)
    refuse_without_pictures(pictures, source)
    if tables:
        records = list(records_of_table(source, pictures, findings))
        _warn_of_division(records, findings, source)
    else:
        records = list(records_of_sidecars(sidecars, pictures, findings))
    records = [
        replace(r, mask_path=pictures.mask_of(r.image_path, folder, options)) for r in records
    ]
    records.sort(key=lambda record: record.image_path)
    warn_of_radiance(pictures.instead, findings, source)
    warn_of_unused(pictures, (r.image_path for r in records), findings, source)
    mesh = partial(
        mesh_beside,
        folder,
        options,
        "mesh.*",
        "model.*",
        how="Export the model in the coordinate system of the cameras into this folder",
    )
    scan = scan_of(records, mesh, options, findings, adapter=NAME, source=source, folder=folder)
    return with_doubts_about_unit(scan, options, stated=scan.usd_geometry is not None)


def records_of_table(source: Path, pictures: Pictures, findings: Findings) -> Iterator[FrameRecord]:
    """The cameras of a CSV export that have a picture."""
    for row in csv_rows(source, _COLUMNS):
        name = row.get("name", "")
        place = [number_in(row, axis) for axis in ("x", "y", "alt")]
        angles = [number_in(row, *names) for names in (_DIRECTIONS, ("pitch",), ("roll",))]
        focal = number_in(row, *_FOCAL)
        if not row.keys() & _DIRECTIONS:
            raise InputRefused(
                f"{source}: places of cameras without directions and focal lengths. {_EXPORT}. "
                "[capture.format]"
            )
        if None in place or None in angles or focal is None or not focal > 0:
            findings.drop(name, "its row has no place, direction and focal length", "capture.pose")
            continue
        pose = rigid_pose(_axes(*(float(a or 0) for a in angles)), np.array(place, np.float64))
        centre = [number_in(row, *names) or 0.0 for names in (("px", "px_norm"), ("py", "py_norm"))]
        terms = [number_in(row, term) or 0.0 for term in ("k1", "k2", "k3", "k4", "t1", "t2")]
        lens = _brown(terms)
        yield from _record(name, pictures.named(name), pose, focal, centre, lens, findings)


def _warn_of_division(records: Sequence[FrameRecord], findings: Findings, source: Path) -> None:
    """One sentence where lenses have k1 alone. The table does not name their model, and only
    Division has no further term; its k1 is not Brown's, although both bend alike near the axis."""
    alone = [
        r for r in records if r.lens.bends and not any((*r.lens.radial[1:], *r.lens.tangential))
    ]
    if alone:
        findings.warn(
            f"{source.name}: {len(alone)} cameras have k1 alone, as the model Division does; it is "
            "taken for Brown's. If it is not, choose Brown3 in the alignment's settings, and "
            "export again. [capture.camera]"
        )


def _axes(heading: float, pitch: float, roll: float) -> Double:
    """(3, 3) world (x east, y north, z up) from camera, OpenGL's axes, of angles in degrees."""
    turns = np.radians([-heading, pitch, roll])
    (ch, cp, cr), (sh, sp, sr) = np.cos(turns), np.sin(turns)
    about_z = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return np.asarray(about_z @ about_x @ about_y)


def records_of_sidecars(
    files: list[Path], pictures: Pictures, findings: Findings
) -> Iterator[FrameRecord]:
    """The cameras of XMP files, each beside its picture or of its name."""
    all_files, divided = set(files), 0
    for file in files:
        name, image = _name_and_picture(file, all_files, pictures)
        said = _sidecar_values(read_xml(file))
        rotation, place = _numbers(said, "Rotation", 9), _numbers(said, "Position", 3)
        focal = number_in(said, "FocalLength35mm")
        lens = _lens(said)
        if lens is None:
            model, terms = said.get("DistortionModel", ""), said.get("DistortionCoeficients", "")
            raise InputRefused(
                f"{file}: the lens model {model!r} is not read with the terms {terms[:60]!r}. "
                "Choose Brown in the alignment's settings, and export again. [capture.camera]"
            )
        if abs(number_in(said, "Skew") or 0.0) > _NO_SKEW:
            raise InputRefused(
                f"{file}: its lens has a skew of {said['Skew'][:40]}, which is not read. Set it to "
                "0 in the alignment's settings, and export again. [capture.camera]"
            )
        if said.get("Coordinates", "absolute") != "absolute":
            raise InputRefused(
                f"{file}: coordinates are {said['Coordinates'][:40]!r}. Export absolute ones. "
                "[capture.pose]"
            )
        if rotation is None or place is None or focal is None or not focal > 0:
            findings.drop(
                name, "its XMP has no rotation, position and focal length", "capture.pose"
            )
            continue
        centre = [number_in(said, f"PrincipalPoint{axis}") or 0.0 for axis in "UV"]
        pose = opengl_from_opencv(rigid_pose(rotation.reshape(3, 3).T, place))
        squeeze = number_in(said, "AspectRatio") or 1.0
        for record in _record(name, image, pose, focal, centre, lens, findings, squeeze):
            divided += record.lens.curve == "division"
            yield record
    if divided:
        findings.warn(
            f"{files[0].parent.name}: the lens model of {divided} cameras is Division, whose "
            "equation is not published; taken is Fitzgibbon's, r / (1 + k1 r^2). If the frames do "
            "not agree, choose Brown3 in the alignment's settings, and export again. "
            "[capture.camera]"
        )


def _name_and_picture(
    file: Path, all_files: Collection[Path], pictures: Pictures
) -> tuple[str, Path | None]:
    """Of the camera of an XMP file: the picture beside it, else the one of its name elsewhere that
    has no XMP of its own."""
    inside = file.is_relative_to(pictures.folder)
    place = file.relative_to(pictures.folder) if inside else Path(file.parent.name, file.name)
    name = place.with_suffix("").as_posix()
    image = pictures.named(name)
    own = file if image is None else image.with_suffix(file.suffix)
    return name, image if own == file or own not in all_files else None


def _sidecar_values(root: Element) -> dict[str, str]:
    """What an XMP says, as attributes or as elements. What other programs have added stands in
    descriptions of its own, before or after."""
    values: dict[str, str] = {}
    for described in root.iterfind(f".//{_DESCRIBED}"):
        values |= {k.removeprefix(_NAMESPACE): v for k, v in described.attrib.items()}
        values |= {c.tag.removeprefix(_NAMESPACE): c.text or "" for c in described}
    return values


def _lens(said: Mapping[str, str]) -> Lens | None:
    """Of the model that an XMP names; None of one that is not read."""
    model = said.get("DistortionModel", "")
    if model in _NO_TERMS:
        return PINHOLE
    words = said.get("DistortionCoeficients", "").split()
    try:
        k1, *more = [float(word) for word in words] + [0.0] * (6 - len(words))
    except ValueError:
        return None
    if not np.isfinite([k1, *more]).all() or len(more) > 5:
        return None
    if not (model or k1 or any(more)):
        return PINHOLE
    if model.startswith("brown"):
        # Of fewer than six, where t1 and t2 stand is known only if there are none.
        radial = int(model[5:6]) if model[5:6] in ("3", "4") else 4
        known = len(words) == 6 or not any(more[radial - 1 :])
        return _brown([k1, *more]) if known else None
    known = model == "division" and not any(more)
    return Lens(curve="division", shape=(k1,)) if known else None


def _numbers(said: Mapping[str, str], key: str, count: int) -> Double | None:
    try:
        values = np.array(said.get(key, "").split(), np.float64)
    except ValueError:
        return None
    return values if len(values) == count and np.isfinite(values).all() else None


def _brown(terms: Sequence[float]) -> Lens:
    """Of k1 to k4, t1, t2."""
    # Its own template for OpenCV writes k1, k2, t2, t1: the other way round.
    return Lens(radial=tuple(terms[:4]), tangential=(terms[5], terms[4]))


def _record(
    name: str,
    image: Path | None,
    pose: Double,
    focal: float,
    centre: list[float],
    lens: Lens,
    findings: Findings,
    squeeze: float = 1.0,
) -> Iterator[FrameRecord]:
    """squeeze: the vertical focal length over the horizontal one."""
    if image is None:
        drop_without_picture(name, findings)
        return
    try:
        width, height, _ = image_size(image)
    except ImageRefused as error:
        findings.drop(name, clause_of(error, image), "capture.image")
        return
    longer = max(width, height)
    yield FrameRecord(
        name=name,
        image_path=image,
        world_from_camera=pose,
        intrinsics=(
            focal * longer / _FULL_FRAME_MM,
            focal * squeeze * longer / _FULL_FRAME_MM,
            width / 2 + centre[0] * longer,
            height / 2 + centre[1] * longer,
        ),
        resolution=(width, height),
        size_of_image=True,
        lens=lens if lens.bends else PINHOLE,
    )
