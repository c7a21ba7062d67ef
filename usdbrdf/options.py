"""Every option of the program, said once: name, unit, default, limits and, below it, its meaning.

The frozen dataclasses are what the Python API takes; the command line and its help are made of them
(``command_parser``). A value out of its limits is refused when they are made, by a UsageError.
"""

from __future__ import annotations

import math
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from usdbrdf import calibration
from usdbrdf.errors import UsageError
from usdbrdf.option import Options, option

if TYPE_CHECKING:
    from usdbrdf.model.arrays import Double
else:
    Double = Any  # its module loads NumPy, for which no list of options has to wait

_COUNT = (1, 2**31 - 1)
# Metres, or metres per unit: from an atom's size to more than the Earth's.
_LENGTH = (1e-10, 1e10)
_PLACE = (-1e10, 1e10)  # in units

# What may stand in the place of a picture of the surroundings.
ESTIMATE: Literal["estimate"] = "estimate"
NO_LIGHT: Literal["none"] = "none"
Surroundings = Path | Literal["estimate", "none"]


def kind_of_light(environment: Surroundings) -> str:
    """As it is recorded: a file counts by what is in it, not by its name."""
    return "given" if isinstance(environment, Path) else environment


def _environment() -> Surroundings:
    told = "what the frames show and what its light and shadows tell"
    text = f"light from outside the scan: estimate: {told}; none; or a latitude-longitude picture"
    more = {"file": True, "words": (ESTIMATE, NO_LIGHT), "shared": "light transport", "help": text}
    return option("--environment estimate|none|HDR", ESTIMATE, **more)


# What may stand in the place of a file with the objects' names.
AUTO: Literal["auto"] = "auto"
UpAxis = Literal["Y", "Z", "-Y", "-Z", "X", "-X"]


def _seed() -> int:
    text = "seed of the random numbers"
    return option("--seed N", 0, (0, 2**32 - 1), shared="light transport", help=text)


def _memory() -> float | None:
    """No result depends on it."""
    use = "memory for texturing and for refining, which then take as many passes over the frames"
    more = {"unset": "three quarters of the machine's", "shared": "options"}
    return option("--memory GIB", None, (1e-3, 2**20), help=f"{use} as that asks for", **more)


def _lighting() -> str | None:
    text = "which of several lightings is looked at"
    return option("--lighting NAME", None, unset="the one it opens in", help=text)


def _allow_outside(who: str = "the capture's documents") -> tuple[Path, ...]:
    text = f"let {who} name files in this folder too; may be given again"
    return option("--allow-outside DIR", (), unset="none", help=text)


TextureSpace = Literal["rec709", "acescg"]


def _texture_space() -> TextureSpace:
    who = "acescg for programs that render in it and convert nothing"
    text = f"linear space of textures and other colours: rec709, or {who}"
    return option("--texture-space", "rec709", help=text)


class TalkOptions(Options):
    """What is said while a command runs and at its end."""

    quiet: bool = option("-q --quiet", False)
    "print errors only"
    json: bool = option("--json", False)
    "print a summary as JSON to stdout, nothing else"


HandEdits = Literal["refuse", "adopt", "discard"]


class EditOptions(Options):
    """What becomes of files of ours that somebody changed: only for the command that can write all
    of them again."""

    adopt: bool = option("--adopt", False)
    "keep changes made by hand to files of ours as adopted-N.usda; default: refuse to run"
    discard: bool = option("--discard", False)
    "drop changes made by hand to files of ours"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.adopt and self.discard:
            raise UsageError("--adopt, --discard: they exclude each other. [usage.option]")

    @property
    def hand_edits(self) -> HandEdits:
        return "adopt" if self.adopt else "discard" if self.discard else "refuse"


