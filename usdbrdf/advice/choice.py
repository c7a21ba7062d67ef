"""Which poses and exposures to take: greedily, each by what it adds to those before it.

What is known of an object grows less with every further photograph that shows the same, and what
was seen is not seen anew: of such a measure a greedy choice reaches 1 - 1/e of the best one
(G. Nemhauser, L. Wolsey, M. Fisher, 1978). Most looks are never weighed: what all that is visible
from a place would tell, whatever the picture's borders, bounds them (M. Minoux, 1978).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from usdbrdf.advice.knowledge import Exposure, Outlook, Products, view_of
from usdbrdf.advice.survey import Survey, Target
from usdbrdf.model.arrays import Bool, Double, Long

# What seeing all that clipped without clipping counts for, in objects that become known; and seeing
# all that can be seen for the first time, as a share of the objects that are not known.
_WORTH_OF_CLIPPED, _WORTH_OF_UNSEEN = 0.5, 1 / 3
# Points of an object in the picture, without which nothing is expected of it.
_FEWEST = 4
# A photograph that adds less than this, in objects, is not worth advising.
_LEAST = 0.01


class Gain(NamedTuple):
    """Of one object by one photograph: its number, and what is expected before and after it."""

    owner: int
    before: Outlook
    after: Outlook


class Choice(NamedTuple):
    """One photograph: place and look, numbers in the survey; exposure; what it adds, in objects;
    gains per object, and the spots of the surface (numbers) that are seen for the first time, or
    for the first time without clipping."""

    place: int
    look: int
    exposure: Exposure
    worth: float
    gains: tuple[Gain, ...]
    new: Long
    unclipped: Long


class _State:
    """What is known after the photographs that were chosen so far."""

    def __init__(self, survey: Survey) -> None:
        self.survey = survey
        self.unseen, self.clipped = survey.unseen.copy(), survey.clipped.copy()
        seen = np.zeros(survey.of_surface, np.bool_)
        for which in survey.visible:
            seen[which[which < survey.of_surface]] = True
        unseen = max(float(survey.area @ (self.unseen & seen)), 1e-12)
        clipped = max(float(survey.area @ (self.clipped & seen)), 1e-12)
        worth = max(_WORTH_OF_UNSEEN * len(survey.targets), 1.0)
        self._of_unseen = worth / unseen * survey.area
        self._of_clipped = _WORTH_OF_CLIPPED / clipped * survey.area
        self.products = [
            Products(*(values.copy() for values in target.products)) for target in survey.targets
        ]
        self.before = [self._outlook(i) for i in range(len(survey.targets))]

    def _target(self, i: int) -> Target:
        return replace(self.survey.targets[i], products=self.products[i])

    def _outlook(self, i: int, *more: tuple[Long, Double, Double]) -> Outlook:
        return self._target(i).expected(self.survey.lobes, *more)

    def view(
        self, i: int, place: int, exposure: Exposure, within: Bool | None = None
    ) -> tuple[Long, Double, Double] | None:
        """What a photograph has of target i: points, weights, basis; None where that is too little.
        within (points of the target,): what lies in the picture."""
        target = self.survey.targets[i]
        if place not in target.sights:
            return None
        which, basis = target.sights[place]
        if within is not None:
            kept = within[which]
            which, basis = which[kept], basis[kept]
        if len(which) < _FEWEST:
            return None
        level = self.survey.level[target.own][which]
        weight, free = view_of(level, basis, target.typical, exposure)
        return which, weight, free

    def after(
        self, i: int, place: int, exposure: Exposure, within: Bool | None = None
    ) -> Outlook | None:
        view = self.view(i, place, exposure, within)
        return self._outlook(i, view) if view else None

    def worth_of_surface(self, spots: Long, exposure: Exposure) -> Double:
        """(len(spots),): what seeing each spot of the surface adds."""
        worth = self.unseen[spots] * self._of_unseen[spots]
        worth = worth + self.clipped[spots] * self._of_clipped[spots]
        return np.asarray(worth * exposure.records(self.survey.level[spots]), np.float64)

    def bounds(self) -> Double:
        """(places, targets): what all that is visible from a place would add, recorded by no
        matter which exposure."""
        survey = self.survey
        ideal = Exposure(
            0.0,
            max(exposure.saturation for exposure in survey.exposures),
            min(exposure.noise_floor for exposure in survey.exposures),
        )
        found = np.zeros((len(survey.places), len(survey.targets)))
        for place in range(len(survey.places)):
            for i, before in enumerate(self.before):
                after = self.after(i, place, ideal)
                if after is not None:
                    found[place, i] = max(after.worth - before.worth, 0.0)
        return found

    def weighed(self, place: int, look: int, exposure: Exposure) -> Choice:
        """A photograph with all that it adds."""
        survey = self.survey
        spots = survey.visible[place][survey.inside[place][look]]
        surface = spots[spots < survey.of_surface]
        worth = float(self.worth_of_surface(surface, exposure).sum())
        surface = surface[exposure.records(survey.level[surface])]
        new, unclipped = surface[self.unseen[surface]], surface[self.clipped[surface]]
        inside = np.zeros(len(survey.spots.texel), np.bool_)
        inside[spots] = True
        gains = []
        for i, target in enumerate(survey.targets):
            after = self.after(i, place, exposure, inside[target.own])
            if after is not None:
                gains.append(Gain(target.index, self.before[i], after))
                worth += after.worth - self.before[i].worth
        return Choice(place, look, exposure, worth, tuple(gains), new, unclipped)

    def take(self, choice: Choice) -> None:
        survey = self.survey
        self.unseen[choice.new] = False
        self.clipped[choice.unclipped] = False
        inside = np.zeros(len(survey.spots.texel), np.bool_)
        inside[survey.visible[choice.place][survey.inside[choice.place][choice.look]]] = True
        for i, target in enumerate(survey.targets):
            view = self.view(i, choice.place, choice.exposure, inside[target.own])
            if view:
                self.products[i].add(*view)
                self.before[i] = self._outlook(i)


def choose(survey: Survey, count: int) -> list[Choice]:
    """At most ``count`` photographs, in the order of what each adds to those before it."""
    state, chosen = _State(survey), []
    for _ in range(count):
        best = _best(state)
        if best is None or best.worth < _LEAST:
            break
        state.take(best)
        chosen.append(best)
    return chosen


def _best(state: _State) -> Choice | None:
    survey, bounds = state.survey, state.bounds()
    at_most = np.zeros((len(survey.places), len(survey.looks), len(survey.exposures)))
    for place, (visible, inside) in enumerate(zip(survey.visible, survey.inside, strict=True)):
        surface = visible < survey.of_surface
        for e, exposure in enumerate(survey.exposures):
            worth = state.worth_of_surface(visible[surface], exposure)
            at_most[place, :, e] = inside[:, surface] @ worth
        for i, target in enumerate(survey.targets):
            if bounds[place, i] > 0:
                own = (visible >= target.own.start) & (visible < target.own.stop)
                shown = inside[:, own].sum(axis=1) >= _FEWEST
                at_most[place] += bounds[place, i] * shown[:, None]
    best: Choice | None = None
    # Of equals the first.
    for number in np.argsort(-at_most, axis=None, kind="stable"):
        place, look, e = (int(k) for k in np.unravel_index(number, at_most.shape))
        if best is not None and at_most[place, look, e] <= best.worth:
            break
        found = state.weighed(place, look, survey.exposures[e])
        if best is None or found.worth > best.worth:
            best = found
    return best
