"""What many formats have in common: cameras that name a picture, pictures in folders, and a mesh
beside them, in one frame and unit."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

from usdbrdf.capture.checks import Findings, FrameRecord, refuse_photographs
from usdbrdf.capture.develop import with_rims
from usdbrdf.capture.mesh_frames import (
    LabelTable,
    folder_of_masks,
    folders_but_masks,
    mask_beside,
    path_in_capture,
    without_copies,
)
from usdbrdf.capture.parts import (
    as_photographs,
    geometry_from_file,
    radiance_encoding,
    scan_from_parts,
)
from usdbrdf.errors import ImageRefused, InputRefused, UsageError
from usdbrdf.files.colour import kind_of_encoding
from usdbrdf.files.images import RAW_SUFFIXES, kind_of_colours
from usdbrdf.files.naming import composed, ends_of, meant_by, must_be_undistorted, number_at_end
from usdbrdf.files.paths import AS_JPEG, OtherLetters, contained, is_heif, seen_of
from usdbrdf.model.capture import Scan
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.mesh_files import FileMesh

# In the order in which they are taken where one name has several: radiance first.
SUFFIXES = (".exr", ".hdr", ".tif", ".tiff", ".png", ".jpg", ".jpeg")
# What cameras write and nothing here reads: documents name it, and what was made of it is there.
_HEIF = frozenset((".heic", ".heif", ".hif", ".avif"))
_OF_CAMERAS = RAW_SUFFIXES | _HEIF
# Poses are found of these, and radiance beside them is taken instead; PNG has depths more often.
_PHOTOGRAPHS, _RADIANCE = frozenset((".jpg", ".jpeg")) | _OF_CAMERAS, (".exr", ".hdr")
# Where programs put the pictures, beside what they say of them.
FOLDERS = ("frames", "images", "Images", "image", "Image", "photos", "undistorted", "")
# Of documents that name pictures where they lay on another machine.
_OTHER_FOLDER = "Name the folder of the pictures with --frames, or name them relative to this one"
_LINKED = "Name the folder that the pictures themselves lie in with --frames"
_THERE = "It is there: allow its folder with --allow-outside, or put the file inside this one"
_LETTERS: tuple[Callable[[str], str], ...] = (str, str.lower)  # in which names are compared


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """The pictures below some folder, to be asked for by the names that documents have for them.

    folder   absolute; nothing outside it is found
    paths    all of them, absolute, sorted
    instead  of photographs that were asked for the radiance beside them, which was taken
    """

    folder: Path
    paths: tuple[Path, ...]
    instead: dict[Path, Path] = field(default_factory=dict)

    def named(self, label: str) -> Path | None:
        """The picture of this name: by its path below the folder, else by the end of its path, each
        in these letters, else in others, else by its name alone, with its suffix or another; of a
        photograph with radiance beside it that; None where there is none or several."""
        written = PurePosixPath(composed(label).replace("\\", "/").lstrip("./"))
        known = (n for n in _names_without_suffix(written.name) if n.lower() in self._by_stem)
        if (stem := next(known, None)) is None:
            return None
        candidates = self._by_stem[stem.lower()]
        found: list[Path] = []
        for change, path_of in zip(_LETTERS, self._paths_of[stem.lower()], strict=True):
            # Of paths that differ in case alone nobody knows which is meant.
            if not found and len(path_of) == len(candidates):
                wanted = PurePosixPath(change(str(written)))
                found = [path_of[p] for p in meant_by(wanted, change(stem), path_of)]
        found = found or [path for path, p in candidates if p.stem == stem]
        path = nearest_to_radiance(found or [path for path, _ in candidates])
        return path and _or_radiance(path, [p for p, _ in candidates], self.instead)

    def of_each_name(self) -> tuple[Path, ...]:
        """One picture of each name: of a photograph with radiance beside it that. All of them where
        two of one name are of one kind."""
        alike: dict[Path, list[Path]] = {}
        for path in self.paths:
            alike.setdefault(path.with_suffix(""), []).append(path)
        chosen, instead = list[Path](), dict[Path, Path]()
        for some in alike.values():
            if (best := nearest_to_radiance(some)) is None:
                return self.paths
            chosen.append(best)
            if _is_radiance(best):
                instead.update((p, best) for p in some if p.suffix.lower() in _PHOTOGRAPHS)
        self.instead.update(instead)
        return tuple(chosen)

    def mask_of(self, picture: Path, folder: Path, options: CaptureOptions) -> Path | None:
        """``mask_beside`` of a picture, or of another of its name beside it, by its path below the
        pictures' folder, else by its name alone, where no other folder has a picture of it."""
        stem = composed(picture.stem)
        alike = [path for path, p in self._by_stem[stem.lower()] if p.stem == stem]
        beside = [path for path in alike if path.parent == picture.parent]
        names = [path.relative_to(self.folder).as_posix() for path in beside]
        if len(beside) == len(alike):
            names += [path.name for path in beside]
        masks = (mask_beside(folder, name, options) for name in dict.fromkeys(names))
        return next((mask for mask in masks if mask is not None), None)

    @cached_property
    def _by_stem(self) -> dict[str, list[tuple[Path, PurePosixPath]]]:
        by_stem: dict[str, list[tuple[Path, PurePosixPath]]] = {}
        for path in self.paths:
            relative = PurePosixPath(composed(path.relative_to(self.folder).as_posix()))
            by_stem.setdefault(relative.stem.lower(), []).append((path, relative))
        return by_stem

    @cached_property
    def _paths_of(self) -> dict[str, list[dict[PurePosixPath, Path]]]:
        """The same by their paths in ``_LETTERS``: many folders may have pictures of one name."""
        return {
            stem: [{PurePosixPath(to(str(p))): path for path, p in alike} for to in _LETTERS]
            for stem, alike in self._by_stem.items()
        }

    @cached_property
    def originals(self) -> Pictures:
        """Without copies."""
        return replace(self, paths=without_copies(self.paths))

    def numbered(self) -> dict[int, Path]:
        """The pictures by the number at the end of their names, those without left out; of two of
        one number the one that is no copy, or is nearer to radiance."""
        found: dict[int, list[Path]] = {}
        for path in self.originals.paths:
            found.setdefault(number_at_end(path.stem), []).insert(0, path)
        return {i: _nearest(alike)[0] for i, alike in sorted(found.items()) if i >= 0}