class CaptureOptions(Options):
    """What a user may say about a capture that its files do not say; the same for every adapter."""

    mesh: Path | None = option("--mesh FILE", None, unset="the capture's own", file=True)
    "mesh, in any place"
    objects: Path | Literal["auto"] | None = option(
        "--objects auto|FILE", None, unset="the capture's own", file=True, words=(AUTO,)
    )
    """object names (objects.json), in any place; auto: whatever the capture says, objects are
    planes, divided by colour, and what hangs together before them"""
    frames: Path | None = option("--frames DIR", None, unset="the capture's own")
    "folder of the pictures, in any place, where they do not lie where the capture says"
    crease_angle_deg: float = option("--crease-angle DEG", 40.0, (0, 180))
    "faces that meet at more degrees than this meet in a sharp edge"
    decimate: int | None = option("--decimate N", None, _COUNT, unset="keep all")
    "reduce the mesh to about N triangles"
    min_component_area_m2: float | None = option(
        "--min-component-area M2", None, (0, math.inf), unset="0.0001 of the mesh's area"
    )
    "without labels, connected parts of at least this many m^2 become objects"
    assume_srgb: bool = option("--assume-srgb", False)
    "accept 8-bit photographs as sRGB; the result is then not radiometric"
    encoding: str | None = option(
        "--input-space --encoding NAME", None, unset="as the format says", joined=True
    )
    """colour space of the images by its OpenColorIO name: scene-linear (lin_ap1_scene), a camera's
    logarithm (ARRI LogC4), or for 8-bit photographs a display's (srgb_p3d65_scene); of one of
    several lightings LIGHTING=NAME, and then again"""
    pose_scale: float | None = option(
        "--pose-scale S", None, _LENGTH, unset="1, others are refused"
    )
    "uniform scale of the camera axes, to be divided out; positions stay"
    max_nonfinite: float = option("--max-nonfinite SHARE", 0.01, (0, 1))
    "drop a frame with a larger share of NaN or infinite pixels"
    allow_outside: tuple[Path, ...] = _allow_outside()
    meters_per_unit: float | None = option(
        "--meters-per-unit M", None, _LENGTH, unset="as the format says"
    )
    "length of a scene unit in metres"
    up_axis: UpAxis | None = option("--up-axis", None, unset="as the format says")
    "axis of the capture that points up; the asset has y or z up, so other captures are turned"

    @property
    def looked_at(self) -> int | None:
        """How many frames have their pixels looked at; None: all."""
        return None


class IngestOptions(CaptureOptions):
    """The same, and what is to be found out of the frames' pixels before they are used."""

    exposure: Literal["stated", "estimate"] = option("--exposure", "stated")
    """stated: frames are believed to hold radiance in one unit; estimate: what each shows brighter
    or darker than the others do of the same surfaces is divided out"""
    refine_poses: bool = option("--refine-poses", False)
    """let every camera take a small step after which its frame agrees better with the others about
    the mesh; the poses as captured are kept beside"""
    vignetting: Literal["report", "estimate"] = option("--vignetting", "report")
    "report: how much all frames darken towards their corners is told; estimate: and divided out"


class InspectOptions(CaptureOptions):
    """What a user may say about a capture that is only looked at."""

    checked: int = option("--check N", 24, (2, 2**31 - 1))
    """look at the pixels of so many frames, evenly spread, as long as all of these can be used"""

    @property
    def looked_at(self) -> int | None:
        return self.checked


class TextureOptions(Options):
    """How frames become the lit diffuse texture L_d."""

    texel_size: float | None = option(
        "--texel-size M", None, (1e-6, 1e3), unset="what pixels cover, less where a pattern shows"
    )
    "side of a texel in metres, everywhere"
    quantile: float = option("--quantile P", 0.5, (1e-6, 1 - 1e-6))
    "quantile of a texel's observations that becomes L_d, between 0 and 1"
    max_texels: int | None = option(
        "--max-texels N", None, _COUNT, unset="as many as the memory holds"
    )
    "coarsen the default texel sizes so that the scene has about N texels at most"
    memory: float | None = _memory()


# What the lightmap filter is given may have this many times the standard error asked for.
BEFORE_FILTER = calibration.number("shade.before_filter")
# Of "cosine": the paper's number of independent directions per texel.
_RAYS = {"mis": 2048, "cosine": 10_000}
_BY_ESTIMATOR: Any = None


