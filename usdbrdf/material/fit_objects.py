"""One pass over the frames for all objects, then a lobe for each of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.ahead import ahead
from usdbrdf.files.frames import FramePixels, FrameReader
from usdbrdf.job.progress import progress
from usdbrdf.job.task import TaskRun
from usdbrdf.job.units import Unit
from usdbrdf.material.doubt_of_light import with_doubts_of_light
from usdbrdf.material.fit_lobe import first_seed
from usdbrdf.material.fit_target import (
    FrameCounts,
    Residual,
    choose_target_frames,
    count_frame,
    fit_target_frame,
    metal_of_target_frame,
)
from usdbrdf.material.fit_views import (
    MIXTURE,
    SampledObject,
    fit_kinds,
    fit_views,
    joined_object,
    metal_if_opaque,
    sampled_object,
    with_what_shows_through,
)
from usdbrdf.material.observations import Follower, Observations
from usdbrdf.material.verdict import (
    LobeEstimate,
    Verdict,
    usual_lobe,
    verdict_on_frame,
    verdict_on_metal,
    verdict_on_views,
)
from usdbrdf.model.arrays import Array, Bool, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import GLASS, IN_PART, LEFT_OUT, METAL, REFIT
from usdbrdf.model.scene import SceneObject
from usdbrdf.options import FitOptions
from usdbrdf.transport.brdf import BECKMANN, DIELECTRIC, PAPER
from usdbrdf.transport.lit_scene import LitScene, View
from usdbrdf.transport.lobe_radiance import Mixture

# Objects that are fitted together: while rays of one are traced on all cores, others are at their
# algebra, which takes one.
_AT_A_TIME = 3
# A1 and A2 are counted on about this many pixels per frame.
_COUNTED_PIXELS = 80_000
_OTHER_SEED = 0x5EED


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What one pass over the frames gathers: per object the target frame, which shows its highlight
    best (-1: none), and how much of it; and, as the method needs, the observations of followed
    texels, and by how many pixels the pictures were smoothed (NaN: they do not tell)."""

    target: Int
    shown: Float
    observations: Observations
    smoothing: float


class Lighting(NamedTuple):
    """A scene in one light, what the frames that show it so told, and S (T, 3), W/m^2, in it; and
    the scene in nothing but the standard errors of its light, None where all of that was seen."""

    lit: LitScene
    survey: Survey
    irradiance: Float | None = None
    doubt: LitScene | None = None


