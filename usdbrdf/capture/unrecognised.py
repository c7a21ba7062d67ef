"""What lies where no adapter recognises a capture, and how to make one of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

# As in ``named_pictures`` and ``mesh_files``, which load NumPy; a glance needs names alone.
_PICTURES = frozenset((".exr", ".hdr", ".tif", ".tiff", ".png", ".jpg", ".jpeg"))
_MESHES = frozenset((".ply", ".obj", ".glb", ".gltf", ".stl", ".fbx"))
_MOST_FILES, _HEAD = 10_000, 4096  # looked at in a folder; bytes of a document


class _Program(NamedTuple):
    """Whose cameras are not read: how their documents begin or end, and what to do."""

    name: str
    suffixes: tuple[str, ...]
    names: tuple[str, ...]
    says: bytes
    how: str


_ANEW = "Reconstruct the same photographs with COLMAP, and name its folder"
_PROGRAMS = (
    _Program(
        "OpenMVG", (), ("sfm_data",), b'"sfm_data_version"',
        "Make a COLMAP model of them with openMVG_main_openMVG2Colmap",
    ),
    _Program(
        "Meshroom", (".sfm", ".mg", ".baf"), (), b'"featuresFolders"',
        "Make a COLMAP model of them with its node ExportColmap (aliceVision_exportColmap)",
    ),
    _Program(
        "OpenSfM", (), ("reconstruction.json", "reconstruction.meshed.json"), b'"shots"',
        "Make a COLMAP model of them with 'opensfm export_colmap'",
    ),
    _Program(
        "Open3D", (), (), b'"PinholeCameraTrajectory"',
        "Read them with the example of an adapter, plugins/example_adapter of our sources",
    ),
    _Program("VisualSFM", (".nvm",), (), b"NVM_V3", _ANEW),
    # What says nothing but .out, its suffix, may be a text of any kind.
    _Program("Bundler", (), (), b"# Bundle file", _ANEW),
)  # fmt: skip


def other_program(document: Path) -> str:
    """Whose cameras a file holds that are not read, and how to have them read; else ""."""
    from usdbrdf.files.tables import beginning_of

    head = beginning_of(document, _HEAD)
    name, suffix = document.name.lower(), document.suffix.lower()
    for one in _PROGRAMS:
        own = suffix in one.suffixes or (suffix == ".json" and name.startswith(one.names))
        if own or one.says in head:
            return f"{document.name} holds the cameras of {one.name}, which are not read. {one.how}"
    return ""


def what_lies_there(path: Path) -> str:
    """One sentence on what a folder or file is that is no capture, one on what to do."""
    files = list(_files(path))
    for file in files:
        if file.suffix.lower() not in _PICTURES | _MESHES and (said := other_program(file)):
            return said
    pictures = sum(file.suffix.lower() in _PICTURES for file in files)
    meshes = [file for file in files if file.suffix.lower() in _MESHES]
    held = f"{pictures} picture{'s' * (pictures != 1)}" if pictures else ""
    if meshes:
        first = f"the mesh {meshes[0].name}" if len(meshes) == 1 else f"{len(meshes)} meshes"
        held = f"{held} and {first}" if held else first
    if not held:
        return "it holds neither pictures nor cameras. Name the folder that holds the capture"
    how = (
        "Bring the document that the scanning program writes of its cameras"
        if meshes
        else "Have them found (COLMAP, Metashape, RealityScan), and name the folder that holds both"
    )
    return f"it holds {held}, but nothing that says where the cameras stood. {how}"


def _files(path: Path) -> Iterator[Path]:
    """The file, or those in the folder and in its folders, some thousands of them."""
    if path.is_file():
        yield path
        return
    places = [path, *sorted(p for p in path.iterdir() if p.is_dir() and p.name[0] != ".")]
    listed = (file for place in places for file in sorted(place.iterdir()))
    for _, file in zip(range(_MOST_FILES), listed, strict=False):
        if file.is_file() and file.name[0] != ".":
            yield file