class Sampling(Options):
    """How irradiance S is estimated. "mis" doubles a tile's rays until its relative standard error
    is small enough."""

    estimator: Literal["mis", "cosine"] = option("--sampling", "mis")
    "mis: lights and cosine combined, Sobol points; cosine: the paper's estimator"
    standard_error: float = option("--standard-error E", 0.03, (0, math.inf))
    """mis stops where the relative standard error of S is below this, or {BEFORE_FILTER} times as
    much where S is filtered"""
    # More Sobol points than 2^20 fill the memory, and improve nothing.
    max_rays: int = option(
        "--rays N",
        _BY_ESTIMATOR,
        (4, 1 << 20),
        unset=", ".join(f"{rays} with {estimator}" for estimator, rays in _RAYS.items()),
    )
    "rays per texel: with mis at most this many, with cosine exactly"
    seed: int = _seed()

    def __post_init__(self) -> None:
        if self.max_rays is _BY_ESTIMATOR:
            object.__setattr__(self, "max_rays", _RAYS.get(self.estimator))
        super().__post_init__()


Denoise = Literal["auto", "none", "oidn"]


class ShadeOptions(Options):
    """How L_d becomes irradiance, albedo and emitters."""

    sampling: Sampling = field(default_factory=Sampling)
    denoise: Denoise = option("--denoise", "auto")
    "lightmap filter for S; oidn needs usdbrdf[denoise], auto takes it where it is there"
    environment: Surroundings = _environment()


class FitOptions(Options):
    """How roughness and specular are found, and who is told."""

    method: Literal["views", "scaled", "paper"] = option("--fit", "views")
    """views: many views per texel, L_d free, and refined with what was found; scaled: one target
    frame, L_d times a free factor; paper: one target frame, the paper's residual"""
    lobe: Literal["auto", "paper", "microfacet"] = option("--lobe", "auto")
    """whose lobe the surfaces have: paper: the paper's equations; microfacet: that of renderers,
    Smith's masking and Fresnel's equations, with facets after GGX or Beckmann; auto: whichever
    explains the views (of the methods of one target frame, the paper's)"""
    max_pixels: int = option("--max-pixels N", 1500, (50, 2**31 - 1))
    "fit to at most this many pixels of an object's target frame"
    mapping: Literal["measured", "matched"] = option("--material", "matched")
    """what UsdPreviewSurface is told: measured: roughness and specular as fitted; matched: as
    renderers need them to show that"""
    unmeasured: Literal["neutral", "class"] = option("--unmeasured", "neutral")
    """what materials show of objects that were not measured: neutral: what the frames leave likely;
    class: what is usual for their class, as far as the frames allow"""
    materialx: bool = option("--materialx", False)
    "write OpenPBR networks of MaterialX too, as layers/materialx.usda"
    environment: Surroundings = _environment()
    memory: float | None = _memory()
    seed: int = _seed()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lobe == "microfacet" and self.method != "views":
            raise UsageError(
                f"--lobe microfacet: --fit {self.method} is the paper's; leave one of both out. "
                "[usage.option]"
            )


class ConvertOptions(Options):
    """The options of all four tasks."""

    ingest: IngestOptions = field(default_factory=IngestOptions)
    texture: TextureOptions = field(default_factory=TextureOptions)
    shade: ShadeOptions = field(default_factory=ShadeOptions)
    fit: FitOptions = field(default_factory=FitOptions)


class EvaluateOptions(Options):
    """How views are rendered, and what else is compared."""

    samples_per_pixel: int = option("--samples-per-pixel N", 9, (1, 1 << 16))
    "points that a rendered pixel is the mean of; a square number"
    rays: int = option("--rays N", 144, (8, 1 << 24))
    "rays per pixel for the specular light, shared among its points"
    lighting: str | None = _lighting()
    environment: Surroundings = _environment()
    seed: int = _seed()
    truth: Path | None = option("--truth FOLDER", None, unset="none")
    "compare with known materials: objects.json and albedo_vertex.npz"
    mesh: Path | None = option("--mesh FILE", None, unset="mesh.ply beside --truth", file=True)
    "mesh whose vertices the known albedo belongs to"
    allow_outside: tuple[Path, ...] = _allow_outside()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.per_side**2 != self.samples_per_pixel:
            raise UsageError(
                f"--samples-per-pixel {self.samples_per_pixel}: not a square number (1, 4, 9, "
                "16, ...). [usage.option]"
            )
        if self.rays < 8 * self.samples_per_pixel:
            raise UsageError(
                f"--rays {self.rays}: at least 8 for each of a pixel's points are needed, here "
                f"{8 * self.samples_per_pixel}. [usage.option]"
            )
        if self.mesh is not None and self.truth is None:
            raise UsageError("--mesh: belongs to --truth, which is not given. [usage.option]")

    @property
    def per_side(self) -> int:
        """Points along a side of a pixel."""
        return math.isqrt(self.samples_per_pixel)