def nearest_to_radiance(found: Sequence[Path]) -> Path | None:
    """Of pictures that may be the one that is meant; None where several of one kind are."""
    nearest = _nearest(found)
    return nearest[0] if len(nearest) == 1 else None


def _nearest(found: Sequence[Path]) -> Sequence[Path]:
    """Of several pictures of one name those with colours, as far as there are any: the others are
    its depths, its normals or its mask, of whatever kind of file, and no frame can be read from
    them. Of these the nearest to radiance; and of them those whose colours are no layer's."""
    if len(found) < 2:
        return found
    kinds = {path: _kind_of_colours(path) for path in found}
    found = [path for path in found if kinds[path]] or found
    nearness = {path: SUFFIXES.index(path.suffix.lower()) for path in found}
    found = [path for path in found if nearness[path] == min(nearness.values())]
    return [path for path in found if kinds[path] == max(kinds[path] for path in found)]


def _or_radiance(path: Path, alike: Sequence[Path], instead: dict[Path, Path]) -> Path:
    """A picture, or of a photograph the radiance beside it, of those ``alike`` in name, which is
    noted in ``instead``."""
    if path.suffix.lower() in _PHOTOGRAPHS:
        radiance = [p for p in alike if p.parent == path.parent and _is_radiance(p)]
        if found := nearest_to_radiance(radiance):
            instead[path] = found
            return found
    return path


def _is_radiance(path: Path) -> bool:
    """Whether a picture beside a photograph is its radiance: without colours it is its depths."""
    return path.suffix.lower() in _RADIANCE and _kind_of_colours(path) > 0


def _kind_of_colours(path: Path) -> int:
    try:
        return kind_of_colours(path)
    except ImageRefused:  # of which the reader of its pixels will tell
        return 2


def warn_of_radiance(instead: Mapping[Path, Path], findings: Findings, source: Path) -> None:
    """One sentence where radiance was taken instead of photographs that are there."""
    if instead:
        photograph, radiance = next(iter(instead.items()))
        findings.warn(
            f"{source.name}: {len(instead)} of the photographs that it names have radiance beside "
            f"them, which is taken instead, first {radiance.name!r} for {photograph.name!r}. "
            "[capture.file]"
        )


