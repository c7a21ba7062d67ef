"""Adapters: modules that turn a capture in some format into a Scan.

An adapter has ``NAME``, ``DESCRIPTION``, ``matches(path) -> bool`` and
``read(path, options) -> Scan``. Packages announce theirs as entry points of the group
``usdbrdf.adapters``; ours are announced in the same way. To list ours loads neither NumPy nor
USD.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, cast

from usdbrdf.errors import InputRefused, UsageError, UsdBrdfError, first_of
from usdbrdf.files.atomic import environment_failures, raise_shortage
from usdbrdf.files.paths import refuse_nameless, seen_of
from usdbrdf.job.progress import warn

if TYPE_CHECKING:
    from usdbrdf.model.capture import Scan
    from usdbrdf.options import CaptureOptions


# In the order in which they are asked: those whose folders hold other formats too come first, those
# of which some file lies in many folders last, after other packages' too.
MODULES = {
    "eyeful-tower": "usdbrdf.capture.formats.eyeful_tower",
    "scannetpp": "usdbrdf.capture.formats.scannetpp",
    "scannet": "usdbrdf.capture.formats.scannet",
    "arkitscenes": "usdbrdf.capture.reconstructions.arkitscenes",
    "polycam": "usdbrdf.capture.reconstructions.polycam",
    "meshroom": "usdbrdf.capture.reconstructions.meshroom",
    "openmvg": "usdbrdf.capture.reconstructions.openmvg",
    "opensfm": "usdbrdf.capture.reconstructions.opensfm",
    "transforms": "usdbrdf.capture.formats.transforms",
    "scanner-app": "usdbrdf.capture.formats.scanner_app",
    "colmap": "usdbrdf.capture.formats.colmap",
    "metashape": "usdbrdf.capture.formats.metashape",
    "realityscan": "usdbrdf.capture.formats.realityscan",
    "nice-slam": "usdbrdf.capture.formats.nice_slam",
    "replica": "usdbrdf.capture.formats.replica",
    "fipt": "usdbrdf.capture.formats.fipt",
    "llff": "usdbrdf.capture.formats.llff",
    "e57": "usdbrdf.capture.formats.e57",
    "blocks-exchange": "usdbrdf.capture.reconstructions.blocks_exchange",
    "pix4d": "usdbrdf.capture.reconstructions.pix4d",
    "opf": "usdbrdf.capture.reconstructions.opf",
    "bundler": "usdbrdf.capture.reconstructions.bundler",
    "visualsfm": "usdbrdf.capture.reconstructions.visualsfm",
    "rgbd-scan": "usdbrdf.capture.reconstructions.rgbd_scans",
    "usd": "usdbrdf.capture.formats.usd_stage",
    "alembic": "usdbrdf.capture.formats.alembic",
}
DESCRIPTIONS = {
    "eyeful-tower": "room of Eyeful Tower (cameras.json, images-2k/, mesh.obj)",
    "scannetpp": "scene of ScanNet++ (dslr/ or iphone/, and scans/)",
    "scannet": "scene of ScanNet, unpacked (color/, pose/, intrinsic/, *_vh_clean_2.ply)",
    "arkitscenes": "video of ARKitScenes (lowres_wide.traj, pictures, *_3dod_mesh.ply)",
    "polycam": "raw data of Polycam (keyframes/, raw.glb, mesh_info.json)",
    "meshroom": "cameras of Meshroom (cameras.sfm), pictures, its mesh",
    "openmvg": "reconstruction of OpenMVG (sfm_data.json), pictures, and a mesh",
    "opensfm": "reconstruction of OpenSfM or OpenDroneMap (reconstruction.json), and a mesh",
    "transforms": "folder with transforms.json (nerfstudio), scene-linear images and a mesh",
    "scanner-app": 'export folder of "3d Scanner App" (frame_*.json, frame_*.jpg and a mesh)',
    "colmap": "COLMAP model, text or binary, with its images and a mesh",
    "metashape": "cameras that Metashape exports (XML), pictures, model",
    "realityscan": "cameras that RealityScan (RealityCapture) exports (CSV, XMP), pictures, model",
    "nice-slam": "NICE-SLAM's renders of Replica (traj.txt and results/)",
    "replica": "Replica scene with frames (mesh.ply, habitat/, traj.txt)",
    "fipt": "HDR room of FIPT, photographed (cam.txt, K_list.txt) or rendered (train/, val/)",
    "llff": "pictures with LLFF's poses_bounds.npy, and a mesh",
    "e57": "E57 with the stations of pictures, the pictures extracted beside it, and a mesh",
    "blocks-exchange": "block of ContextCapture (BlocksExchange XML), pictures, and its model",
    "pix4d": "project of Pix4Dmapper (1_initial/params), its photographs, and its mesh",
    "opf": "project of PIX4Dmatic in the Open Photogrammetry Format (.opf), pictures, and a mesh",
    "bundler": "cameras as Bundler writes them (bundle.out, list.txt), pictures, and a mesh",
    "visualsfm": "reconstruction of VisualSFM (.nvm), pictures, and a mesh",
    "rgbd-scan": "scan of Record3D, Stray Scanner, Open3D or Matterport3D, and a mesh",
    "usd": "USD stage whose cameras are the photographs (back plates, or pictures by name)",
    "alembic": "Alembic cameras: not read, says how to convert them",
}

_LAST = ("rgbd-scan", "usd", "alembic")

GROUP = "usdbrdf.adapters"
# Folders in a folder that are asked, where it is no capture itself.
_MOST_BELOW = 100


class AdapterModule(Protocol):
    """What a module must offer to be an adapter."""

    NAME: str
    DESCRIPTION: str

    def matches(self, path: Path) -> bool:
        """Whether this looks like a capture of the format; a glance, nothing is parsed."""
        ...

    def read(self, path: Path, options: CaptureOptions) -> Scan:
        """The capture, checked; raises the errors of ``usdbrdf.errors`` and no others."""
        ...


@dataclass(frozen=True, kw_only=True)
class Adapter:
    """An announced adapter; ``module`` is None and ``problem`` says why if it is broken.

    package  distribution and version that announce it, where known; "" for ours
    """

    name: str
    description: str
    origin: str
    module: AdapterModule | None
    problem: str = ""
    package: str = ""


class _LoadedWhenUsed(ModuleType):
    """A module whose members are there as soon as one of them is asked for."""

    def __getattr__(self, member: str) -> Any:
        return getattr(import_module(self.__name__), member)


def list_adapters(*, plugins: bool = True) -> tuple[Adapter, ...]:
    """Our adapters, then those of other packages by name (none of these if not ``plugins``).

    Broken ones are part of the list; they are reported once and never used.
    """
    found = [
        Adapter(
            name=name,
            description=DESCRIPTIONS[name],
            origin=origin,
            module=cast(AdapterModule, _LoadedWhenUsed(origin)),
        )
        for name, origin in MODULES.items()
    ]
    if plugins:
        # Installed, we are among the announced ourselves; our names cannot be taken over.
        foreign = {p for p in entry_points(group=GROUP) if p.name not in MODULES}
        found += [_loaded(p) for p in sorted(foreign, key=lambda p: (p.name, p.value))]
    return tuple(found)


def read_scan(
    path: Path, options: CaptureOptions, adapter: str | None = None, *, plugins: bool = True
) -> Scan:
    """Read a capture with the named adapter, or with the first that recognises it."""
    return read_with(choose_adapter(path, adapter, plugins=plugins), path, options)


def choose_adapter(path: Path, name: str | None = None, *, plugins: bool = True) -> Adapter:
    """The named adapter, or the first that recognises the capture."""
    adapters = list_adapters(plugins=plugins)
    sound = [adapter for adapter in adapters if adapter.module is not None]
    sound.sort(key=lambda adapter: adapter.name in _LAST)
    if name is not None:
        for adapter in adapters:
            if adapter.name == name:
                if adapter.module is None:
                    raise UsageError(
                        f"adapter {name!r} is broken: {adapter.problem}. [adapter.load]"
                    )
                return adapter
        known = ", ".join(adapter.name for adapter in sound)
        raise UsageError(
            f"adapter {name!r} is not installed. Use one of {known}. [adapter.unknown]"
        )
    refuse_missing(path)
    for adapter in sound:
        try:
            if adapter.module and adapter.module.matches(path):
                return adapter
        except Exception as error:
            if adapter.name in MODULES:
                raise
            raise_shortage(error)
            warn(f"adapter {adapter.name!r} is skipped: {error!r}. [adapter.matches]")
    from usdbrdf.capture.unrecognised import what_lies_there

    with environment_failures(str(path)):
        below = next(_recognised_below(path, sound), None)
        if below is None:
            _refuse_results(path)
        above = None if below else next(_recognised_above(path, sound), None)
        said = (
            f"no capture itself, but {below[0].as_posix()}/ in it is one ({below[1].name}). Name "
            "that folder"
            if below
            else f"no capture of a known format: {what_lies_there(path, above=above)}"
        )
    raise InputRefused(
        f"{path}: {said}, or state the format with --adapter (`usdbrdf adapters` lists what each "
        "asks for). [adapter.none]"
    )


def _recognised_below(path: Path, sound: list[Adapter]) -> Iterator[tuple[Path, Adapter]]:
    """Folders in a folder that one of our adapters recognises, and in these; none that are assets,
    whose layers look like a capture of USD."""
    if not path.is_dir():
        return
    for pattern in ("*/", "*/*/"):
        for folder in seen_of(path.glob(pattern), below=path)[:_MOST_BELOW]:
            if any(_result_in(place) for place in (folder, folder.parent)):
                continue
            for adapter in sound:
                if adapter.module and adapter.name in MODULES and adapter.module.matches(folder):
                    yield folder.relative_to(path), adapter


def _result_in(folder: Path) -> str:
    """What a folder is that the steps or publish wrote; "" of any other."""
    from usdbrdf.job.stamp import STATE_FOLDER
    from usdbrdf.job.versions import version_around

    if version_around(folder) is not None:
        return "a published version of an asset"
    return "an asset" if (folder / STATE_FOLDER).is_dir() else ""


def _refuse_results(path: Path) -> None:
    """InputRefused for a folder that holds assets or published versions and nothing else."""
    inside = seen_of(path.iterdir(), below=path) if path.is_dir() else []
    found = {place.name: what for place in inside if (what := _result_in(place))}
    if found and len(found) == len(inside):
        names = first_of([f"{name}/ is {what}" for name, what in found.items()])
        raise InputRefused(
            f"{path}: no capture; in it {names}, which usdbrdf wrote. Name the capture that it was "
            "made of; validate, report and view look at assets. [capture.asset]"
        )


def _recognised_above(path: Path, sound: list[Adapter]) -> Iterator[Path]:
    """The folder that a folder lies in, or the two of a file, if one of our adapters recognises
    them for sure, by its ``is_surely``: some match by what lies anywhere below. Nobody named them:
    what may not be read there is passed over."""
    ours = (getattr(a.module, "is_surely", None) for a in sound if a.name in MODULES)
    looks = [look for look in ours if look]
    for folder in path.absolute().parents[: 1 if path.is_dir() else 2]:
        for look in looks:
            with suppress(OSError, UsdBrdfError):
                if look(folder):
                    yield folder


def refuse_missing(path: Path) -> None:
    """InputRefused where nothing lies at the path of a capture, or what is neither file nor
    folder, as a pipe is."""
    if not path.exists():
        raise InputRefused(f"{path}: no such file or folder. Check the path. [capture.missing]")
    if not (path.is_file() or path.is_dir()):
        raise InputRefused(
            f"{path}: neither a regular file nor a folder. Name the capture's folder. "
            "[capture.missing]"
        )


def _loaded(point: EntryPoint) -> Adapter:
    """Another package's adapter, loaded; or why it cannot be used."""
    # The list of adapters, where there are no others, is not to wait for numpy.
    from usdbrdf.untrusted.bounds import problem_of_plugin

    module: Any = None
    problem = problem_of_plugin(point)
    if not problem:
        try:
            module = point.load()
        # What went well in a child may still raise here, SystemExit included.
        except (Exception, SystemExit) as error:
            raise_shortage(error)
            problem = f"{type(error).__name__}: {error}"
        else:
            missing = [
                *(n for n in ("NAME", "DESCRIPTION") if not isinstance(getattr(module, n, 0), str)),
                *(n for n in ("matches", "read") if not callable(getattr(module, n, None))),
            ]
            problem = f"it has no {', '.join(missing)}" if missing else ""
    if problem:
        warn(f"adapter {point.name!r} ({point.value}) is skipped: {problem}. [adapter.load]")
        module = None
    package = f"{point.dist.metadata['Name']} {point.dist.version}" if point.dist else ""
    return Adapter(
        name=point.name,
        description=module.DESCRIPTION if module else "",
        origin=point.value,
        module=module,
        problem=problem,
        package=package,
    )


