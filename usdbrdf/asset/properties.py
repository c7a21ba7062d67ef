"""Every attribute ``usdBrdf:*``, said once: the records of an object, whose fields are the rows.

A field that is stored carries a ``Fact``: the schema, the attribute's name, type, fallback and
range, and its documentation. From these rows are made the schemas (``schemas/generate.py``), what
the layers say (``layers.author.author_record``), what is read back (``readers.scene``) and what is
checked (``validation.record_rules``). A new fact is one row here, and whoever measures it."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, get_type_hints

from usdbrdf.asset.layout import path_in_asset, path_in_layer
from usdbrdf.model.arrays import Array, Float
from usdbrdf.model.mesh import IN_PART, OF_FIT, OF_SHADE
from usdbrdf.transport.brdf import F0_OF_PSI

# What every layer and the plug-in state. It rises when an attribute changes its meaning or goes
# away, not when one is added.
SCHEMA_VERSION = 2
# In the names of a schema that is applied several times, in the place of the instance.
INSTANCE = "__INSTANCE_NAME__"
Colour = tuple[float, float, float]


def colour(values: Array) -> Colour:
    """Three numbers as a record holds a colour."""
    red, green, blue = (float(value) for value in values)
    return red, green, blue


@dataclass(frozen=True)
class Schema:
    """An applied API schema, UsdBrdf<name>API."""

    name: str
    namespace: str  # before the names of its attributes
    prims: str  # the type of prim that it may be applied to
    key: str  # the attribute that tells whether somebody measured what the schema is about
    doc: str  # what it is about; here and below line breaks count as spaces
    flag: str = ""  # the field of the record that says whether the schema applies; "": always

    @property
    def identifier(self) -> str:
        return f"UsdBrdf{self.name}API"

    @property
    def is_multiple(self) -> bool:
        return self.namespace.endswith(INSTANCE)

    def applied(self, instance: str = "") -> str:
        """The name as it stands among a prim's ``apiSchemas``."""
        return f"{self.identifier}:{instance}" if self.is_multiple else self.identifier

    def attribute(self, name: str, instance: str = INSTANCE) -> str:
        return f"{self.namespace.replace(INSTANCE, instance)}:{name}"


@dataclass(frozen=True)
class Fact:
    """How a field of a record is stored. Of several facts of a field all are authored, and the
    first that is there is read. Numbers that are not finite are never authored."""

    schema: Schema
    name: str
    type: str  # as USD spells it
    fallback: Any  # of the schema: what an application sees where nothing is authored
    doc: str  # documentation in the schema, with the unit of numbers
    tokens: tuple[str, ...] = ()  # all values that are allowed; () for any
    low: float = -math.inf  # all values that make sense, bounds included, of each component
    high: float = math.inf
    samples: Literal["", "every", "changes"] = ""  # where a sequence with a value per frame has any
    varying: bool = False  # may have samples, though we author none
    when: Callable[[Any], bool] = lambda record: True  # whether a record has it to say
    absent: Any = None  # what a record holds where nothing is authored; None: see ``unknown``
    stored: Callable[[Any], Any] = lambda value: value  # from the field's value to the attribute's
    read: Callable[[Any], Any] = lambda value: value  # and back, from what older versions said too
    formerly: str = ""  # the name in assets of older versions, if it was another

    @property
    def is_uniform(self) -> bool:
        return not (self.samples or self.varying)

    @property
    def is_bounded(self) -> bool:
        return math.isfinite(self.low) or math.isfinite(self.high)

    @property
    def unknown(self) -> Any:
        """What the record holds where nothing is authored: a fallback is no measurement."""
        if self.absent is not None:
            return self.absent
        return math.nan if self.type == "float" else self.fallback

    def attribute(self, instance: str = INSTANCE) -> str:
        return self.schema.attribute(self.name, instance)


# Tables: one paragraph per row.
# fmt: off
OBJECT = Schema("Object", "usdBrdf", "Mesh", "label", """One object of the capture's segmentation. A
    mesh without it is not one of ours.""")
CAPTURE = Schema("Capture", "usdBrdf:capture", "Camera", "pinhole", """The photographs that a camera
    took, one per integer time code. Values between time codes mean nothing.""")