def pictures_of(folder: Path, options: CaptureOptions, *usual: str) -> Pictures:
    """The pictures of a capture: of ``--frames``, else of the first of the ``usual`` folders that
    holds any, also if its name differs in case; without these of the first of those that most
    programs use, else of the only folder that holds any but masks."""
    if options.frames is not None:
        if not options.frames.is_dir():
            raise UsageError(f"--frames {options.frames}: no such folder. Name one. [usage.option]")
        return _below(options.frames.resolve(), deep=True)
    called = OtherLetters(folder)
    for name in usual or FOLDERS:
        place = path_in_capture(folder, name, options, cure=_LINKED) if name else folder
        place = called.of(place)
        if place.is_dir() and (found := _below(place, deep=bool(name))).paths:
            return found
    others = () if usual else folders_but_masks(folder)
    holding = [found for found in (_below(p, deep=True) for p in others) if found.paths]
    return holding[0] if len(holding) == 1 else Pictures(folder=folder, paths=())


def _below(folder: Path, *, deep: bool) -> Pictures:
    """Pictures in a folder; links that lead out of it do not count."""
    found = folder.rglob("*") if deep else folder.glob("*")
    inside = (p for p in seen_of(found, below=folder) if p.suffix.lower() in SUFFIXES)
    home = folder.resolve()
    paths = (p for p in inside if p.is_file() and p.resolve().is_relative_to(home))
    return Pictures(folder=folder, paths=tuple(sorted(paths)))


