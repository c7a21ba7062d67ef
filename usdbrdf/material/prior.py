"""What to assume of a surface whose highlights nobody saw: common values of its class.

These are no measurements and are never labelled as such. phi is GGX's alpha (roughness squared),
psi 0.5 is an index of refraction of 1.5.
"""

from __future__ import annotations

# How far objects of one class lie apart, as a standard deviation.
PRIOR_ERROR = 0.25
NEUTRAL = (0.5, 0.5)
_OF_WORD: dict[str, tuple[float, float]] = {
    # Matte paint and plaster.
    "ceiling": (0.8, 0.2), "wall": (0.6, 0.3), "column": (0.6, 0.3),
    # Fabric and fibres.
    "sofa": (0.9, 0.1), "couch": (0.9, 0.1), "cushion": (0.9, 0.1), "pillow": (0.9, 0.1),
    "curtain": (0.9, 0.1), "bed": (0.9, 0.1), "carpet": (0.9, 0.1), "rug": (0.9, 0.1),
    "fabric": (0.9, 0.1), "towel": (0.9, 0.1), "cloth": (0.9, 0.1), "armchair": (0.9, 0.1),
    "paper": (0.7, 0.3), "book": (0.5, 0.4), "cardboard": (0.8, 0.2),
    # Varnished or coated boards.
    "table": (0.3, 0.5), "desk": (0.3, 0.5), "cabinet": (0.3, 0.5), "shelf": (0.3, 0.5),
    "door": (0.3, 0.5), "wood": (0.3, 0.5), "floor": (0.3, 0.5), "chair": (0.4, 0.5),
    # Glass, screens, glazed ware.
    "screen": (0.02, 0.5), "tv": (0.02, 0.5), "monitor": (0.02, 0.5), "window": (0.01, 0.5),
    "glass": (0.01, 0.5), "mirror": (0.01, 1.0), "vase": (0.1, 0.5), "ceramic": (0.1, 0.5),
}  # fmt: skip


def class_prior(class_name: str, label: str) -> tuple[float, float]:
    """(phi, psi) for an object's class, else for its name, else a neutral dielectric."""
    for text in (class_name, label):
        words = text.lower().replace("-", "_").replace(" ", "_").split("_")
        for word in reversed(words):
            if word in _OF_WORD:
                return _OF_WORD[word]
    return NEUTRAL


def with_prior(
    value: float, error: float, prior: float, nothing_known: float
) -> tuple[float, float]:
    """(value, error) of a number in [0, 1] estimated as ``value`` with a standard deviation of
    ``error``, together with its prior. An error of ``nothing_known`` leaves the prior alone."""
    precision = max(1 / max(error, 1e-3) ** 2 - 1 / nothing_known**2, 0.0)
    of_prior = 1 / PRIOR_ERROR**2
    mean = (precision * value + of_prior * prior) / (precision + of_prior)
    return mean, (precision + of_prior) ** -0.5