class CompareOptions(Options):
    """What of two assets is compared."""

    lighting: str | None = _lighting()
    other_lighting: str | None = option("--other-lighting NAME", None, unset="the one it opens in")
    "the same of OTHER"


class Insert(Options):
    """A model and what to do with it, lengths in units of the asset's stage. UsageError where it is
    placed in two ways, or where a matrix comes with a scale or a rotation, which it holds itself.
    """

    model: Path
    at: tuple[float, ...] | None = option("at X,Y,Z", None, _PLACE, counts=(3,))
    "where the model's origin comes to lie"
    drop: tuple[float, ...] | None = option("drop X,Y[,Z]", None, _PLACE, counts=(2, 3))
    "let it fall there (from the height Z; default: from that of the highest capture camera)"
    matrix: Double | None = option("matrix FILE", None)
    "with 4 x 4 numbers, world from model, instead of the others"
    scale: float = option("scale S", 1.0, (1e-9, 1e9))
    "factor on the model's size"
    rotate_deg: float = option("rotate DEG", 0.0)
    "about the up axis, counter-clockwise seen from above"
    up: UpAxis | None = option("up Y|Z|-Y|-Z|X|-X", None)
    "up axis of an OBJ or PLY"
    color: tuple[float, ...] | None = option("color R,G,B", None, (0, math.inf), counts=(3,))
    "instead of the model's"
    roughness: float | None = option("roughness R", None, (0, 1))
    "instead of the model's"
    ior: float | None = option("ior N", None, (1, math.inf))
    "instead of the model's; alone it makes a dielectric"
    metallic: float | None = option("metallic M", None, (0, 1))
    "instead of the model's"

    def __post_init__(self) -> None:
        super().__post_init__()
        if sum(place is not None for place in (self.at, self.drop, self.matrix)) > 1:
            raise UsageError(
                f"--insert {self.model}: at=, drop= and matrix= exclude each other. "
                "[relight.insert]"
            )
        if self.matrix is not None and (self.scale != 1.0 or self.rotate_deg != 0.0):
            raise UsageError(
                f"--insert {self.model}: scale= and rotate= have no effect beside matrix=. Put "
                "them into the matrix. [relight.insert]"
            )

    @property
    def falls_from_eye_height(self) -> bool:
        return self.drop is not None and len(self.drop) == 2


class RelightOptions(Options):
    """What is rendered, in which light."""

    lighting: str | None = _lighting()
    lights: Path | None = option("--lights FILE", None, unset="capture", none="capture")
    """capture: the recovered emitters; or a USD file with lights or glowing meshes, or a
    latitude-longitude .exr or .hdr, in their place"""
    keep_emitters: bool = option("--keep-emitters", False)
    "leave the captured light on beside --lights"
    inserts: tuple[Insert, ...] = option("--insert MODEL [KEY=VALUE ...]", ())
    """put a model in (USD, OBJ, PLY, GLB), lengths in units of the stage; may be given again. Keys:
    """
    allow_outside: tuple[Path, ...] = _allow_outside("the USD files of --lights and --insert")
    camera: str | None = option("--camera PRIM", None, unset="the capture's")
    "path of a camera in the stage"
    frame: float | None = option("--frame N", None, unset="the first")
    "time code"
    views: Path | None = option("--views FILE", None)
    "nerfstudio document with poses to render from"
    format: Literal["exr", "png", "jpg"] = option("--format", "exr")
    "of the pictures of --views"
    width: int | None = option("--width N", None, (1, 1 << 16), unset="the camera's")
    "pixels across"
    samples: int = option("--samples N", 256, (1, 1 << 24))
    "paths per pixel"
    # In a bright room the ninth reflection and later ones bring more than 1 % of the light.
    bounces: int = option("--bounces N", 32, (4, 1 << 16))
    "reflections along a path; light between surfaces needs at least 4"
    seed: int = _seed()
    denoise: Denoise = option("--denoise", "auto")
    "filter the picture; oidn needs usdbrdf[denoise], auto takes it where it is there"
    exposure: float | None = option(
        "--exposure STOPS", None, (-100, 100), unset="the 90th percentile of mean RGB becomes 0.8"
    )
    "of .png and .jpg"