def files_beside(adapter: Adapter, path: Path, mesh: Path | None) -> list[Path]:
    """What an adapter reads outside of the capture's folder, as its ``beside(path)`` says, and
    beside the user's mesh, as its ``beside_mesh(mesh)`` says; most have neither."""
    named = {"beside": path} | ({} if mesh is None else {"beside_mesh": mesh})
    asked = ((getattr(adapter.module, name, None), place) for name, place in named.items())
    return sorted({file for beside, place in asked if beside is not None for file in beside(place)})


def read_with(adapter: Adapter, path: Path, options: CaptureOptions) -> Scan:
    """What a chosen adapter makes of a capture, turned where USD cannot state what is up in it."""
    from usdbrdf.model.capture import Scan
    from usdbrdf.model.upright import upright

    assert adapter.module is not None
    for named in (path, options.mesh, options.objects, options.frames):
        if isinstance(named, Path):
            refuse_nameless(named)
    try:
        scan = adapter.module.read(path, options)
        if not isinstance(scan, Scan):
            raise TypeError(f"it returned a {type(scan).__name__} in the place of a Scan")
    except UsdBrdfError:
        raise
    except Exception as error:
        if adapter.name in MODULES:
            raise
        raise_shortage(error)
        raise InputRefused(
            f"{path}: adapter {adapter.name!r} ({adapter.origin}) failed: {error!r}. Report it to "
            "its authors. [adapter.read]"
        ) from error
    if options.frames is not None:
        _refuse_unused(options.frames, scan, adapter)
    return upright(scan)


def _refuse_unused(frames: Path, scan: Scan, adapter: Adapter) -> None:
    """UsageError where no picture comes from the folder that the user named."""
    views = scan.views or [None] * len(scan.frames)
    pairs = zip(views, scan.frames.image_paths, strict=True)
    photographs = [path if view is None else view.photograph for view, path in pairs]
    if not any(photograph.is_relative_to(frames.resolve()) for photograph in photographs):
        raise UsageError(
            f"--frames {frames}: no picture of this capture lies there; the format "
            f"{adapter.name!r} says itself where they are. Leave the option out. [usage.option]"
        )
