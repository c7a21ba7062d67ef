"""The rules of the house: who may import whom, who opens files, where numbers stand.

Each test gives the places that break its rule, and compares them with ``NOT_YET``: a place that is
new there fails, and so does an entry that is not needed any more. Read ``docs/architecture.md``
first.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from datetime import date
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.conftest import SLOW
from usdbrdf import identity
from usdbrdf.calibration import entries

PACKAGE = Path(__file__).resolve().parents[1] / "usdbrdf"

# --- The arrows. A room may import what it names here, and all rooms that those may. -------------

GROUND = {"ahead", "calibration", "errors", "identity", "kernel", "option", "options"}
RUNNING = {"files", "job", "untrusted"}
SUBJECTS = {"capture", "geometry", "texturing", "shading", "material", "asset"}
READERS = {"advice", "delivery", "evaluation", "page", "paper", "relighting", "validation"}

ARROWS: dict[str, set[str]] = {
    "ahead": set(),
    "errors": set(),
    "identity": set(),
    "calibration": set(),
    "option": {"errors"},
    "options": {"model", "calibration", "option"},
    "kernel": {"identity"},
    "model": {"errors"},
    "files": {"model", "ahead"},
    "job": {"files", "identity"},
    "untrusted": {"job"},
    "transport": {"model", "untrusted", "kernel", "calibration", "options"},
    "geometry": {"transport", "ahead"},
    "texturing": {"geometry"},
    "capture": {"geometry"},
    "shading": {"texturing"},
    "material": {"shading"},
    # A document of views is read by the adapter of the capture that they belong to.
    "asset": {"capture"},
    "tasks": SUBJECTS,
    # Who does units of work; it finds them by name.
    "cluster": {"job", "options"},
    "pipeline": {"tasks", "cluster"},
    # Run by name, in a child.
    "warm_up": {"pipeline"},
    "delivery": {"asset"},
    "evaluation": {"asset"},
    # Reckons with the light, the lobes and the errors that the fit does.
    "advice": {"evaluation", "material"},
    # Shows what others measure and pack; the evidence is the method's own residual.
    "page": {"delivery", "evaluation", "material"},
    "relighting": {"asset"},
    # Tables and figures of what the others compute.
    "paper": {"evaluation", "relighting"},
    "validation": {"asset"},
    "cli": {"commands", "command_parser"},
    "run_table": set(),
    "doctor": {"asset", "relighting"},
    # Many scans: each converted, validated, shown; the look of its page is that of theirs.
    "farm": {"pipeline", "page", "validation", "run_table"},
    "farm_commands": {"command_kinds", "farm"},
    "command_kinds": {"command_parser", "run_table"},
    "commands": {"command_kinds", "doctor", "farm_commands", "paper"},
    "command_parser": {"pipeline", *READERS},
    "__main__": {"cli"},
    # The public face, which nothing inside may import.
    "": {"pipeline", *READERS},
}

# --- The one place of each dependency. ------------------------------------------------------------

IMPORTERS: dict[str, set[str]] = {
    "av": {"untrusted/"},
    "cv2": {"capture/alignment.py"},
    "cyclopts": {"cli.py", "commands.py", "command_parser.py"},
    "dask": {"cluster/"},
    "distributed": {"cluster/"},
    "drjit": {"relighting/"},
    "embreex": {"transport/rays.py"},
    "filelock": {"job/ownership.py"},
    "flip_evaluator": {"evaluation/metrics.py"},
    "fsspec": {"cluster/object_store.py"},
    "llvmlite": {"kernel.py", "job/arithmetic.py", "transport/"},
    "matplotlib": {"evaluation/"},
    "mitsuba": {"relighting/"},
    "msgspec": {"files/documents.py"},
    "numba": {
        "kernel.py",
        "capture/develop.py",
        "geometry/",
        "material/",
        "texturing/",
        "transport/",
    },
    "OpenImageIO": {"files/images.py", "files/published_images.py"},
    "pickle": {"kernel.py"},
    "PIL": {"delivery/"},
    "psutil": {"job/memory.py"},
    "pxr": {"asset/", "untrusted/", "delivery/", "validation/"},
    "pycolmap": {"untrusted/"},
    "pye57": {"untrusted/"},
    "rawpy": {"untrusted/"},
    "pymeshlab": {"geometry/mesh_filters.py"},
    "PyOpenColorIO": {"files/colour.py"},
    "pyoidn": {"transport/denoise.py"},
    "subprocess": {"job/child.py"},
    "threadpoolctl": {"cluster/unit.py", "job/task.py"},
    "tqdm": {"job/progress.py"},
    "trimesh": {"untrusted/", "delivery/glb.py", "shading/lamp_shapes.py"},
    "usd_validation_nvidia": {"validation/nvidia.py"},
    "xatlas": {"geometry/unwrap.py"},
}

# --- Who opens files: rooms and single modules, with the reason. ----------------------------------

OPENERS: dict[str, str] = {
    "files/": "bytes are its subject",
    "job/": "stamps, locks, checkpoints, children",
    "untrusted/": "parses what others wrote",
    "asset/": "USD layers are written by USD",
    "delivery/": "packages are files",
    "calibration.py": "its own data",
    "cluster/object_store.py": "the name of a task's prefix",
    "cluster/store.py": "arrays that workers find by their hash",
    "identity.py": "hashes the sources",
    "kernel.py": "compiled code",
    "page/": "the page's own parts",
    "relighting/scene_file.py": "whether the scene that stands there is ours",
    "validation/validate.py": "the layer of cures is an artist's file",
}
_OPEN = {
    "open", "read_text", "write_text", "read_bytes", "write_bytes", "load", "loadtxt", "save",
    "savez", "savetxt", "fromfile", "tofile", "memmap", "Export",
}  # fmt: skip

# --- Numbers in the rooms of the method that are no calibration, with the reason. -----------------

CALIBRATED_ROOMS = ("capture", "material", "shading", "tasks", "texturing")
ENGINEERING: dict[str, str] = {
    "ACROSS": "memory: texels that a pixel may cover",
    "ASKED": "time",
    "BRIGHT_CODE": "codes of 8-bit images",
    "BYTES_OF_EQUATIONS": "bytes",
    "CLIPPED": "codes of what a texel shows in a frame",
    "CLOSELY": "time",
    "DARK": "codes of what a texel shows in a frame",
    "DARK_CODE": "codes of 8-bit images",
    "FEWEST": "samples that a statistic needs",
    "FINEST": "pixels of a picture",
    "FIRST_RAYS": "rays: noise against time",
    "FLIPS": "mathematics: signs of axes",
    "GLIMPSE": "codes of what a texel shows in a frame",
    "GRID": "discretisation of the search",
    "HEIGHT": "pixels of a picture",
    "LARGEST_OF_POSE": "limit of what is refused",
    "LEAST_OF_SEGMENT": "texels that a statistic needs",
    "MIN_FRAMES": "limit of what is refused",
    "MIXTURE": "rays: noise against time",
    "MOST_SAMPLES": "time",
    "NEUTRAL": "mathematics: medians before any evidence",
    "NOTHING": "codes of what a texel shows in a frame",
    "NOTHING_KNOWN": "mathematics: deviation of the even distribution",
    "OF_TEXTURING": "bytes",
    "OLD_NERFSTUDIO": "convention of a format",
    "PER_SEGMENT": "time: how many are asked",
    "REACH": "memory: texels that a pixel may cover",
    "RINGS": "mathematics: nodes of a quadrature",
    "ROUGHLY": "rays: noise against time",
    "ROWS_BESIDE": "geometry: how far steps of a search reach",
    "SAMPLE": "codes of what a texel shows in a frame",
    "SIDE": "texels of a square",
    "TILE_SIDE": "texels of a tile",
    "UNASKED": "mathematics: deviation of what is nothing as likely as anything",
    "UPDATES": "steps of a search",
    "WIDTH": "pixels of a picture",
    "_ABOVE": "where a format has its files",
    "_ABOVE_FLOOR": "engineering: deviations of the noise that no direction exceeds by chance",
    "_ACROSS": "discretisation: points of a pixel",
    "_ALL_PIXELS": "memory",
    "_ALONE": "mathematics: two of nine",
    "_ALONG": "parts of a mesh that a statistic needs",
    "_ANGLES": "points at which a lens is probed",
    "_APART": "geometry: texels that one pixel covers",
    "_AROUND": "codes, or texels, that are taken together",
    "_ASKED": "time",
    "_AS_SUNLIT": "numerics: the same share of the sun by other rays",
    "_AS_TOLD": "definition",
    "_AT_A_TIME": "memory",
    "_AT_CORNER": "limit of what is refused",
    "_AT_ONCE": "memory",
    "_AXES": "convention of a format",
    "_BANDS": "discretisation of the sky",
    "_BATCH": "memory",
    "_BENT": "geometry: what is a seam",
    "_BESIDE": "geometry: pixels that show one surface",
    "_BESIDE_MIDDLE": "geometry: bound of how far a place of a texel lies off its middle",
    "_BESIDE_RIM": "pixels that JPEG mixes",
    "_BETTER": "numerics: share of differing bits",
    "_BETWEEN": "convention of a format",
    "_BETWEEN_POSES": "convention of a format",
    "_BITS": "bits of a number",
    "_BLACK_VALUE": "codes of 8-bit images",
    "_BLOCKS": "blocks of a jackknife",
    "_BLUR": "engineering: what a pixel blurs, in texels",
    "_BRIGHTEST": "steps of a search",
    "_BY_CHANCE": "from here on a warning is printed",
    "_CANDIDATES": "time",
    "_CLEAR": "codes of 8-bit images",
    "_CLEARLY": "which of two readings of a format",
    "_CLEARLY_MORE": "which of two readings of a format",
    "_CLIPPED": "time: how many are asked",
    "_CLOSELY": "time",
    "_COAL": "from here down a warning is printed",
    "_COARSER": "precision against time",
    "_COARSEST": "steps of a search",
    "_COLUMNS": "convention of a format",
    "_COMMON": "pixels around one",
    "_CORNER": "geometry: a picture's border",
    "_COUNTED": "convention of a format",
    "_COUNTED_PIXELS": "time",
    "_COUNTS": "convention of a format",
    "_DARK": "numerics",
    "_DARKEST": "numerics",
    "_DELETED": "limit of what is refused",
    "_DIFFUSE_RAYS": "rays: noise against time",
    "_DIRECTIONS": "discretisation of the search",
    "_ENOUGH": "geometry: pixels that make a mean",
    "_EXACT": "numerics: of float64",
    "_EXIF_STOPS": "rounding of names on dials",
    "_EXIF_TIMES": "cropping, as of films",
    "_FACES": "geometry: sides of a cube",
    "_FARTHEST": "scenes that are plainly in another unit",
    "_FARTHEST_CENTRE": "limit of what is refused",
    "_FEWEST": "memory",
    "_FEWEST_ASKED": "time",
    "_FEWEST_FRAMES": "frames that a statistic needs",
    "_FEWEST_PIXELS": "memory",
    "_FEWEST_POINTS": "points that a statistic needs",
    "_FEWEST_VIEWS": "views that a statistic needs",
    "_FEW_OF_SEGMENT": "time: how many are asked",
    "_FEW_POINTS": "time: how many are asked",
    "_FILLED": "geometry: of a box that a mesh fills",
    "_FINER": "steps of a search",
    "_FIRST_GUESS": "start and end of a search",
    "_FITS": "from here on a warning is printed",
    "_FLIP": "convention of a format",
    "_FOCAL_LENGTHS": "limit of what is refused",
    "_FOLLOWED": "memory",
    "_FRAMES": "time",
    "_FRAMES_OF_GLOSS": "time",
    "_FRAMES_OF_NOISE": "time",
    "_FROM_AFAR": "discretisation of the filling in",
    "_FULL_FRAME_MM": "convention of a format",
    "_GAP": "keeps lights off surfaces",
    "_GEOCENTRIC": "limit of what is refused",
    "_GIVEN": "numerics: next to no spread",
    "_GLOBAL": "codes of EPSG",
    "_GLOSS": "discretisation of the search",
    "_GOLDEN": "mathematics",
    "_GROUPS": "time",
    "_HALF_ANGLES": "steps of a search",
    "_HEAD": "time",
    "_HEIGHT": "discretisation of directions",
    "_INSET": "geometry: a picture's border",
    "_INSIDE": "geometry: of a mesh in its box",
    "_ITERATIONS": "steps of a search",
    "_KEEPS_DETAIL": "resolution of what is resampled",
    "_KEPT": "memory",
    "_KEPT_MAPS": "memory",
    "_LAGS": "pixels at which correlations are taken",
    "_LAMP": "numerics: deviations",
    "_LAMP_ROUNDS": "steps of a search",
    "_LARGEST": "limit of what is refused",
    "_LARGEST_SHARE": "time: what is done again when a worker dies",
    "_LEAK": "geometry: texels that pixels may mix",
    "_LEAST": "numerics",
    "_LEAST_ANGLE": "limit of what is refused",
    "_LEAST_EQUAL": "numerics: of a quotient",
    "_LEAST_EXPOSURE": "limit of what is refused",
    "_LEAST_FLOOR": "numerics: of a quotient",
    "_LEAST_GAIN": "time: how many are asked",
    "_LEAST_IMAGED": "limit of what is refused",
    "_LEAST_OFF": "numerics: of a logarithm",
    "_LEAST_OF_OBJECT": "time: how many are traced",
    "_LEAST_OF_SEGMENT": "time: how many are asked",
    "_LEAST_SCATTER": "numerics: of a quotient",
    "_LEAST_SIDE": "rows and columns of the smallest picture",
    "_LEVELS": "steps of a search",
    "_LEVEL_1": "discretisation of the search",
    "_LEVEL_2": "discretisation of the search",
    "_LIKELY_UNITS": "units of length",
    "_LISTED": "what is printed",
    "_LOBES": "a filter, measured by benchmarks/lenses.py",
    "_LONGER": "steps of a search",
    "_LONGEST": "length of a name",
    "_LONGEST_STEM": "length of a name",
    "_LOOKS_AT_DISC": "steps of a search",
    "_LOOKS_AT_MIRRORED": "steps of a search",
    "_LOST": "limit of what is refused",
    "_MANY": "time: how many are asked",
    "_MANY_FRAMES": "rays: noise against time",
    "_MANY_OVER_ONE": "from here on a warning is printed",
    "_MANY_PER_SEGMENT": "time: how many are chosen from",
    "_MAX_BEHIND": "limit of what is refused",
    "_MAX_CELLS": "memory",
    "_MAX_DEVIATION": "numerics: what is a rotation",
    "_MAX_DROPPED_SHARE": "limit of what is refused",
    "_MAX_GROUPS": "time",
    "_MAX_OBJECTS": "limit of a format",
    "_MAX_PARTS": "sides of a box",
    "_MAX_TAPS": "time",
    "_MIDDLE": "codes of 8-bit images",
    "_MIN_BASELINE": "limit of what is refused",
    "_MIN_FRAMED_SHARE": "limit of what is refused",
    "_MIN_FRAMES": "limit of what is said",
    "_MIN_HIT_SHARE": "limit of what is refused",
    "_MIN_SPREAD": "geometry: cameras that do not stand in one place",
    "_MIN_USEFUL_SHARE": "limit of what is refused",
    "_MIXED": "discretisation of a mean",
    "_MORE": "steps of a search",
    "_MORE_FOR_METAL": "rays: noise against time",
    "_MOSTLY": "from here on a warning is printed",
    "_MOSTLY_CLEAR": "half: whether most are",
    "_MOSTLY_OPEN": "from here on a warning is printed",
    "_MOST_ACROSS": "time",
    "_MOST_ASIDE": "limit of what is refused",
    "_MOST_ASKED": "time",
    "_MOST_BELOW": "time",
    "_MOST_EFFECTS": "memory",
    "_MOST_EXPOSURE": "limit of what is refused",
    "_MOST_FACES": "memory",
    "_MOST_FILES": "time",
    "_MOST_MEASURED": "time",
    "_MOST_MOVES": "steps of a search",
    "_MOST_NUMBERS": "memory",
    "_MOST_PASSES": "time",
    "_MOST_PIXELS": "memory",
    "_MOST_POINTS": "time",
    "_MOST_RAYS": "rays: noise against time",
    "_MOST_SAMPLES": "time",
    "_MOST_SOURCES": "memory",
    "_MOST_SQUEEZED": "limit of what is believed",
    "_MOST_TEXELS": "memory",
    "_NEAR": "steps of a search",
    "_NEAREST": "numerics: of a quotient",
    "_NEARLY_UP": "from here on a warning is printed",
    "_NEIGHBOURS": "discretisation of the filling in",
    "_NGP_AXES": "convention of a format",
    "_NGP_OFFSET": "convention of a format",
    "_NGP_SCALE": "convention of a format",
    "_NOISY": "from here on a warning is printed",
    "_NO_SKEW": "limit of what is refused",
    "_OFF_CENTRE": "limit of what is refused",
    "_OFF_LENGTH": "limit of what is refused",
    "_OFF_SPHERE": "limit of what is refused",
    "_OF_FRAMES": "memory",
    "_OF_MEDIAN": "mathematics: of a normal distribution",
    "_OF_PART": "samples that a statistic needs",
    "_OF_PATTERN": "frames that a statistic needs",
    "_OF_PATTERNS": "bytes",
    "_OF_REFINING": "bytes",
    "_OF_TEXEL": "mathematics: variance of a texel",
    "_OF_TWO": "mathematics: Student's t with one degree of freedom",
    "_ON_IT": "which of two readings of a format",
    "_OPEN": "rays: noise against time",
    "_OPENGL": "convention of a format",
    "_OTHERWISE": "steps of a search",
    "_OTHER_SEED": "a seed",
    "_OVERLAP": "limit of what is refused",
    "_PARTS": "blocks of a jackknife",
    "_PER_CODE": "time",
    "_PER_PIXEL": "bytes",
    "_PER_SEGMENT": "time: how many are asked",
    "_PER_TEXEL": "bytes",
    "_PER_TRIANGLE": "bytes",
    "_PHASES": "discretisation of a filter",
    "_PIXELS": "time",
    "_PLACES": "time",
    "_POINTS": "time: how many are asked",
    "_PROBED_FRAMES": "time",
    "_PROBED_PICTURES": "time",
    "_PROBED_POINTS": "time: how many are asked",
    "_PROBED_SIDE": "time",
    "_PROBES": "points at which a lens is probed",
    "_PROCESS": "bytes",
    "_PROXY_RAYS": "rays: noise against time",
    "_PSI_GRID": "discretisation of the posterior",
    "_PUBLISHED": "convention of a format",
    "_QUANTILE": "mathematics: the median",
    "_RANKS": "discretisation of the ranks",
    "_RAYS": "rays: noise against time",
    "_RAYS_OF_LOBE": "rays: noise against time",
    "_RAYS_OF_MANY": "rays: noise against time",
    "_RAYS_OF_VIEW": "rays: noise against time",
    "_REACH": "geometry: how far faces overlap",
    "_REACHED": "geometry: what lies before a point",
    "_REFINED": "steps of a search",
    "_REPEATS": "rays: noise against time",
    "_RIM": "geometry: texels that pixels may mix",
    "_RING": "mathematics: nodes of a quadrature",
    "_ROOM": "metres in rooms and before things",
    "_ROUNDED": "convention of a format",
    "_ROUNDING": "numerics: of float32 and printed digits",
    "_ROUNDS": "steps of a search",
    "_ROWS": "memory",
    "_RUN": "time",
    "_SAME_CAMERA": "limit of what is believed",
    "_SAME_FRAME": "numerics: of float64",
    "_SAME_MS": "convention of a format",
    "_SAVED_UPRIGHT": "EXIF's numbers",
    "_SEED": "a seed",
    "_SEED_OF_DOUBT": "random numbers of their own",
    "_SEED_OF_METAL": "random numbers of their own",
    "_SEED_OF_THROUGH": "random numbers of their own",
    "_SEEN": "what is refused as not seen",
    "_SEGMENTS": "time: how many are asked",
    "_SHARE": "memory",
    "_SHIFTED": "time: how many readings are tried",
    "_SHORTEST_PINHOLE": "limit of what is refused",
    "_SIDE": "texels of a tile",
    "_SINCE": "convention of a format",
    "_SLACK": "precision against time",
    "_SMALLEST": "pixels that are worked on together",
    "_SMALLEST_GROUP": "memory",
    "_SMALLEST_SHARE": "time: what a worker is sent is worth it",
    "_SPECULAR_RAYS": "rays: noise against time",
    "_STARTS": "steps of a search",
    "_STEEPEST": "geometry: beyond it one pinhole is no use",
    "_STEPS": "steps of a search",
    "_STRENGTHS": "discretisation of the search",
    "_STRIDE": "time",
    "_SUB_PIXEL": "mathematics: nodes of a quadrature",
    "_SURE": "engineering: errors that the best of many tries does not exceed by chance",
    "_TAPS": "precision against time",
    "_TELLING": "time",
    "_TEXELS": "time: how many are asked",
    "_TIE": "numerics",
    "_TILE": "texels that are worked on together",
    "_TIMES_FOR_CURVED": "rays: noise against time",
    "_TINY": "numerics: of a quotient",
    "_TOUCHES": "numerics",
    "_TRACED": "time",
    "_TRIED": "steps of a search",
    "_TURNS": "steps of a search",
    "_UNDECIDED": "codes of 8-bit images",
    "_UNEVEN": "from here on a warning is printed",
    "_UNPLACED": "mathematics: nothing moves",
    "_UPPER": "mathematics: the normal distribution",
    "_VIEWS": "memory",
    "_WIDTH": "discretisation of directions",
    "_WINDOW": "pixels that are worked on together",
    "_WINDOWS": "time",
    "_WORTH_FACES": "memory",
    "_ZERO": "numerics: zero has no logarithm",
    "_Z_UP_FROM_Y_UP": "convention of a format",
}

MOST_FILES, MOST_LINES, MOST_LINES_OF_TASK = 20, 500, 120
HISTORY = re.compile(r"\b(no longer|used to (?!be\b)\w+|previously|was once|formerly)\b", re.I)

NOT_YET: dict[str, set[str]] = {}


@cache
def modules() -> dict[str, tuple[Path, ast.Module]]:
    """Dotted name below the package ("" for its face) -> file and syntax tree."""
    found = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = file, ast.parse(file.read_text("utf-8"))
    return found


def place(name: str) -> str:
    return modules()[name][0].relative_to(PACKAGE).as_posix()


def within(file: str, places: set[str] | dict[str, str]) -> bool:
    return any(file == p or (p.endswith("/") and file.startswith(p)) for p in places)


def imported(tree: ast.Module) -> Iterator[str]:
    """Absolute names of all that a module imports, in functions too, ``package.module.name``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import, line {node.lineno}"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module"
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            yield str(node.args[0].value)