class PackageOptions(Options):
    """What one file of an asset holds."""

    textures: Literal["exr", "png"] | None = option(
        "--textures", None, unset="exr, but png in .glb and with --profile arkit"
    )
    "exr: as they are; png: 8 bits, colours in sRGB"
    max_size: int | None = option("--max-size PIXELS", None, _COUNT)
    "reduce textures to this longer side"
    look: str | None = option("--look NAME", None, unset="the one it opens in")
    "the look that is packed"
    lighting: str | None = _lighting()
    profile: Literal["default", "arkit"] = option("--profile", "default")
    "arkit: y up, PNG, no cameras and lights, for AR Quick Look"
    texture_space: TextureSpace = _texture_space()
    low_poly: float | None = option("--low-poly N", None, (1e-6, 2**31 - 1), unset="as measured")
    """for viewers that need little geometry: meshes of about N triangles in all, or below 1 of that
    share, with textures of their own, into which the scan's maps and normals are baked"""
    whole: bool = option("--whole", False)
    """.usdz of the layers as they are, all looks and lightings as variants, in the place of one
    look made flat"""


class PublishOptions(Options):
    """What a published version of an asset is."""

    version: str | None = option("--version vNNN", None, unset="the one after the latest")
    "its name"
    uri: str | None = option("--uri TEMPLATE", None, unset="./NAME.usd")
    """identifier in assetInfo, for a studio's resolver: a URI with {{name}} and {{version}}, such
    as 'ayon+entity://show/assets?product={{name}}&version={{version}}'"""
    photographs: bool = option("--no-photographs", True)
    "leave the photographs out; else they are copied without EXIF, GPS and the like"
    unfinished: bool = option("--unfinished", False)
    "publish an asset in which not all steps were run, too; the version says which were not"
    texture_space: TextureSpace = _texture_space()
    proxies: int | None = option("--proxies N", None, _COUNT, unset="none")
    """stand-ins of about N triangles in all: purpose proxy, the measured meshes get purpose
    render"""
    encoding: Literal["text", "binary"] = option("--encoding", "text")
    "of the root layer, NAME.usd"


class ReportOptions(Options):
    """What the page of an asset shows."""

    views: Path | None = option(
        "--views FILE", None, unset="8 of the capture's frames, spread evenly", file=True
    )
    "nerfstudio document (transforms.json) of the views that are shown beside their photographs"
    evaluation: Path | None = option("--evaluation FOLDER", None, unset="none")
    "folder that evaluate wrote for this asset: its views and figures are taken, none is rendered"
    photographs: bool = option("--no-photographs", True)
    "leave all photographs out, and what they look like beside the model's pictures"
    environment: Surroundings = _environment()
    lighting: str | None = _lighting()
    seed: int = _seed()
    allow_outside: tuple[Path, ...] = _allow_outside()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.views is not None and self.evaluation is not None:
            raise UsageError("--views, --evaluation: they exclude each other. [usage.option]")


class AdviseOptions(Options):
    """What may be photographed next."""

    poses: int = option("--poses N", 6, (1, 100))
    "photographs to advise, the most telling first"
    lowest: float = option("--lowest M", 0.5, (0, 100))
    "least height of the camera above the floor of a room, in metres"
    highest: float = option("--highest M", 2.0, (0, 100))
    "greatest height of the camera above the floor of a room, in metres"
    clearance: float = option("--clearance M", 0.25, (0.01, 10))
    "from the camera to any surface, in metres"
    environment: Surroundings = _environment()
    lighting: str | None = _lighting()
    seed: int = _seed()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lowest >= self.highest:
            raise UsageError(
                f"--lowest {self.lowest:g}, --highest {self.highest:g}: the former must be less. "
                "[usage.option]"
            )