AOV = Schema("Aov", f"usdBrdf:aov:{INSTANCE}", "Mesh", "file", """One map over the texture space
    (primvars:st) of an object, for review and for the next task.""")
TEXTURING = Schema("Texturing", "usdBrdf:texturing", "Mesh", "texelSize", """How well the
    photographs covered an object, and at which resolution its lit texture was measured.""")
SHADING = Schema("Shading", "usdBrdf:shading", "Mesh", "raysPerTexel", """How the irradiance and the
    albedo of an object were estimated.""")
FIT = Schema("MaterialFit", "usdBrdf:fit", "Mesh", "status", """The fitted GGX lobe of one object.
    UsdPreviewSurface is derived from it as usdBrdf:fit:mapping says.""")
EMITTER = Schema("Emitter", "usdBrdf:emitter", "Mesh", "radiance", """An object that emits light of
    its own. Its material has emissiveColor and no albedo.""", flag="emitter")
OUTSIDE = Schema("Outside", "usdBrdf:outside", "Imageable", "sky", """The light that comes from
    outside the scan: a picture of the surroundings, and the sun, which the picture does not
    show.""")
SCHEMAS = (OBJECT, CAPTURE, AOV, TEXTURING, SHADING, FIT, EMITTER, OUTSIDE)
_STATUSES = ("measured", *IN_PART, "unseen", "failed")
_MODELS = ("dielectric", "diffuse", "conductor", "transparent")
_CONFIDENCES = ("high", "low", "none")
_CONFIDENCE = "high: photographs determine {0}; low: say something of it; none: next to nothing."


@dataclass(frozen=True, kw_only=True)
class LabelledObject:
    """What makes a mesh one of our objects."""

    label: Annotated[str, Fact(OBJECT, "label", "string", "", """The object's name as captured,
        unchanged; the prim's own name is a legal identifier made from it.""")]
    class_name: Annotated[str, Fact(OBJECT, "class", "string", "", """The object's semantic class,
        such as chair or wall; empty where the capture has none.""")]
    identifier: Annotated[str, Fact(OBJECT, "identifier", "token", "", """Legal identifier, unique
        in the asset: names the object's material and its textures.""")]
    label_source: Annotated[str, Fact(OBJECT, "labelSource", "token", "capture", """Who divided the
        scan into objects: the capture; or we did: connected parts; segmented: planes, divided by
        the frames' colours, and what hangs together before them.""",
        tokens=("capture", "connected", "segmented"))] = "capture"