@dataclass(frozen=True, kw_only=True)
class Pictured:
    """The pictures that a document names by paths below a folder.

    otherwise  names of those that are not there, or not read here, and the files that were taken
    instead    of photographs that it names the radiance beside them, which was taken
    moved      paths that lead out of the folder, and what was taken at their ends in it
    """

    folder: Path
    options: CaptureOptions
    otherwise: dict[str, Path] = field(default_factory=dict)
    moved: dict[str, Path] = field(default_factory=dict)
    instead: dict[Path, Path] = field(default_factory=dict)
    _listed: dict[Path, dict[str, list[Path]]] = field(default_factory=dict)
    _refused: list[InputRefused] = field(default_factory=list)

    _letters = cached_property(lambda self: OtherLetters(self.folder))

    def of(self, name: str, below: str = "") -> Path | None:
        """The picture called ``name`` in the folder ``below``: the file of this name, else the one
        there whose name differs in nothing but case and kind of picture, radiance first; of a
        photograph that is there too, the radiance beside it, of HEIF any; of what leads out, as
        from where the capture lay before, that at its end. Of ``--frames``, the picture there that
        has its name. None where there is none. InputRefused for what leads out and is there.
        """
        if self.options.frames is not None:
            return self._of_frames.named(name)
        whole = f"{below}/{name}" if below else name
        try:
            path = path_in_capture(self.folder, whole, self.options, cure=_OTHER_FOLDER)
            if "\\" in name and not path.is_file():
                whole = whole.replace("\\", "/")
                path = path_in_capture(self.folder, whole, self.options, cure=_OTHER_FOLDER)
        except InputRefused as refused:
            found = self._at_end_of(whole, lambda path: self._picture(path, name))
            if found is None:
                self._refused.append(refused)
            return found
        return self._picture(path, name)

    def refuse_what_leads_out(self) -> None:
        """InputRefused if pictures lead out of the folder and not one was found at its end in it;
        to be asked once all are asked for, in whatever order."""
        if self._refused and not self.moved:
            raise self._refused[0]

    def _picture(self, path: Path, name: str) -> Path | None:
        beside = self._in_folder(path.parent)
        names = _names_without_suffix(composed(path.name).lower())
        alike = next((beside[stem] for stem in names if stem in beside), [])
        if path.is_file() and not (alike and path.suffix.lower() in _HEIF):
            return _or_radiance(path, alike, self.instead)
        kind = _kind_of_file(path)
        if any(_kind_of_file(one) == kind for found in beside.values() for one in found):
            # Where some are of the kind that is named, what is of another may be their depths.
            alike = [one for one in alike if _kind_of_file(one) == kind or _is_radiance(one)]
        nearest = nearest_to_radiance(alike)
        if nearest and composed(path.name) not in map(composed, (nearest.name, nearest.stem)):
            self.otherwise[name] = nearest
        return nearest

    def file(self, name: str, *, fewest: int = 1) -> Path:
        """Another file that the document names, which need not be there; else the only one whose
        path differs in case alone; of what leads out that at an end of ``fewest`` parts or more."""

        def look(path: Path) -> Path | None:
            return found if (found := self._letters.of(path)).is_file() else None

        path_of = name if os.path.lexists(self.folder / name) else name.replace("\\", "/")
        try:
            path = path_in_capture(self.folder, path_of, self.options)
        except InputRefused:
            if found := self._at_end_of(name, look, fewest):
                return found
            raise
        found = look(path) or path
        if composed(found.name) != composed(path.name):
            self.otherwise[name] = found
        return found

    def _at_end_of(
        self, path: str, look: Callable[[Path], Path | None], fewest: int = 1
    ) -> Path | None:
        """What one looks for at the first end of a path where it is, if that does not lead out;
        InputRefused where the path itself leads to something, which is meant."""
        if any(os.path.lexists(self.folder / f"{path}{suffix}") for suffix in ("", *SUFFIXES)):
            contained(self.folder, path, cure=_THERE)
        for end in ends_of(path):
            with suppress(InputRefused):
                enough = end.count("/") + 1 >= fewest
                if enough and (found := look(path_in_capture(self.folder, end, self.options))):
                    self.moved[path] = found
                    return found
        return None

    def warn_of_others(self, findings: Findings, source: Path) -> None:
        """One sentence each where pictures were taken for others, and radiance for photographs."""
        self.refuse_what_leads_out()
        if self.moved:
            name, path = next(iter(self.moved.items()))
            findings.warn(
                f"{source.name}: {len(self.moved)} of the files that it names lie elsewhere, as "
                "before the capture was moved; those at the ends of their paths in this folder are "
                f"taken, first {str(path)!r} for {name[:200]!r}. [capture.moved]"
            )
        frames = self._of_frames.instead if self.options.frames is not None else {}
        warn_of_radiance(self.instead | frames, findings, source)
        if self.otherwise:
            name, path = next(iter(self.otherwise.items()))
            findings.warn(
                f"{source.name}: {len(self.otherwise)} pictures of other names are taken for those "
                f"that it names, which are not there or not read, first {path.name!r} for "
                f"{name!r}. [capture.file]"
            )

    @cached_property
    def _of_frames(self) -> Pictures:
        return pictures_of(self.folder, self.options)

    def _in_folder(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._listed:
            of_stem = self._listed[folder] = {}
            place = self._letters.of(folder)
            for path in _below(place, deep=False).paths if place.is_dir() else ():
                of_stem.setdefault(composed(path.stem).lower(), []).append(path)
        return self._listed[folder]


def _kind_of_file(path: Path) -> str:
    return {".jpeg": ".jpg", ".tiff": ".tif"}.get(kind := path.suffix.lower(), kind)


def _names_without_suffix(name: str) -> tuple[str, ...]:
    """What the files of a picture may be called, but for their suffix, the first that is there. Of
    a camera's file, IMG_1.CR2, some programs that develop it make IMG_1.CR2.jpg."""
    stem, _, kind = name.rpartition(".")
    kind = f".{kind.lower()}"
    if kind in _OF_CAMERAS:
        return name, stem
    return (stem,) if kind in SUFFIXES else (name,)


def drop_without_picture(label: str, findings: Findings) -> None:
    """Leave out a camera whose picture was not found."""
    findings.drop(label, "no picture, or more than one, has this name", "capture.file")


def refuse_without_pictures(pictures: Pictures, source: Path) -> None:
    """InputRefused where no picture was found at all."""
    if not pictures.paths:
        there = seen_of(pictures.folder.rglob("*"))
        how = ". Put them beside it in a folder images, or name their folder with --frames"
        links = (p for p in there if p.is_symlink() and p.suffix.lower() in SUFFIXES)
        if link := next(links, None):
            how = f": {link.name} is a link that leads out of it, or nowhere. {_LINKED}"
        found = (p for p in there if p.suffix.lower() in _HEIF)
        if heif := next(filter(is_heif, found), None):
            how = f" that are read: {heif.name} is {AS_JPEG}"
        raise InputRefused(f"{source}: no pictures below {pictures.folder}{how}. [capture.frames]")


def scan_of(
    records: Sequence[FrameRecord],
    geometry: Path | Callable[[], Path | ScanGeometry],
    options: CaptureOptions,
    findings: Findings,
    *,
    adapter: str,
    source: Path,
    folder: Path,
    meters_per_unit: float = 1.0,
    up_axis: str = "Z",
    encoding: str | None = None,
    radiometric: bool = True,
    name: str = "",
    objects: Callable[[FileMesh], LabelTable] | None = None,
) -> Scan:
    """The capture of these frames and this mesh (a file, or what finds or reads it, which is asked
    once the poses are known to be sound: ``inspect`` tells of the frames where there is none).

    objects   what knows the objects of the mesh; ``--objects`` comes first
    source    the document that messages name; ``folder``, the capture's own, absolute
    encoding  of the images, where the format says, which are to be of that kind; the user's first
    radiometric  False of linear images that 8-bit photographs became
    """
    for record in records:
        if record.lens.bends and must_be_undistorted(record.image_path, (folder, options.frames)):
            raise InputRefused(
                f"{record.image_path}: a picture that has been undistorted, as its folder is "
                f"called, but the lens of {record.name!r} in {source.name} bends light. Bring the "
                "original pictures, or the cameras that were exported for these; or rename the "
                "folder, if these are the originals. [capture.camera]"
            )
    records = with_rims(records, (folder, options.frames), findings, source)
    if masks := sum(record.mask_path is not None for record in records):
        findings.warn(
            f"{source.name}: {masks} masks are used; what is black there is not looked at. "
            "[capture.mask]"
        )
    elif unused := folder_of_masks(folder):
        no_frames = "none of its pictures is called as one of the frames, or named by it"
        why = no_frames if unused == "masks" else "it is not called masks: rename it"
        findings.warn(
            f"{source.name}: nothing is masked: there is a folder {unused}, but {why}. "
            "[capture.mask]"
        )
    encoding = options.encoding or encoding
    photographs = refuse_photographs(
        [r.image_path for r in records], assume_srgb=options.assume_srgb, encoding=encoding
    )
    if options.encoding is None and encoding is not None:
        if photographs != (kind_of_encoding(encoding) == "display"):
            kind = "8-bit photographs" if photographs else "scene-linear images"
            raise InputRefused(
                f"{source}: encoding is {encoding!r}, but the images are {kind}. Remove or correct "
                "it. [capture.format]"
            )
        options = replace(options, encoding=encoding)
    if photographs:
        records = as_photographs(records, findings, source)
    else:
        if not radiometric:
            findings.warn(
                f"{source.name}: says that its images are not radiometric, so neither is the "
                "result: colours and relative brightness only. [capture.ldr]"
            )
        if unknown := sum(math.isinf(r.saturation_radiance) for r in records):
            findings.warn(
                f"{source.name}: {unknown} of {len(records)} frames state no saturation, so "
                "clipped pixels pass for radiance. [capture.saturation]"
            )

    def read_geometry() -> ScanGeometry:
        found = geometry if isinstance(geometry, Path) else geometry()
        if not isinstance(found, Path):
            return found
        return geometry_from_file(
            found,
            options.objects or objects,
            options,
            findings,
            capture_root=folder,
            meters_per_unit=meters_per_unit,
        )

    return scan_from_parts(
        records,
        read_geometry,
        options,
        findings,
        name=name or folder.name,
        adapter=adapter,
        source=source,
        encoding=radiance_encoding(options, photographs=photographs),
        radiometric=radiometric and not photographs,
        meters_per_unit=meters_per_unit,
        up_axis=up_axis,
    )


def warn_of_unused(
    pictures: Pictures, used: Iterable[Path], findings: Findings, source: Path
) -> None:
    """One sentence where pictures have no camera."""
    # Of a photograph and its radiance one is used.
    known = {path.with_suffix("") for path in used}
    left = [path for path in pictures.paths if path.with_suffix("") not in known]
    if left:
        findings.count("pictures_without_camera", len(left))
        findings.warn(
            f"{source.name}: {len(left)} of {len(pictures.paths)} pictures have no camera, first "
            f"{left[0].name!r}. [capture.unused]"
        )
