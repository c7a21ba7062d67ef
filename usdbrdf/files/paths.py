"""Paths that may not lead out of the folder that governs them: a document's, and our own writes."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict
from usdbrdf.files.naming import composed

_URI = re.compile(r"^(?:[a-z][a-z0-9+.\-]+://|(?:file|data):)", re.IGNORECASE)
_ABSOLUTE = re.compile(r"^(?:[/\\~]|[A-Za-z]:[/\\])")  # POSIX, UNC, home, Windows drive
# How what Git LFS leaves in the place of a file begins, and how long it may be.
_POINTER, _LONGEST_POINTER = b"version https://git-lfs.github.com/spec/", 1024
_LITTER = (".DS_Store", "._*", "Thumbs.db", "ehthumbs.db", "desktop.ini", ".directory", "*~")


_CURE = "Put the file inside the folder and name it relative to it"


def contained(root: Path, candidate: str, *, cure: str = "") -> Path:
    """The absolute path of ``candidate`` below ``root``; symbolic links are judged by their target.

    Nothing is opened, and the file need not exist. Absolute paths are refused even if they lie
    inside: they would break as soon as the capture is moved. ``cure`` is what the refusal says to
    do, if not to put the file inside.
    """
    cause: Exception | None = None
    if not candidate or "\0" in candidate:
        reason = "is not a file name"
    elif _URI.match(candidate):
        reason = "is a URI, only relative paths are followed"
    elif _ABSOLUTE.match(candidate):
        reason = "is an absolute path, only relative paths are followed"
    else:
        try:
            home = root.resolve()
            path = (home / candidate).resolve()
            with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
                path.stat()
            if path.is_relative_to(home):
                return path
            reason = "leads outside that folder"
        except (OSError, RuntimeError, ValueError) as error:  # too long a name, a loop of links
            # Without the path, which may be the long part.
            words = getattr(error, "strerror", None) or getattr(error, "reason", None) or error
            cause, reason = error, f"cannot be resolved ({str(words)[:200]})"
    shown = repr(candidate if len(candidate) <= 200 else candidate[:200] + "...")
    raise InputRefused(
        f"{str(root)!r}: the path {shown} {reason}. {cure or _CURE}. [paths.outside]"
    ) from cause


def inside(root: Path, place: Path) -> Path:
    """``place`` itself; OwnershipConflict if links on the way to it lead out of ``root``.

    To be asked right before each write below ``root``. Nothing need exist yet.
    """
    target = os.path.realpath(place)
    if not Path(target).is_relative_to(os.path.realpath(root)):
        raise OwnershipConflict(
            f"{place}: a link that leads out of {root}, to {target}. Nothing is written through "
            "it; put a folder in its place. [ownership.link]"
        )
    return place


def refuse_misplaced(root: Path, files: Iterable[Path], folders: Iterable[Path] = ()) -> None:
    """OwnershipConflict where a folder lies in the place of a file of ours below ``root``, or
    something else, a link to nothing too, in that of one of ``folders`` or of a folder above:
    putting files in place would stop there each time, with some of them of another run."""

    def refuse_no_folder(places: Iterable[Path]) -> None:
        for place in (place for place in places if place.is_relative_to(root)):
            if os.path.lexists(place) and not place.is_dir():
                raise misplaced(place, "no folder", "folder")

    for file in files:
        if file.is_dir():
            raise misplaced(file, "a folder")
        refuse_no_folder(file.parents)
    for folder in folders:
        refuse_no_folder((folder, *folder.parents))


def misplaced(place: Path, found: str, wanted: str = "file") -> OwnershipConflict:
    """What to say of something that lies in the place of a file, or a folder, of ours."""
    return OwnershipConflict(
        f"{place}: this is {found}, and a {wanted} of usdbrdf's is to be here. Move it away and "
        "run the same command again. [ownership.place]"
    )


def refuse_nameless(path: Path | None) -> None:
    """InputRefused where the absolute path is not UTF-8, as every path in a layer of USD is."""
    try:
        (os.path.realpath(path) if path else "").encode()
    except UnicodeEncodeError as error:
        raise InputRefused(
            f"{str(path)!r}: this name, or that of a folder above, is not UTF-8, so that USD "
            "cannot refer to it. Rename it. [paths.name]"
        ) from error


def readable_size(image: Path) -> int | str:
    """Bytes of an image's file; or, where no library could open it, why, and what to do."""
    try:
        status = image.stat()
        str(image).encode()
    except UnicodeEncodeError:  # it would look for another
        return "its name is not UTF-8. Rename the file"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        return f"cannot be read ({reason}). Check name and permission"
    if not stat.S_ISREG(status.st_mode):  # a FIFO would block for ever
        return "not a regular file. Name an image file"
    if not os.access(image, os.R_OK):
        return "permission denied. Make it readable"
    return why_not_fetched(image) or (AS_JPEG if is_heif(image) else status.st_size)