@dataclass(frozen=True, kw_only=True)
class Photographs:
    """What the capture camera says of its photographs: sequences have a value for each."""

    image: Annotated[Sequence[str], Fact(CAPTURE, "image", "asset", "", """The photograph at this
        time code, a path relative to the layer. Said by photographs.usdc, which an asset may go
        without.""", samples="every")]
    exposure_time: Annotated[Sequence[float], Fact(CAPTURE, "exposureTime", "double", 1.0,
        """Exposure time of the photograph in seconds; 1 where it is not known. The pixel values
        are radiance already: do not apply it again.""", samples="every")]
    saturation_radiance: Annotated[Sequence[float], Fact(CAPTURE, "saturationRadiance", "double",
        0.0, """Radiance, in the units of the pixel values, at which a channel is clipped; a
        channel at or above 0.998 of it is not used.""", samples="every")]
    noise_floor_radiance: Annotated[Sequence[float], Fact(CAPTURE, "noiseFloorRadiance", "double",
        0.0, """Radiance, in the units of the pixel values, below which a channel is noise and is
        not used.""", samples="every")]
    intrinsics: Annotated[Sequence[Sequence[float]], Fact(CAPTURE, "pinhole", "double4",
        (0, 0, 0, 0), """Focal lengths and principal point fx, fy, cx, cy in pixels; the centre of
        the first pixel is (0.5, 0.5).""", samples="changes")]
    resolution: Annotated[Sequence[Sequence[int]], Fact(CAPTURE, "resolution", "int2", (0, 0),
        "Width and height of the photograph in pixels.", samples="changes")]
    gain: Annotated[Sequence[float], Fact(CAPTURE, "gain", "double", 1.0, """What the pixel values
        of a radiometric photograph are too bright by, without unit: estimated from what others show
        of the same surfaces, or 1. The other radiances are those after it is divided out.""",
        samples="every", low=0)]
    vignetting: Annotated[Sequence[float], Fact(CAPTURE, "vignetting", "double2", (0, 0), """k1, k2,
        without unit: lenses pass exp(k1 r^2 + k2 r^4), r in half diagonals from the centre.""")]
    encoding: Annotated[Sequence[str], Fact(CAPTURE, "encoding", "token", "lin_rec709_scene",
        """Colour space in which the image files are stored, in OpenColorIO's names; lightings may
        differ in it. The textures are always lin_rec709_scene.""", samples="changes")]
    radiometric: Annotated[Sequence[bool], Fact(CAPTURE, "radiometric", "bool", True, """True where
        pixel values are proportional to scene radiance. False for low dynamic range photographs:
        what was measured from them is relative.""", samples="changes")]
    photograph: Annotated[Sequence[str], Fact(CAPTURE, "photograph", "asset", "", """The photograph
        through a lens that the image of this time code was resampled from, a path relative to the
        layer; empty where the image is the photograph itself.""", samples="changes",
        when=lambda taken: any(taken.photograph))]
    mask: Annotated[Sequence[str], Fact(CAPTURE, "mask", "asset", "", """The mask of that
        photograph, whose black pixels the image does not have, a path relative to the layer; empty
        where there is none.""", samples="changes", when=lambda taken: any(taken.mask))]
    lens: Annotated[Sequence[str], Fact(CAPTURE, "lens", "string", "", """The lens of that
        photograph: its curve and its numbers that are not 0, in pixels fx, fy, cx and cy; k, d, p
        and s are radial, dividing, tangential and prism terms as OpenCV has them.""",
        samples="changes", when=lambda taken: any(taken.lens))]
    photograph_encoding: Annotated[Sequence[str], Fact(CAPTURE, "photographEncoding", "token", "",
        """Colour space of the photographs that images were resampled from, in OpenColorIO's names;
        empty where the images are the photographs themselves.""", samples="changes",
        when=lambda taken: any(taken.photograph_encoding))]
    lighting: Annotated[Sequence[str], Fact(CAPTURE, "lighting", "string", "", """Which lighting of
        the scene the photograph shows, a variant of the set lighting; empty where there is but
        one.""", samples="changes", when=lambda taken: any(taken.lighting))]
    sha256: Annotated[Sequence[str], Fact(CAPTURE, "sha256", "string", "", """The SHA-256 of the
        photograph as ingest read it, and after a space that of its mask, if it has one; steps take
        no other. Said by photographs.usdc.""", samples="every",
        when=lambda taken: any(taken.sha256))]


@dataclass(frozen=True, kw_only=True)
class Aov:
    """One map of an object; ``file`` is relative to the asset folder here, to the layer where it is
    stored."""

    name: str  # a USD identifier: also the look that shows it
    file: Annotated[str, Fact(AOV, "file", "asset", "", """The map, an OpenEXR file of linear
        values, a path relative to the layer.""", varying=True, stored=path_in_layer,
        read=path_in_asset)]
    scale: Annotated[float, Fact(AOV, "scale", "float", 1.0, """Factor from stored value to
        displayed value in the look of this name; without unit. The file holds the physical
        value.""", varying=True)] = 1.0
    unit: Annotated[str, Fact(AOV, "unit", "string", "", """Unit of the stored values, such as
        W m-2 sr-1; 1 for pure numbers.""")] = "1"


@dataclass(frozen=True, kw_only=True)
class MeasuredObject:
    """What every task hands over of an object: the mesh, its identifier, maps by their names."""

    prim_path: str
    identifier: str
    aovs: tuple[Aov, ...] = ()


@dataclass(frozen=True, kw_only=True)
class UnwrappedObject(MeasuredObject):
    """One object's place in its textures."""
    corner_uv: Float  # (F, 3, 2) float32 in [0, 1], v up, per triangle corner of the object
    texel_size: Annotated[float, Fact(TEXTURING, "texelSize", "float", 0.0, """Edge length of a
        texel on the surface, in metres whatever the stage's units.""", low=0)]
    resolution: Annotated[tuple[int, int], Fact(TEXTURING, "resolution", "int2", (0, 0), """Width
        and height of the object's textures in texels.""", low=0)]


