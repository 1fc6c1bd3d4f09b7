"""One colour for each method, in all figures, films and pages.

They are those of Okabe and Ito, which colour-blind readers can tell apart, and a brown.
"""

from collections.abc import Iterable

COLOURS = (
    "#0072b2",  # blue
    "#d55e00",  # vermilion
    "#000000",  # black
    "#009e73",  # green
    "#cc79a7",  # purple
    "#56b4e9",  # sky blue
    "#e69f00",  # orange
    "#8c510a",  # brown
)

METHODS = (
    ("AFM", "with AFM", "afm_physics", "ours", "TVLQR+AFM"),
    ("alone", "without AFM", "no correction", "uncorrected", "as commanded", "physics", "TVLQR"),
    ("oracle", "truth", "exact model"),
    ("least squares", "affine least squares", "online_pe"),
    ("L1", "l1", "adaptive_gain"),
    ("afm_online_pe", "afm_paper", "as published"),
    ("frozen_pe",),
    ("afm_frozen_pe",),
)
"""Whose each of these colours is, by the names that figures give to methods."""


SHARED = 3  # the first colours are those of what every figure compares


def places_of(methods: Iterable[str]) -> dict[str, int]:
    """Return the number of each method's colour, its own one unless another method has it.

    >>> places_of(["mine", "physics", "online_pe", "afm_physics", "least squares"])
    {'mine': 4, 'physics': 1, 'online_pe': 3, 'afm_physics': 0, 'least squares': 5}
    """
    names = list(dict.fromkeys(methods))
    own = {name: place for place, named in enumerate(METHODS) for name in named}
    found: dict[str, int] = {}
    for name in names:
        if name in own and own[name] not in found.values():
            found[name] = own[name]
    every = [*range(SHARED, len(COLOURS)), *range(SHARED)]
    places = [place for place in every if place not in found.values()]
    places += every * len(names)  # where there are too few, again
    found |= dict(zip((name for name in names if name not in found), places, strict=False))
    return {name: found[name] for name in names}


def colour_of(method: str) -> str:
    """Return the colour of a method in a figure of its own.

    >>> colour_of("AFM") == colour_of("afm_physics") != colour_of("alone")
    True
    """
    return COLOURS[places_of([method])[method]]