# Of what telephones write, and what to do; these programs turn the pixels upright and keep the
# colour profile.
AS_JPEG = (
    "HEIC or AVIF, which is not read here. Make JPEGs of all, of the same names, beside them: "
    "'heif-convert -q 97 IMG.HEIC IMG.jpg' of libheif, or 'sips -s format jpeg' of macOS"
)


def is_heif(file: Path) -> bool:
    """Whether a file is in the container of HEIC and AVIF, whatever it is called."""
    with suppress(OSError), file.open("rb") as opened:
        head = opened.read(12)
        return head[4:8] == b"ftyp" and head[8:12] in _HEIF_BRANDS
    return False


_HEIF_BRANDS = frozenset(
    (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"avif", b"avis")
)


def why_not_fetched(file: Path) -> str | None:
    """Why a regular file is none of what its name says, and what to do, where it is what Git LFS
    leaves in its place; else None."""
    with suppress(OSError):
        if file.stat().st_size <= _LONGEST_POINTER and file.read_bytes().startswith(_POINTER):
            return (
                "a pointer of Git LFS, not the file itself. Fetch it with 'git lfs pull', or "
                "download it"
            )
    return None


def refuse_lost_folder() -> None:
    """EnvironmentFailure where the current folder was removed or its disk is gone: what is relative
    to it leads nowhere, and libraries end the process."""
    try:
        os.getcwd()
    except OSError as error:
        raise EnvironmentFailure(
            f"the current folder: {error.strerror}. Change into one that is there. "
            "[environment.folder]"
        ) from error


def files_below(folder: Path, *, without: Path) -> list[Path]:
    """The files in a folder and in those below it, sorted, but for those in ``without`` and what
    operating systems and editors leave by themselves."""
    # Both may be named by a relative path, or through a link.
    whole, own = folder.resolve(), without.resolve()
    return sorted(
        path
        for path in folder.rglob("*")
        if not any(path.match(pattern) for pattern in _LITTER)
        and path.is_file()
        and not (whole / path.relative_to(folder)).is_relative_to(own)
    )


@dataclass(frozen=True)
class OtherLetters:
    """What lies below a folder, to be asked for by paths that documents write in other letters."""

    root: Path
    _there: dict[Path, dict[str, list[Path]]] = field(default_factory=dict)

    def of(self, path: Path) -> Path:
        """The path itself where something is there or it does not lie below the root; else the only
        one whose names differ in nothing but case and how accents are written; else the path."""
        is_below = path != self.root and path.is_relative_to(self.root) and ".." not in path.parts
        if not is_below or os.path.lexists(path):
            return path
        alike = self._in(self.of(path.parent)).get(composed(path.name).lower(), [])
        return alike[0] if len(alike) == 1 else path

    def _in(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._there:
            of_name = self._there[folder] = {}
            with suppress(OSError):  # of what nobody may look into, or cannot be, nothing is known
                for path in folder.iterdir() if folder.is_dir() else ():
                    if not path.is_symlink():  # it may lead out
                        of_name.setdefault(composed(path.name).lower(), []).append(path)
        return self._there[folder]


def seen_of(found: Iterable[Path], *, below: Path | None = None) -> list[Path]:
    """Sorted, without what systems leave beside what people put there: .DS_Store, of each file a
    ._NAME that ends as that does, and whatever else is hidden; ``below`` a folder, whose own path
    may be, also what is in hidden folders."""

    def seen(path: Path) -> bool:
        names = path.relative_to(below).parts if below else (path.name,)
        return not any(name[0] == "." for name in names) and not any(map(path.match, _LITTER))

    return sorted(filter(seen, found))