@cache
def inner_imports() -> dict[str, set[str]]:
    """Module -> the package's modules that it imports, "" being the package's face."""
    found: dict[str, set[str]] = {}
    for name, (_, tree) in modules().items():
        found[name] = set()
        for full in imported(tree):
            if full.split(".")[0] != "usdbrdf":
                continue
            inner = full.partition(".")[2]
            while inner not in modules():
                inner = inner.rpartition(".")[0]
            found[name].add(inner)
    return found


def room(name: str) -> str:
    return name.split(".")[0]


def check(rule: str, found: set[str]) -> None:
    expected = NOT_YET.get(rule, set())
    assert found - expected == set(), "breaks the rule"
    assert expected - found == set(), "is in order now: take it out of NOT_YET"


def test_every_room_has_its_place():
    assert {room(name) for name in modules()} <= ARROWS.keys()
    assert GROUND | RUNNING | SUBJECTS | READERS | {"model"} <= ARROWS.keys()
    assert tuple(TopologicalSorter(ARROWS).static_order())


def test_what_writes_into_no_asset_makes_no_step_stale():
    assert identity._OUTSIDE_TASKS >= READERS


def test_imports_go_downwards_only():
    @cache
    def below(one: str) -> frozenset[str]:
        return frozenset(ARROWS[one].union(*(below(other) for other in ARROWS[one])))

    # The ground floor carries everything, files, job and untrusted all but the ground and model.
    def may(one: str, other: str) -> bool:
        return (
            other in below(one)
            or (other in GROUND and one not in GROUND)
            or (other in RUNNING and one not in GROUND | RUNNING | {"model"})
        )

    check(
        "arrows",
        {
            f"{room(name)} -> {room(other)}"
            for name, others in inner_imports().items()
            for other in others
            if other and room(other) != room(name) and not may(room(name), room(other))
        },
    )