class ObjectFit(NamedTuple):
    """What the frames say of one object's lobe; NaN where it could not be fitted.

    phi, psi, phi_error, psi_error  parameters of the lobe and their standard deviations
    unresolved    share of the highlight that the pixels do not resolve
    cost          at the minimum; evidence: 1 - cost / cost without a lobe
    phi_median, psi_median, psi_upper  of what remains likely, and contradiction, of the samples by
                  any lobe: see ``LobeEstimate``
    metal_phi, red, green, blue, metal_phi_error, f0_error, clearer  of the metal that explains the
                  samples better, see ``Conductor``
    num_samples   how many the fit used; target: the frame that shows the highlight best, -1: none
    beckmann      1 where phi and psi are of facets after Beckmann
    """

    phi: float = math.nan
    psi: float = math.nan
    phi_error: float = math.nan
    psi_error: float = math.nan
    unresolved: float = math.nan
    cost: float = math.nan
    evidence: float = math.nan
    phi_median: float = math.nan
    psi_median: float = math.nan
    psi_upper: float = math.nan
    contradiction: float = math.nan
    metal_phi: float = math.nan
    red: float = math.nan
    green: float = math.nan
    blue: float = math.nan
    metal_phi_error: float = math.nan
    f0_error: float = math.nan
    clearer: float = math.nan
    num_samples: int = 0
    target: int = -1
    beckmann: int = 0

    def arrays(self) -> dict[str, Array]:
        """As checkpoints hold it."""
        return {"fit": np.array(self, np.float64)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> ObjectFit:
        """The inverse of ``arrays``."""
        *numbers, num_samples, target, beckmann = arrays["fit"].tolist()
        return cls._make([*numbers, int(num_samples), int(target), int(beckmann)])

    def rounded(self) -> ObjectFit:
        """Without the digits that depend on how many threads the linear algebra had."""
        return ObjectFit._make([*(round(number, 4) for number in self[:-3]), *self[-3:]])


def survey_frames(
    run: TaskRun,
    lit: LitScene,
    usable: Bool,
    reader: FrameReader,
    options: FitOptions,
    own: range | None = None,
) -> Survey:
    """Gather all that the fits need of the frames, which are read once.

    usable (T,): measured by frames, and no lamp; own: the frames that show the scene in this light,
    None for all
    """
    frames = reader.frames
    own = own or range(len(frames))

    def gather() -> dict[str, Array]:
        by_views = options.method == "views"
        followed = usable & lit.texels.interior & by_views
        follower = Follower(lit, followed, len(own), options.seed)

        def look(i: int) -> FrameCounts | None:
            pixels = reader.read(i)
            if by_views:
                view, noise_floor = _view(frames, i, pixels), float(frames.noise_floor_radiance[i])
                follower.add(i - own.start, view, pixels.clipped, noise_floor)
                return None
            stride = max(1, round(math.sqrt(pixels.valid.size / _COUNTED_PIXELS)))
            return count_frame(lit, pixels.valid, frames.camera(i), stride)

        looks = ahead(look, own)
        looked = progress(looks, total=len(own), label="fit: survey", unit="frames")
        counts = [count for count in looked if count is not None]
        target, shown = follower.target_frames() if by_views else choose_target_frames(counts)
        observed = follower.chosen(options.seed)
        return {
            "target": np.where(target >= 0, own.start + target, -1).astype(np.int32),
            "shown": shown,
            "smoothing": np.array(follower.smoothing),
            **observed._replace(frame=own.start + observed.frame)._asdict(),
        }

    found = run.checkpoint("survey", gather)
    target, shown, smoothing = (found.pop(name) for name in ("target", "shown", "smoothing"))
    observations = Observations(**found)
    return Survey(target=target, shown=shown, smoothing=float(smoothing), observations=observations)


def _view(frames: Frames, i: int, pixels: FramePixels) -> View:
    radiance = np.nan_to_num(pixels.radiance)
    return View(radiance=radiance, valid=pixels.valid, camera=frames.camera(i))


class FirstLook(NamedTuple):
    """Of one object: a fit per kind of lobe that was asked, none where it has too few samples, and
    how many it has; and ln of the cost of DIELECTRIC over the paper's, and of BECKMANN over that
    (see ``FittedKind``)."""

    lobes: dict[int, LobeEstimate]
    num_samples: int
    log_ratio: float = 0.0
    ratio_of_beckmann: float = 0.0

    @property
    def has_facets_after_beckmann(self) -> bool:
        """Whether these explain the views clearly better."""
        return self.ratio_of_beckmann < -_BECKMANN_CLEARER

    def arrays(self) -> dict[str, Array]:
        """As checkpoints hold it."""
        flat = {_NAMES[kind]: [*one[:7], *one[7], *one[8:]] for kind, one in self.lobes.items()}
        ratios = {"log_ratio": self.log_ratio, "ratio_of_beckmann": self.ratio_of_beckmann}
        every = {"num_samples": self.num_samples, **ratios, **flat}
        return {name: np.array(value) for name, value in every.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> FirstLook:
        """The inverse of ``arrays``."""
        lobes = {}
        for kind, name in _NAMES.items():
            if name in arrays:
                one = arrays[name].tolist()
                lobes[kind] = LobeEstimate._make([*one[:7], (one[7], one[8]), *one[9:]])
        ratios = float(arrays["log_ratio"]), float(arrays["ratio_of_beckmann"])
        return cls(lobes, int(arrays["num_samples"]), *ratios)


_NAMES = {PAPER: "paper", DIELECTRIC: "microfacet", BECKMANN: "beckmann"}
# Of the logarithms of what lobes leave unexplained, summed over objects: what the two kinds must
# differ by.
_PAPER_CLEARER = calibration.number("fit.paper_clearer")
# The same of one object's facets.
_BECKMANN_CLEARER = calibration.number("fit.beckmann_clearer")


def fitted_by_likelier_lobe(
    run: TaskRun,
    lightings: Sequence[Lighting],
    reader: FrameReader,
    options: FitOptions,
    asked: Mapping[int, str] = MappingProxyType({}),
) -> tuple[int, list[ObjectFit]]:
    """The kind of lobe that the scene's surfaces have, and ``fit_object`` of every object with
    that; ``asked``: what a person wants of some, by number.

    Surfaces are taken to have the lobe of renderers, whose masking and Fresnel term follow from
    the model of facets, unless the paper's explains the views of all objects clearly better; and
    facets after Trowbridge and Reitz, unless Beckmann's explain those of an object so.
    """
    sizes = _sizes(lightings)
    looks: list[FirstLook | None] = [None] * len(sizes)
    kinds = [PAPER]
    if options.method == "views":
        kinds = [kind for kind in (PAPER, DIELECTRIC) if options.lobe in (_NAMES[kind], "auto")]
        kinds += [BECKMANN] if DIELECTRIC in kinds else []
        looks = list(first_looks(run, lightings, reader, kinds, options))
    paper = kinds == [PAPER] or (PAPER in kinds and have_lobe_of_paper(looks))
    lobe = PAPER if paper else DIELECTRIC

    given = _Scene(tuple(lightings), reader, options, (lobe,))
    pieces = [(i, looks[i], asked.get(i, "")) for i in range(len(sizes))]
    found = _of_each_object(run, "object", sizes, _fit, given, pieces, label="fit")
    return lobe, [ObjectFit.from_arrays(one).rounded() for one in found]


def have_lobe_of_paper(looks: Sequence[FirstLook | None]) -> bool:
    """Whether the paper's lobe explains the views of all objects clearly better than that of
    renderers. It takes three objects: of one, with few samples in noisy light, a lobe may by chance
    seem to explain all."""
    each = [
        look.log_ratio + look.ratio_of_beckmann * look.has_facets_after_beckmann
        for look in looks
        if look
    ]
    most = _PAPER_CLEARER / 2
    return bool(np.clip(each, -most, most).sum() > _PAPER_CLEARER)


class _Scene(NamedTuple):
    """What objects are fitted in, and the kinds of lobe that are."""

    lightings: tuple[Lighting, ...]
    reader: FrameReader
    options: FitOptions
    kinds: tuple[int, ...]


def _fit(scene: _Scene, piece: tuple[int, FirstLook | None, str]) -> dict[str, Array]:
    index, look, asked = piece
    lightings, reader, options, (lobe,) = scene
    if look and lobe == DIELECTRIC and look.has_facets_after_beckmann:
        lobe = BECKMANN
    return fit_object(lobe, lightings, reader, index, options, look, asked=asked).arrays()


def _look_at(scene: _Scene, index: int) -> dict[str, Array]:
    sampled, number = _sampled(scene.lightings, scene.reader, index, MIXTURE)
    fitted = fit_kinds(sampled, scene.kinds, first_seed(scene.options.seed)) if sampled else {}
    lobes = {kind: one.lobe for kind, one in fitted.items()}
    ratios = (fitted[kind].log_ratio if kind in fitted else 0.0 for kind in (DIELECTRIC, BECKMANN))
    return FirstLook(lobes, number, *ratios).arrays()


def first_looks(
    run: TaskRun,
    lightings: Sequence[Lighting],
    reader: FrameReader,
    kinds: Sequence[int],
    options: FitOptions,
) -> list[FirstLook]:
    """Every object fitted once with the first kind of lobe, and where that shows with the others,
    whose rays are the same."""
    given, sizes = _Scene(tuple(lightings), reader, options, tuple(kinds)), _sizes(lightings)
    pieces = range(len(sizes))
    found = _of_each_object(run, "look", sizes, _look_at, given, pieces, label="fit: first look")
    return [FirstLook.from_arrays(one) for one in found]


def _of_each_object(
    run: TaskRun,
    name: str,
    sizes: Sequence[int],
    unit: Unit,
    given: _Scene,
    pieces: Sequence[Any],
    label: str,
) -> list[dict[str, Array]]:
    """A unit of work for each object; the largest first, so that none is worked on alone at the
    end."""
    order = sorted(range(len(sizes)), key=lambda i: -sizes[i])
    found = run.units(
        unit, given, {f"{name}-{i}": pieces[i] for i in order},
        label=label, noun="objects", at_a_time=_AT_A_TIME,
    )  # fmt: skip
    of_object = dict(zip(order, found, strict=True))
    return [of_object[i] for i in range(len(sizes))]


def _sizes(lightings: Sequence[Lighting]) -> list[int]:
    """How many observations there are of each object."""
    sizes = np.zeros(len(lightings[0].lit.scene.objects), np.int64)
    for lit, survey, *_ in lightings:
        owner = lit.texels.object_index()[survey.observations.texel]
        sizes += np.bincount(owner, minlength=len(sizes))
    return [*map(int, sizes)]


def _sampled(
    lightings: Sequence[Lighting], reader: FrameReader, index: int, mixture: Mixture
) -> tuple[SampledObject | None, int]:
    """What all lightings show of an object, and the number of samples."""
    found, camera_of = [], reader.frames.camera
    for lit, survey, irradiance, doubt in lightings:
        own = survey.observations.of_texels(lit.texels.of_object(index))
        found.append(
            sampled_object(lit, own, survey.smoothing, camera_of, index, mixture, irradiance, doubt)
        )
    sampled = joined_object([one for one, _ in found if one])
    return sampled, len(sampled.samples.texel) if sampled else sum(number for _, number in found)


def fit_object(
    lobe: int,
    lightings: Sequence[Lighting],
    reader: FrameReader,
    index: int,
    options: FitOptions,
    look: FirstLook | None = None,
    mixture: Mixture = MIXTURE,
    asked: str = "",
) -> ObjectFit:
    """The lobe of one object by the chosen method, of a kind (``brdf``).

    lightings: one alone where the method takes one frame. look: what has been fitted already.
    mixture: see sampled_object. asked: what a person wants, see ``OF_FIT``.
    """
    if asked in LEFT_OUT:
        return ObjectFit()
    if asked == REFIT:  # random numbers that nothing has been fitted with
        options, look = replace(options, seed=(options.seed + _OTHER_SEED) % 2**32), None
    survey = max((one.survey for one in lightings), key=lambda survey: survey.shown[index])
    target = int(survey.target[index])
    if options.method != "views":
        return _fit_of_frame(lightings[0].lit, reader, target, index, options, asked)
    prepared = cache(lambda: _sampled(lightings, reader, index, mixture))
    used = look.num_samples if look else prepared()[1]
    if not (look.lobes if look else prepared()[0]):
        return ObjectFit(num_samples=used, target=target)

    def sampled() -> SampledObject:
        found, _ = prepared()
        assert found is not None
        return found

    first = look.lobes.get(lobe) if look else None
    fitted, metal = fit_views(lobe, sampled, options.seed, first, metal=asked == METAL)
    if any(one.doubt for one in lightings):
        fitted, metal = with_doubts_of_light(lobe, sampled, options.seed, fitted, metal)
    if metal and asked != METAL:
        fitted, metal = metal_if_opaque(lobe, sampled, index, options.seed, fitted, metal)
    if not metal:
        fitted = with_what_shows_through(lobe, sampled, index, options.seed, fitted)
    found = ObjectFit(
        *fitted[:7], fitted.phi_median, fitted.psi_median, fitted.psi_upper,
        fitted.contradiction, num_samples=used, target=target, beckmann=int(lobe == BECKMANN),
    )  # fmt: skip
    if not metal:
        return found
    return found._replace(
        metal_phi=metal.phi, red=metal.f0[0], green=metal.f0[1], blue=metal.f0[2],
        metal_phi_error=metal.phi_error, f0_error=metal.f0_error, clearer=metal.clearer,
    )  # fmt: skip


def _fit_of_frame(
    lit: LitScene, reader: FrameReader, target: int, index: int, options: FitOptions, asked: str
) -> ObjectFit:
    """The paper's: from the target frame alone. It cannot tell a metal from what is none, and
    believes who ``asked`` for one."""
    faces = np.arange(*lit.scene.objects[index].faces.indices(len(lit.scene.triangles)))
    third = np.full(len(faces), 1 / 3, np.float32)
    shines = lit.emission.at(faces.astype(np.int32), third, third)[:, 0] > 0.5
    if target < 0 or shines.all():
        return ObjectFit(target=target)
    view = _view(reader.frames, target, reader.read(target))
    if asked == METAL:
        metal, used = metal_of_target_frame(lit, view, index, options.max_pixels, options.seed)
        if metal is None:
            return ObjectFit(num_samples=used, target=target)
        error = (metal.phi_high - metal.phi_low) / math.sqrt(12)
        red, green, blue = metal.f0
        return ObjectFit(
            metal.phi, 1.0, error, math.nan, 0.0, metal.cost, metal.evidence,
            metal_phi=metal.phi, red=red, green=green, blue=blue, metal_phi_error=error,
            clearer=0.0, num_samples=used, target=target,
        )  # fmt: skip
    residual: Residual = "paper" if options.method == "paper" else "scaled"
    of_frame, used = fit_target_frame(lit, view, index, residual, options.max_pixels, options.seed)
    if of_frame is None:
        return ObjectFit(num_samples=used, target=target)
    # As if all roughnesses that fit were equally likely; of psi the frame alone tells none.
    error = (of_frame.phi_high - of_frame.phi_low) / math.sqrt(12)
    return ObjectFit(
        of_frame.phi, of_frame.psi, error, math.nan, 0.0, of_frame.cost, of_frame.evidence,
        num_samples=used, target=target,
    )  # fmt: skip


def judged(
    found: ObjectFit, obj: SceneObject, options: FitOptions, observed: bool, asked: str = ""
) -> Verdict:
    """What to publish and to show of a fit; ``observed``: some frame shows the object; ``asked``:
    what a person wanted of it."""
    if asked == GLASS:
        return replace(verdict_on_views(None, observed), model="transparent")
    if math.isfinite(found.clearer):
        f0 = found.red, found.green, found.blue
        errors = found.metal_phi_error, found.f0_error
        return verdict_on_metal(found.metal_phi, f0, *errors, likelier=found.clearer > 0)
    if options.method == "views":
        lobe = LobeEstimate(
            found.phi, found.psi, found.phi_error, found.psi_error, found.unresolved, found.cost,
            found.evidence, (0.0, 0.0), found.phi_median, found.psi_median, found.psi_upper,
            found.contradiction,
        )  # fmt: skip
        verdict = verdict_on_views(lobe if math.isfinite(found.phi) else None, observed)
    else:
        keep, phi = options.method == "paper", (found.phi, found.phi_error)
        verdict = verdict_on_frame(phi, found.psi, found.evidence, observed, keep)
    usual = usual_lobe(obj.class_name, obj.label) if options.unmeasured == "class" else None
    # What frames tell of a lobe without measuring it is more than what is usual.
    if usual is None or verdict.status not in IN_PART or verdict.psi_confidence != "none":
        return verdict
    return replace(verdict, shown_phi=usual[0], shown_psi=min(usual[1], verdict.psi_upper))
