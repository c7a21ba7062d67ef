"""Names as captured -> USD identifiers that are also safe as file names everywhere; and what the
names of pictures and their folders say."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Callable, Collection, Sequence
from pathlib import Path, PurePosixPath
from urllib.parse import quote, unquote

_MAX_LENGTH = 64
_MOST_ENDS = 16
# Device names that Windows refuses as a file's stem, whatever the extension.
_RESERVED = frozenset(
    ["aux", "con", "nul", "prn", *(f"{d}{i}" for d in ("com", "lpt") for i in range(10))]
)


def unique_identifiers(
    labels: Sequence[str], *, fallback: str = "object", known: Collection[str] = ()
) -> list[str]:
    """One identifier per label: ASCII, legal in USD, unique even where case does not count.

    A label that is its own identifier keeps it; of labels that reduce to the same identifier the
    first keeps it and the others get a suffix, a hash of the label and of how often it occurred
    before, so that the names depend on the labels alone; ``known`` names are nobody's. A label of
    which nothing is left becomes ``fallback``.
    """
    wanted = [identifier_from(label, fallback=fallback) for label in labels]
    exact_first = sorted(range(len(labels)), key=lambda i: wanted[i] != labels[i])
    names = [""] * len(labels)
    taken = {name.lower() for name in known}
    for i in exact_first:
        name, occurrence = wanted[i], list(labels[:i]).count(labels[i])
        while name.lower() in taken:
            text = f"{occurrence}:{labels[i]}".encode("utf-8", "backslashreplace")
            name = f"{wanted[i][: _MAX_LENGTH - 9]}_{hashlib.sha256(text).hexdigest()[:8]}"
            occurrence += 1
        taken.add(name.lower())
        names[i] = name
    return names


def identifier_from(label: str, *, fallback: str = "object") -> str:
    """ASCII identifier nearest to a label: accents dropped, everything else foreign becomes "_"."""
    name = label
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", label):
        plain = unicodedata.normalize("NFKD", label).encode("ascii", "ignore").decode("ascii")
        name = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")
    if not name:
        return fallback
    if name[0].isdigit() or name.lower() in _RESERVED:
        name = f"_{name}"
    return name[:_MAX_LENGTH]


def readable_label(label: str) -> str:
    """The label as USD can store it: control characters and lone surrogates become U+FFFD."""
    encodable = label.encode("utf-8", "replace").decode("utf-8")
    return "".join("\ufffd" if unicodedata.category(c) == "Cc" else c for c in encodable)


def composed(name: str) -> str:
    """A name with its accents as most programs write them; macOS hands them on as letters of their
    own, which only look the same."""
    return unicodedata.normalize("NFC", name)


def as_in_addresses(name: str) -> list[str]:
    """A name, and what it is where programs write or read it as in an address of the web, in which
    a blank is %20."""
    return list(dict.fromkeys((name, unquote(name), quote(name, errors="replace"))))


def ends_of(path: str) -> list[str]:
    """The ends of a path that leads elsewhere, the longest first: of a capture that was moved, or
    comes from another machine, one of them leads to the same file within it. None of a URI; and of
    ../ not the name alone, which says too little where all the way to it is known."""
    parts = [] if "://" in path else path.replace("\\", "/").split("/")
    downwards = len(parts) - parts[::-1].index("..") if ".." in parts else 0
    names = [name for name in parts[downwards:] if name.strip(".~") and name[-1] != ":"]
    fewest = 2 if downwards else 1
    return ["/".join(names[i:]) for i in range(len(names) - fewest + 1)[-_MOST_ENDS:]]


def meant_by(
    wanted: PurePosixPath, stem: str, paths: Collection[PurePosixPath]
) -> list[PurePosixPath]:
    """Those of ``paths`` that a document means by ``wanted``, or by a file of any kind there that
    is called ``stem``: the path itself, else those that end with it, else, as it may come from
    another machine, those that it ends with."""
    if wanted in paths:
        return [wanted]
    any_kind = wanted.parent / stem
    searches: tuple[Callable[[PurePosixPath], bool], ...] = (
        lambda p: p.with_suffix("") == any_kind,
        lambda p: p.parts[-len(wanted.parts) :] == wanted.parts,
        lambda p: p.with_suffix("").parts[-len(any_kind.parts) :] == any_kind.parts,
        lambda p: wanted.parts[-len(p.parts) :] == p.parts,
        lambda p: any_kind.parts[-len(p.parts) :] == p.with_suffix("").parts,
    )
    found = ([p for p in paths if search(p)] for search in searches)
    return next(filter(None, found), [])


def number_at_end(name: str) -> int:
    """The number that a name without suffix ends with, -1 where it ends with none."""
    digits = re.search(r"(\d+)$", name)
    return int(digits[1]) if digits else -1


def is_called_undistorted(picture: Path, places: tuple[Path, Path | None]) -> bool:
    """Whether a folder that a picture lies in is called so.

    places  the capture's folder, and the user's of the pictures: the names of folders below that
            say what these are; of the user's elsewhere its own and the next, as what a whole
            project is called says nothing
    """
    folder, frames = places
    folders = [folder, *([] if frames is None else frames.resolve().parents[:2][-1:])]
    home = next((folder for folder in folders if picture.is_relative_to(folder)), None)
    names = picture.relative_to(home).parent.parts if home else (picture.parent.name,)
    return any("undistort" in name.lower() for name in names)


def must_be_undistorted(picture: Path, places: tuple[Path, Path | None]) -> bool:
    """Whether a folder says of a picture that it has been undistorted so clearly that a lens which
    bends light cannot be its own: more is asked than by ``is_called_undistorted``, after which one
    only looks.

    places  as there. Below the capture's folder any name counts; of the user's elsewhere its own
            and those below it, and ``undistorted`` next above, as OpenSfM has it
    """
    folder, frames = places[0], places[1] and places[1].resolve()
    if picture.is_relative_to(folder):
        names = picture.relative_to(folder).parent.parts
    elif frames and picture.is_relative_to(frames):
        if frames.parent.name.lower() == "undistorted":
            return True
        names = (frames.name, *picture.relative_to(frames).parent.parts)
    else:
        names = (picture.parent.name,)
    return any("undistort" in name.lower() for name in names)
