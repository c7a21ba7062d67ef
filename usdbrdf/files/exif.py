"""How much light a photograph was given, and by which lens, as its camera wrote into its header."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from usdbrdf.errors import ImageRefused
from usdbrdf.files.images import header_of

# Stops between a stated time and a stated shutter's speed: below the first both are exact, as of
# telephones; beyond the second, which the names on dials do not reach, one of them is wrong.
_EXACT_STOPS, _ROUNDED_STOPS = 0.005, 0.15
# ISO speeds beyond what two bytes hold are written as the largest that they do.
_LARGEST_SPEED = 65535
_TIME, _STOPS = "ExposureTime", "Exif:ShutterSpeedValue"
_NUMBER, _APERTURE = "FNumber", "Exif:ApertureValue"
_SPEEDS = (
    "Exif:PhotographicSensitivity", "Exif:ISOSpeed", "Exif:RecommendedExposureIndex",
    "Exif:StandardOutputSensitivity",
)  # fmt: skip
_NAMES = (_TIME, _STOPS, _NUMBER, _APERTURE, *_SPEEDS)
_FOCAL, _ZOOM = "Exif:FocalLengthIn35mmFilm", "Exif:DigitalZoomRatio"
# Diagonal of a picture on 35 mm film, 36 x 24 mm.
_FILM_DIAGONAL_MM = math.hypot(36, 24)


class Headers:
    """Headers of photographs, each of which is opened once for all that is asked of it here."""

    def __init__(self) -> None:
        self._said: dict[Path, dict[str, object] | ImageRefused] = {}

    def of(self, path: Path, names: Sequence[str]) -> list[object]:
        """As ``header_of`` says it, which raises ImageRefused."""
        if path not in self._said:
            asked = (*_NAMES, _FOCAL, _ZOOM)
            try:
                self._said[path] = dict(zip(asked, header_of(path, asked), strict=True))
            except ImageRefused as error:
                self._said[path] = error
        said = self._said[path]
        if isinstance(said, ImageRefused):
            raise said
        return [said[name] for name in names]


class Settings(NamedTuple):
    """Seconds, f-number and ISO speed of a photograph, None where they are not told."""

    time: float | None
    number: float | None
    speed: float | None

    @property
    def light(self) -> float | None:
        """Exposure time times ISO / 100, over the square of the f-number; what is not told counts
        as ISO 100 and f/1. None without an exposure time."""
        if self.time is None:
            return None
        return self.time * (self.speed or 100) / 100 / (self.number or 1) ** 2


def exif_settings(path: Path, headers: Headers | None = None) -> Settings:
    """What the EXIF data of a photograph say, in numbers or else in stops (APEX).

    A dial's 1/30 or 1/125 is a name: the shutter opens for 1/32 and 1/128. Where the shutter's
    speed in stops says so, that is taken, as a whole, half or third stop."""
    said = dict(zip(_NAMES, (headers or Headers()).of(path, _NAMES), strict=True))
    time, stops = _positive(said[_TIME]), _finite(said[_STOPS])
    if said[_TIME] is not None and time is None and stops == 0:
        stops = None  # of who writes 0 for what is not known
    if time is not None and stops is not None:
        time = _shutter_time(time, stops)
    elif stops is not None:
        time = _power(-stops)
    number, aperture = _positive(said[_NUMBER]), _finite(said[_APERTURE])
    if number is None and aperture:  # 0 is of lenses without contacts: of f/1 both are written
        number = _power(aperture / 2)
    speeds = [_positive(_first(said[name])) for name in _SPEEDS]
    known = [speed for speed in speeds if speed is not None and speed != _LARGEST_SPEED]
    return Settings(time, number, next(iter(known), None))


def exif_exposure(path: Path) -> float | None:
    """How much light a photograph was given, see ``Settings.light``."""
    return exif_settings(path).light


def exif_focal_lengths(
    path: Path, width: int, height: int, headers: Headers | None = None
) -> list[float]:
    """Focal length, in pixels of the whole picture in that size, of a photograph whose EXIF data
    tell that of a camera for 35 mm film with as large an angle of view; of a digital zoom it may
    tell that before it or after, and both are returned. None are where they do not tell it, or the
    file cannot be read, of which the reader of its pixels will tell."""
    with suppress(ImageRefused):
        said, zoom = map(_positive, (headers or Headers()).of(path, [_FOCAL, _ZOOM]))
        if said is not None:
            pixels = said / _FILM_DIAGONAL_MM * math.hypot(width, height)
            return [pixels * times for times in {1.0, max(zoom or 1.0, 1.0)}]
    return []


def exif_lights(paths: Sequence[Path], headers: Headers | None = None) -> dict[Path, float]:
    """The light of each of several photographs, see ``Settings.light``, but of those that cannot be
    read, of which the reader of their pixels will tell; none where it cannot be compared, as some
    tell a time, an f-number or a speed and others do not."""
    return _comparable(_readable_settings(paths, headers))


def exif_exposures(
    paths: Sequence[Path], headers: Headers | None = None
) -> tuple[list[float] | None, bool]:
    """The same of all of them, those that cannot be read with that of another, None where it cannot
    be compared; and whether any tells anything."""
    known = _readable_settings(paths, headers)
    lights = _comparable(known)
    other = next(iter(lights.values()), None)
    found = [lights.get(path, other) for path in paths]
    exposures = [light for light in found if light is not None]
    return (
        exposures if len(exposures) == len(paths) else None,
        any(one is not None for settings in known.values() for one in settings),
    )


def _comparable(known: Mapping[Path, Settings]) -> dict[Path, float]:
    if len({tuple(one is None for one in settings) for settings in known.values()}) != 1:
        return {}
    return {path: light for path, one in known.items() if (light := one.light) is not None}


def told_by_some(paths: Sequence[Path]) -> tuple[str, Path, Path] | None:
    """What some photographs tell of their exposure and others do not, in words, with one that tells
    it and one that does not; None where all tell the same, so that ``Settings.light`` compares."""
    known = _readable_settings(paths)
    for name, word in (("number", "f-number"), ("speed", "ISO speed")):
        telling = [path for path, settings in known.items() if getattr(settings, name) is not None]
        silent = [path for path in known if path not in telling]
        if telling and silent:
            return word, telling[0], silent[0]
    return None


def _readable_settings(
    paths: Sequence[Path], headers: Headers | None = None
) -> dict[Path, Settings]:
    known: dict[Path, Settings] = {}
    for path in paths:
        with suppress(ImageRefused):
            known[path] = exif_settings(path, headers)
    return known


def _first(value: object) -> object:
    return value[0] if isinstance(value, tuple) and value else value


def _finite(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def _positive(value: object) -> float | None:
    number = _finite(value)
    return number if number is not None and number > 0 else None


def _power(stops: float) -> float | None:
    """2 to that power, None where no camera means it."""
    return 2.0**stops if abs(stops) < 64 else None


def _shutter_time(time: float, stops: float) -> float:
    """For how long a shutter was open whose exposure time is stated, and its speed: the latter, set
    to the nearest stop of a dial, where they differ by no more than names do."""
    if not _EXACT_STOPS < abs(stops + math.log2(time)) < _ROUNDED_STOPS:
        return time
    return float(
        2 ** -min(round(3 * stops) / 3, round(2 * stops) / 2, key=lambda v: abs(v - stops))
    )