def test_nothing_imports_the_public_face():
    """It is not part of a kernel's identity, and importing it would import everything."""
    inside = {name: others for name, others in inner_imports().items() if name}
    check("face", {place(name) for name, others in inside.items() if "" in others})


def test_no_circles():
    folders: dict[str, set[str]] = {}
    for name, others in inner_imports().items():
        own, theirs = name.rpartition(".")[0], {other.rpartition(".")[0] for other in others}
        # A folder and one inside it are one room.
        apart = {x for x in theirs if not (f"{x}.".startswith(own) or f"{own}.".startswith(x))}
        folders.setdefault(own, set()).update(apart)
    found = set()
    for graph in (inner_imports(), folders):
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            found.add(" <- ".join(sorted(set(error.args[1]))))
    check("circles", found)


def test_each_dependency_has_its_place():
    check(
        "importers",
        {
            f"{place(name)}: {full.split('.')[0]}"
            for name, (_, tree) in modules().items()
            for full in imported(tree)
            if full.split(".")[0] in IMPORTERS
            and not within(place(name), IMPORTERS[full.split(".")[0]])
        },
    )


def test_what_few_runs_need_is_loaded_by_these():
    """trimesh takes a tenth of a second: only to write a GLB is it needed whatever comes in."""
    at_once = {
        place(name)
        for name, (_, tree) in modules().items()
        for node in tree.body
        if isinstance(node, ast.Import | ast.ImportFrom)
        and any(full.split(".")[0] == "trimesh" for full in imported(ast.Module([node], [])))
    }
    assert at_once == {"delivery/glb.py"}