@dataclass(frozen=True, kw_only=True)
class TexturedObject(UnwrappedObject):
    """Result of the task texture for one object."""
    seen_fraction: Annotated[float, Fact(TEXTURING, "seenFraction", "float", 0.0, """Share of the
        object's texels that at least one photograph measured; 0 to 1, without unit.""",
        low=0, high=1)]
    clipped_fraction: Annotated[float, Fact(TEXTURING, "clippedFraction", "float", 0.0, """Share of
        the object's texels that were clipped in every photograph that saw them; 0 to 1, without
        unit. Their radiance is a lower bound.""", low=0, high=1)]
    quantile: Annotated[float, Fact(TEXTURING, "quantile", "float", 0.5, """Quantile of the observed
        radiances that the lit texture stores; 0 to 1, without unit; 0.5 is the median.""",
        low=0, high=1)] = 0.5
    seen: Annotated[bool, Fact(TEXTURING, "seen", "bool", True, """False where no photograph
        measured any texel of the object: its textures are then filled in or, where it is too thin
        for that, about what photographs show of it together with what is beside it.""")]


@dataclass(frozen=True, kw_only=True)
class ShadedObject(MeasuredObject):
    """Result of the task shade for one object: how it reflects or, of an emitter, how it shines.
    Maps are "albedo" of a reflector, "emission" of an emitter, and others."""

    emitter: bool
    rays_per_texel: Annotated[float, Fact(SHADING, "raysPerTexel", "float", 0.0, """Mean number of
        rays traced per texel.""", low=0)]
    standard_error: Annotated[float, Fact(SHADING, "standardError", "float", 0.0, """Relative
        standard error of the irradiance before any denoising, median over the texels; without
        unit.""", low=0)]
    escaped_fraction: Annotated[float, Fact(SHADING, "escapedFraction", "float", 0.0, """Share of
        the rays that left the scene and met the environment; 0 to 1, without unit.""",
        low=0, high=1)]
    mean_albedo: Annotated[Colour, Fact(SHADING, "meanAlbedo", "color3f", (0, 0, 0),
        """Area-weighted mean albedo, linear Rec.709; without unit. Black for an emitter, which has
        no albedo.""", low=0, high=1)]
    radiance: Annotated[Colour, Fact(EMITTER, "radiance", "color3f", (0, 0, 0), """Mean radiance of
        the emitting texels, linear Rec.709, in W m-2 sr-1 where the capture is calibrated, else in
        the units of the pixel values.""", low=0)]
    radiance_status: Annotated[
        str,
        Fact(EMITTER, "radianceStatus", "token", "measured", """How the radiance is known: measured
            in photographs; estimated from the light that the emitter casts, as it was clipped in
            every photograph, or shown by none; lowerBound where that light does not tell.""",
            tokens=("measured", "estimated", "lowerBound")),
        # All that versions have authored which knew no estimates.
        Fact(EMITTER, "lowerBound", "bool", False, """True where the emitter was clipped in every
            photograph and the light that it casts does not tell its radiance either: the true
            radiance is in all likelihood at least the stated one. radianceStatus is lowerBound
            then.""",
            stored=lambda status: status == "lowerBound",
            read=lambda bound: "lowerBound" if bound else "measured"),
    ]
    radiance_error: Annotated[float, Fact(EMITTER, "radianceError", "float", 0.0, """Relative
        standard error of an estimated radiance, in the worst channel; without unit. Authored on
        estimated emitters only.""", low=0,
        when=lambda shaded: shaded.radiance_status == "estimated")]
    directive: Annotated[str, Fact(SHADING, "directive", "token", "", """Whether the object shines
        was said by a person, in review.usda or in the capture's objects. lamp: it does;
        not-lamp: it does not; empty where its radiance told.""", tokens=OF_SHADE,
        when=lambda shaded: bool(shaded.directive))] = ""
    lets_through: Annotated[bool, Fact(SHADING, "letsThrough", "bool", False, """True where
        photographs show the outside through the object, as through a pane: light was then
        traced as if it was not there.""", when=lambda shaded: shaded.lets_through)] = False
    area_fraction: Annotated[float, Fact(EMITTER, "areaFraction", "float", 0.0, """Share of the
        object's surface that emits; 0 to 1, without unit.""", low=0, high=1, absent=0.0)]


