"""The page in a real browser: a slider reverses a motor, and one robot of two falls."""

import re
import socket
import threading
import time
import warnings
from pathlib import Path

import pytest
from harness import until

from afm_rl.play import World, make_robot
from afm_rl.play.page import text_of

SMALL = str(Path(__file__).parents[2] / "benchmarks" / "suites" / "legged" / "robots" / "small")
LONG = 120_000  # ms, for slow machines


@pytest.fixture
def page_of():
    """Make the page of a robot."""
    pytest.importorskip("viser")
    from afm_rl.play.page import Page

    pages = []

    def make(name):
        pages.append(Page(World(make_robot(name)), name, 0))
        return pages[-1]

    yield make
    for page in pages:
        page.end()


@pytest.fixture
def served(page_of):
    """A page of carts with poles, which runs."""
    page = page_of("cart_pole")
    running = threading.Thread(target=page.run)
    running.start()
    yield page
    page.end()
    running.join()


def choose(page, preset):
    page.choice.value = preset
    page.read()


def opened(chromium, served, errors):
    """Open the page, and wait until its controls are there."""
    page = chromium.new_page(viewport={"width": 900, "height": 600})
    page.set_default_timeout(LONG)
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else 0)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(served.url)
    page.wait_for_selector("canvas")
    page.get_by_text("Push", exact=True).wait_for()
    return page


@pytest.mark.parametrize("name", ["pendulum", SMALL, "hopper", "ugv", "quadrotor"])
def test_robots_are_drawn_and_described(name, page_of):
    page = page_of(name)
    choose(page, "one reversed")
    for _ in range(20):
        page.world.step()
    page.draw()
    page.say()
    (gain,) = page.presets["one reversed"]
    effect, servo = page.world.sides["with AFM"].faulty.effect, int(gain[5:])
    assert page.world.fault[gain] == page.sliders[gain][0].value == -1.0
    executed = page.world.sides["with AFM"].info["afm"]["executed_action"]
    home = page.world.robot.home
    pose = 0.0 if home is None else float(home[servo])
    assert effect[servo] - pose == pytest.approx(pose - executed[servo], rel=1e-5)
    bias = page.sliders[f"bias_{servo}"][0].label
    assert bias == ("Bias" if home is None else "Offset (rad)")
    said = page.words.content
    assert "| without AFM | with AFM |" in said and re.search(r"\| (a recent change|slow) \|", said)
    for figure in page.figures.values():
        assert all(abs(number) < 1e3 for number in figure.root.position)
    choose(page, max(name for name in page.presets if name.startswith("late")))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what is observed at arrival is known of every robot
        for _ in range(20):
            page.world.step()
    assert "cannot identify" not in text_of(page.world)
    page.world.fail({"delay": 10.0})
    assert "cannot identify" in text_of(page.world)
    choose(page, "none")
    assert page.world.fault[gain] == 1.0


@pytest.mark.slow
def test_a_slider_reverses_a_motor(served, chromium):
    alone, corrected = served.world.sides.values()
    errors, gain = [], "xpath=//*[text()='Gain']/following::input[not(@type='hidden')][1]"
    page = opened(chromium, served, errors)
    assert alone.falls == 0
    page.locator(gain).fill("-1")
    page.locator(gain).press("Enter")
    until(lambda: served.world.fault.get("gain_0") == -1.0)
    page.get_by_text("Push", exact=True).click()
    until(lambda: alone.falls > 3 and corrected.steps > 100)
    assert corrected.falls <= 2  # at most while the reversal is not yet believed
    page.get_by_text("reversed").first.wait_for()
    page.close()  # ends nothing
    steps = corrected.steps
    page = opened(chromium, served, errors)  # another page of the same world
    until(lambda: page.locator(gain).input_value() == "-1" and corrected.steps > steps)
    assert not errors


def test_a_link_cannot_let_another_server_into_the_page(served, chromium):
    said = []
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"ws://127.0.0.1:{other.getsockname()[1]}"
        page = chromium.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.goto(f"{served.url}/?websocket={address}")  # which viser would obey
        end = time.monotonic() + LONG / 1000
        while not any(address in text for text in said):
            assert time.monotonic() < end
            page.wait_for_timeout(100)
        other.settimeout(2)
        with pytest.raises(TimeoutError):
            other.accept()
    framed = chromium.new_page()
    framed.on("console", lambda message: said.append(message.text))
    framed.set_content(f"<iframe src='{served.url}'></iframe>")
    while not any("frame-ancestors" in text for text in said):
        assert time.monotonic() < end
        framed.wait_for_timeout(100)
