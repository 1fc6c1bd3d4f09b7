"""A method has one colour, in figures, in films, on the page to play with and on the site."""

import re
from pathlib import Path

import numpy as np

from afm_rl.film import frames
from afm_rl.method_colours import COLOURS, METHODS, colour_of
from afm_rl.report.scenes import map_scene
from afm_rl.report.style import method_styles

ROOT = Path(__file__).resolve().parents[2]
COMPARED = ["physics", "online_pe", "afm_physics", "oracle"]  # by the demo


def test_a_method_has_the_same_colour_whatever_else_is_in_the_figure():
    for names in (COMPARED, COMPARED[::-1], COMPARED[2:], ["mine", *COMPARED[1:]]):
        looks = method_styles(names)
        own = {name: look.color for name, look in looks.items() if name != "mine"}
        assert own == {name: colour_of(name) for name in own}
        assert len({look.color for look in looks.values()}) == len(names)
        assert len({look.marker for look in looks.values()}) == len(names)


def test_names_of_one_method_share_a_colour_and_no_other_has_it():
    assert len(METHODS) == len(COLOURS) == len(set(COLOURS))
    assert len({name for names in METHODS for name in names}) == sum(map(len, METHODS))


def test_methods_beyond_the_colours_get_one_too():
    assert {look.color for look in method_styles(map(str, range(11))).values()} == set(COLOURS)


def test_colours_are_written_once():
    """Those of AFM and of robots without it; the site has them as variables."""
    pair = [colour_of("without AFM"), colour_of("with AFM")]
    style = (ROOT / "docs" / "theme" / "extra.css").read_text()
    assert re.findall(r"--(?:without|with)-afm: (#\w+);", style) == pair


def test_in_a_film_afm_is_on_top_of_the_oracle_that_it_equals(make_results):
    _, steps = make_results(methods=("oracle",))
    steps = steps.iloc[:60]
    scene = map_scene("both", {"afm_physics": steps, "oracle": steps.copy()})
    *_, last = frames(scene, [0, len(steps) - 1])
    seen = {
        name: int(np.all(last == [*bytes.fromhex(colour_of(name)[1:])], -1).sum())
        for name in ("afm_physics", "oracle")
    }
    assert min(seen.values()) > 50  # the oracle shows on both sides of it