@dataclass(frozen=True, kw_only=True)
class LightFromOutside:
    """Of the whole scan, on the default prim; ``sky`` and ``confidence`` are relative to the asset
    folder here."""

    sky: Annotated[str, Fact(OUTSIDE, "sky", "asset", "", """Radiance of the surroundings without
        the sun, a latitude-longitude picture as a DomeLight has it, in W m-2 sr-1 where the capture
        is calibrated.""", stored=path_in_layer, read=path_in_asset)]
    confidence: Annotated[str, Fact(OUTSIDE, "confidence", "asset", "", """How each direction of the
        picture is known: 1 where photographs show it or a file told it, 0.5 where it clips in all
        of them, 0 where it was inferred from the light that it casts.""", stored=path_in_layer,
        read=path_in_asset)]
    source: Annotated[str, Fact(OUTSIDE, "source", "token", "estimated", """estimated: the
        capture tells the light; given: a file did.""", tokens=("estimated", "given"))]
    open_share: Annotated[float, Fact(OUTSIDE, "openShare", "float", 0.0, """Share of the light's
        directions that leave the scan; 0 to 1, without unit.""", low=0, high=1)]
    sky_error: Annotated[float, Fact(OUTSIDE, "skyError", "float", 0.0, """Relative standard error
        of what was inferred of the picture; without unit.""", low=0)]
    sun_irradiance: Annotated[Colour, Fact(OUTSIDE, "sunIrradiance", "color3f", (0, 0, 0), """What
        the sun brings to a surface that faces it, linear Rec.709, in W m-2 where the capture is
        calibrated, else in the units of the pixel values; black where there is no sun.""", low=0)]
    sun_direction: Annotated[Colour, Fact(OUTSIDE, "sunDirection", "vector3f", (0, 0, 1), """Unit
        vector towards the sun, in the frame of the world; without unit.""",
        when=lambda outside: any(outside.sun_irradiance))]
    sun_half_angle: Annotated[float, Fact(OUTSIDE, "sunHalfAngle", "float", 0.00465, """Half of the
        angle of the sun's disc, in radians.""", low=0,
        when=lambda outside: any(outside.sun_irradiance))]
    sun_error: Annotated[float, Fact(OUTSIDE, "sunError", "float", 0.0, """Relative standard error
        of the sun's irradiance in the worst channel; without unit.""", low=0)]

    @property
    def summary(self) -> dict[str, Any]:
        """What a summary says of it, JSON."""
        numbers = {name: getattr(self, name) for name in ("open_share", "sky_error", "sun_error")}
        known = {name: round(n, 4) for name, n in numbers.items() if math.isfinite(n)}
        sun = {"sun_direction": self.sun_direction, "sun_irradiance": self.sun_irradiance}
        return {"source": self.source, **known, **(sun if any(self.sun_irradiance) else {})}