def test_few_open_files():
    opening = set()
    for name, (_, tree) in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                function = node.func
                called = function.attr if isinstance(function, ast.Attribute) else ""
                if isinstance(function, ast.Name):
                    called = function.id if function.id == "open" else ""
                if called in _OPEN and not _is_own_checkpoint(function):
                    opening.add(place(name))
    strangers = {file for file in opening if not within(file, OPENERS)}
    assert strangers == set()
    assert {p for p in OPENERS if not any(within(file, {p}) for file in opening)} == set()


def _is_own_checkpoint(function: ast.expr) -> bool:
    """``run.save(...)`` and the like store with the job's help."""
    return (
        isinstance(function, ast.Attribute)
        and function.attr in ("save", "load")
        and not (isinstance(function.value, ast.Name) and function.value.id == "np")
    )


def test_folders_and_files_are_of_a_size_one_can_read():
    files = Counter(file.parent for file, _ in modules().values() if file.name != "__init__.py")
    assert {folder.name: n for folder, n in files.items() if n > MOST_FILES} == {}
    lines = {
        name: len(file.read_text("utf-8").splitlines()) for name, (file, _) in modules().items()
    }
    assert {name: n for name, n in lines.items() if n > MOST_LINES} == {}
    tasks = {place(name) for name, n in lines.items() if n > MOST_LINES_OF_TASK}
    check("tasks", {file for file in tasks if file.startswith("tasks/")})


