"""One colour for each method, in all figures, films and pages.

They are the colours of Okabe and Ito, which colour-blind readers can distinguish, and a brown.
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
    ("without AFM", "no correction", "uncorrected", "as commanded", "physics", "TVLQR"),
    ("oracle", "exact model"),
    ("least squares", "affine least squares", "online_pe"),
    ("L1", "l1", "adaptive_gain"),
    ("afm_online_pe", "afm_paper", "as published"),
    ("frozen_pe",),
    ("afm_frozen_pe",),
)
"""The methods that have each of these colours, by their names in figures."""


SHARED = 3  # the first colours belong to the methods that most figures compare


def places_of(methods: Iterable[str]) -> dict[str, int]:
    """Return the index of the colour of each method; two methods share one only if all are used.

    >>> places_of(["mine", "physics", "online_pe", "afm_physics", "least squares"])
    {'mine': 4, 'physics': 1, 'online_pe': 3, 'afm_physics': 0, 'least squares': 5}
    """
    names = list(dict.fromkeys(methods))
    usual_places = {name: place for place, named in enumerate(METHODS) for name in named}
    found: dict[str, int] = {}
    for name in names:
        if name in usual_places and usual_places[name] not in found.values():
            found[name] = usual_places[name]
    every = [*range(SHARED, len(COLOURS)), *range(SHARED)]
    places = [place for place in every if place not in found.values()]
    places += every * len(names)  # with more methods than colours, colours repeat
    found |= dict(zip((name for name in names if name not in found), places, strict=False))
    return {name: found[name] for name in names}


def colour_of(method: str) -> str:
    """Return the colour of a method in a figure without other methods.

    >>> colour_of("AFM") == colour_of("afm_physics") != colour_of("without AFM")
    True
    """
    return COLOURS[places_of([method])[method]]