@dataclass(frozen=True, kw_only=True)
class FittedObject(MeasuredObject):
    """Result of the task fit for one object; NaN where a number is not known. Maps are "diffuse",
    "refined_irradiance" and "base_color", if the fit refined them."""

    phi: Annotated[float, Fact(FIT, "phi", "float", 0.5, """Roughness parameter: alpha of the GGX
        distribution is max(0.001, phi); 0 to 1, without unit.""", low=0, high=1)]
    psi: Annotated[float, Fact(FIT, "psi", "float", 0.0, """Specular parameter: the reflectance at
        normal incidence is F0 = 0.08 psi; 0 to 1, without unit. Of a conductor 1, which says that
        F0 is above all dielectrics': it is usdBrdf:fit:f0.""", low=0, high=1)]
    phi_error: Annotated[float, Fact(FIT, "phiError", "float", 0.0, """Standard deviation of phi,
        errors of the model included; without unit.""", low=0)] = math.nan
    psi_error: Annotated[float, Fact(FIT, "psiError", "float", 0.0, """Standard deviation of psi,
        errors of the model included; without unit.""", low=0)] = math.nan
    psi_upper: Annotated[float, Fact(FIT, "psiUpper95", "float", 1.0, """What psi exceeds with a
        probability of 5 %, highlight or none; without unit.""", low=0, high=1)] = math.nan
    shown_phi: Annotated[float, Fact(FIT, "shownPhi", "float", 0.5, """The phi that the material
        shows in place of the measurement, where it is authored: what is usual for the object's
        class (option --unmeasured class); without unit.""", low=0, high=1)] = math.nan
    shown_psi: Annotated[float, Fact(FIT, "shownPsi", "float", 0.5, """The psi that the material
        shows in its place, where authored; no more than psiUpper95; without unit.""", low=0,
        high=1)] = math.nan
    phi_confidence: Annotated[str, Fact(FIT, "phiConfidence", "token", "none",
        _CONFIDENCE.format("phi"), tokens=_CONFIDENCES)] = "none"
    psi_confidence: Annotated[str, Fact(FIT, "psiConfidence", "token", "none",
        _CONFIDENCE.format("psi"), tokens=_CONFIDENCES)] = "none"
    lobe: Annotated[str, Fact(FIT, "lobe", "token", "paper", """Equations that phi and psi are
        numbers of. paper: masking of width ((phi + 1) / 2)^2 and Schlick's Fresnel term;
        microfacet: Smith's masking of alpha, and Fresnel's equations; beckmann: these with
        facets after Beckmann. Either all objects of an asset have the paper's or none has.""",
        tokens=("paper", "microfacet", "beckmann"))] = "paper"
    model: Annotated[str, Fact(FIT, "model", "token", "dielectric", """dielectric: a diffuse colour
        under a lobe; diffuse: a colour alone, no lobe being found; conductor: a metal, a lobe
        alone whose reflectance differs by channel; transparent: clear glass, not fitted.""",
        formerly="kind", tokens=_MODELS)] = "dielectric"
    directive: Annotated[str, Fact(FIT, "directive", "token", "", """What a person asked of the fit,
        in review.usda or in the capture's objects, and it followed. ignore: nothing was fitted;
        metal: a conductor was, whatever explains the photographs better; glass: nothing was, and
        the material is clear; refit: fitted with other random numbers.""", tokens=OF_FIT,
        when=lambda fitted: bool(fitted.directive))] = ""
    f0: Annotated[Colour, Fact(FIT, "f0", "color3f", (0, 0, 0), """Reflectance of a conductor at
        normal incidence, per channel; 0 to 1, without unit.""", low=0, high=1,
        when=lambda fitted: fitted.is_metal)] = (0.0, 0.0, 0.0)
    f0_error: Annotated[float, Fact(FIT, "f0Error", "float", 0.0, """Standard deviation of F0 over
        channels, root mean square; without unit.""", low=0)] = math.nan
    cost: Annotated[float, Fact(FIT, "cost", "float", 0.0, """Loss of the fit at its minimum: of
        method views per degree of freedom, in units of the errors' variance; of scaled the mean
        over the pixels used, relative to their squared radiance; of paper that in squared units of
        radiance.""", low=0)]
    evidence: Annotated[float, Fact(FIT, "evidence", "float", 0.0, """1 - loss(phi, psi) / loss(no
        specular lobe): what the highlights explain; 0 is nothing, 1 is everything; without
        unit.""", high=1)]
    contradiction: Annotated[float, Fact(FIT, "contradiction", "float", 0.0, """Relative standard
        deviation between views, alike over the object or places of it, that no lobe explains, or
        the share of its light that shows through it for sure, whichever is more; authored
        where it is too large for a surface, and things are seen through or in it; without unit.""",
        low=0)] = math.nan
    status: Annotated[str, Fact(FIT, "status", "token", "unseen", """measured: phi and psi come from
        the photographs, and their stated errors are small; bounded: they do not determine
        both, but psi lies below psiUpper95, less than 0.5; undetermined: they say less. Of these
        what is not determined is the median of all that remains likely. unseen: no photograph
        shows enough of the object; failed: of method paper, whose minimum is kept
        though the photograph does not determine it.""", tokens=_STATUSES,
        read=lambda status: "undetermined" if status == "prior" else status)]
    target_frame: Annotated[int, Fact(FIT, "targetFrame", "int", -1, """Index of the photograph that
        shows the highlight best, counted from 0 (time code minus 1); -1 for none.""", low=-1)]
    num_pixels: Annotated[int, Fact(FIT, "numPixels", "int", 0, """Number of pixels that the fit
        used.""", low=0)]
    method: Annotated[str, Fact(FIT, "method", "token", "", """Kind of fit, as --fit spells it.""")]
    mapping: Annotated[str, Fact(FIT, "mapping", "token", "measured", """How UsdPreviewSurface was
        derived from phi and psi. measured: literally, roughness = sqrt(max(0.001, phi)), F0 = 0.08
        psi. matched: the reflectance and a factor on the diffuse colour were refitted, so that
        renderers show what the fitted lobe reflects. microfacet: F0 = 0.08 psi, for the lobe is
        that of renderers, with a factor on the diffuse colour for what they take away from it.""",
        tokens=("measured", "matched", "microfacet"),
        when=lambda fitted: fitted.is_known)] = "measured"
    mean_color: Colour = (0.0, 0.0, 0.0)  # area-weighted base colour, linear

    @property
    def shown(self) -> tuple[float, float]:
        """phi and psi of the material."""
        usual = math.isfinite(self.shown_phi)
        return (self.shown_phi, self.shown_psi) if usual else (self.phi, self.psi)

    @property
    def is_known(self) -> bool:
        """Whether there is a lobe to show."""
        return math.isfinite(self.phi) and math.isfinite(self.psi)

    @property
    def is_metal(self) -> bool:
        return self.model == "conductor"

    @property
    def is_glass(self) -> bool:
        return self.model == "transparent"

    @property
    def is_contradicted(self) -> bool:
        """Whether its views are those of something that is seen through."""
        return math.isfinite(self.contradiction)

    @property
    def doubts(self) -> list[str]:
        """Sentences about what a person should look at."""
        if not self.is_contradicted:
            return []
        return [
            f"{self.identifier}: {self.contradiction:.0%} of its light changes between views as no "
            "surface's does, or is that of what lies behind it, so its lobe is not measured. If it "
            "is glass, or a metal, say so by a directive. [fit.contradicted]"
        ]

    @property
    def psi_of_channels(self) -> Colour:
        """F0 / 0.08 of the lobe as it was found: of a metal more than 1, and not grey."""
        red, green, blue = self.f0 if self.is_metal else (F0_OF_PSI * self.psi,) * 3
        return red / F0_OF_PSI, green / F0_OF_PSI, blue / F0_OF_PSI

    @property
    def summary(self) -> dict[str, Any]:
        """What a summary says of the object, JSON."""
        names = ("phi", "psi", "phi_error", "psi_error", "psi_upper", "phi_confidence",
                 "psi_confidence", "status", "evidence", "target_frame", "model")
        row = {name: getattr(self, name) for name in names}
        if self.directive:
            row["directive"] = self.directive
        if self.is_metal:
            row |= {"f0": [round(value, 4) for value in self.f0], "f0_error": self.f0_error}
        row |= {name: round(value, 4) if math.isfinite(value) else None
                for name, value in row.items() if isinstance(value, float)}
        return row | {"evidence": row["evidence"] or 0.0}
# fmt: on


RECORDS = (
    LabelledObject, Photographs, Aov, TexturedObject, ShadedObject, LightFromOutside, FittedObject,
)  # fmt: skip


@cache
def facts_of(record: type) -> tuple[tuple[str, Fact], ...]:
    """The rows of a kind of record, each with the name of its field, in the order of authoring."""
    hints = get_type_hints(record, include_extras=True)
    rows = ((name, extra) for name in hints for extra in getattr(hints[name], "__metadata__", ()))
    return tuple((name, extra) for name, extra in rows if isinstance(extra, Fact))


def facts_by_attribute(records: Sequence[type] = RECORDS) -> dict[str, Fact]:
    """The whole table; names of schemas that are applied several times hold ``INSTANCE``."""
    return {fact.attribute(): fact for record in records for _, fact in facts_of(record)}


def known_facts(record: Any) -> Iterator[tuple[Fact, Any]]:
    """What a record has to say, each fact with the value as it is stored."""
    kind: type = type(record)
    for field, fact in facts_of(kind):
        value = fact.stored(getattr(record, field))
        applies = not fact.schema.flag or getattr(record, fact.schema.flag)
        finite = fact.type != "float" or math.isfinite(value)
        if applies and finite and fact.when(record):
            yield fact, value