def _numbers(node: ast.expr) -> bool:
    return any(
        isinstance(part, ast.Constant) and type(part.value) in (int, float)
        for part in ast.walk(node)
    )


def _is_calibrated(node: ast.expr) -> bool:
    return any(isinstance(n, ast.Name) and n.id == "calibration" for n in ast.walk(node))


def test_numbers_of_the_method_are_data_or_engineering():
    found = set()
    for name, (_, tree) in modules().items():
        for node in tree.body if room(name) in CALIBRATED_ROOMS else ():
            if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
                continue
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            targets = target.elts if isinstance(target, ast.Tuple) else [target]
            values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            if len(values) != len(targets):
                values = [node.value] * len(targets)
            for one, value in zip(targets, values, strict=True):
                if _numbers(value) and not _is_calibrated(value):
                    found.add(f"{place(name)}: {ast.unparse(one)}")
    unknown = {entry for entry in found if entry.split(": ")[1] not in ENGINEERING}
    assert unknown == set()
    assert ENGINEERING.keys() - {entry.split(": ")[1] for entry in found} == set()


def test_calibration_is_whole_and_used():
    used = [
        node.args[0].value
        for _, tree in modules().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == "calibration"
    ]
    assert sorted(used) == sorted(entries())
    for name, entry in entries().items():
        assert set(entry) == {"value", "unit", "meaning", "on", "by", "date"}, name
        assert entry["unit"], name
        assert entry["meaning"].endswith("."), name
        assert entry["on"], name
        assert date.fromisoformat(entry["date"]), name
        if entry["by"]:
            assert (PACKAGE.parent / entry["by"]).is_file(), name


def test_comments_tell_of_the_code_and_not_of_its_past():
    found = set()
    for name, (file, _) in modules().items():
        for token in tokenize.generate_tokens(io.StringIO(file.read_text("utf-8")).readline):
            if token.type == tokenize.COMMENT and HISTORY.search(token.string):
                found.add(f"{place(name)}: {HISTORY.search(token.string)[0].lower()}")
    check("history", found)


def test_only_the_command_line_prints():
    printing = {
        place(name)
        for name, (_, tree) in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    }
    assert printing <= {"cli.py", "commands.py"}


def test_what_is_called_slow_is_there():
    assert [place for place in SLOW if not (PACKAGE.parent / "tests" / place).exists()] == []


@pytest.mark.parametrize("word", ["fastmath=True", "# type: ignore\n", "import *"])
def test_what_is_never_written(word):
    assert [name for name, (file, _) in modules().items() if word in file.read_text("utf-8")] == []
