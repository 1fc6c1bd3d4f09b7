"""The try page of the site, in a real browser."""

import io
import re
import shutil

import numpy as np
import pytest
from pages import DOCS, ROOT
from PIL import Image

LONG = 100_000  # ms, for slow machines
ROBOTS = {"half_cheetah": "HalfCheetah", "ant": "Ant", "walker2d": "Walker2d"}


@pytest.fixture
def browser(monkeypatch):
    """Return the module that makes the scripts of the page."""
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    import browser

    return browser


@pytest.fixture
def opened(chromium, tmp_path):
    """Open the page as a file with the given scripts; return it and the addresses it requests."""
    page, asked = chromium.new_page(), []
    page.set_default_timeout(LONG)
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: asked.append(str(error)))
    shutil.copytree(DOCS / "theme" / "try", tmp_path / "theme" / "try")
    _, _, content = (DOCS / "try.md").read_text().split("---\n", 2)
    (tmp_path / "try.html").write_text("<!doctype html><meta charset=utf-8>" + content)

    def start(scripts=()):
        for script in scripts:
            shutil.copy(script, tmp_path / "theme" / "try")
        page.goto(f"file://{tmp_path}/try.html?still")
        page.get_by_text("Start", exact=True).click()
        return page, asked

    return start


@pytest.fixture
def running(browser, opened):
    """Return the page with two HalfCheetahs, which move when a test advances them."""
    scripts = [browser.BUILT / f"{name}.js" for name in browser.SCRIPTS]
    if not all(script.is_file() for script in scripts):
        pytest.skip("no scripts of the page: make docs makes them")
    page, asked = opened(scripts)
    page.locator("#try[data-robot=half_cheetah]").wait_for()
    return page, asked


def advance(page, steps):
    """Advance the robots; return their states, first without AFM, then with AFM."""
    return page.locator("#try").evaluate(f"robots => robots.advance({steps})")


@pytest.mark.slow  # 120 steps
def test_a_reversed_joint_stalls_one_robot_and_the_other_runs_on(running):
    page, asked = running
    alone, corrected = advance(page, 50)
    assert alone["state"] == corrected["state"]  # while it is healthy, plans are executed
    page.get_by_text("Reverse a joint").click()
    alone, corrected = advance(page, 70)
    assert alone["speed"] < 1 < 8 < corrected["speed"]  # m/s
    words = page.locator("#try .words").all_text_contents()
    assert words.count("gain -1") == 1 and words[3] == "gain -1"
    assert all(url.startswith(("file:", "blob:")) for url in asked)  # nothing from elsewhere


@pytest.mark.slow
def test_robots_move_and_are_rewarded_as_in_gymnasium(running):
    mujoco = pytest.importorskip("mujoco")
    gymnasium = pytest.importorskip("gymnasium")
    page, _ = running
    for name, title in ROBOTS.items():
        page.locator("#try select").first.select_option(name)
        page.locator(f"#try[data-robot={name}]").wait_for()
        env, total = gymnasium.make(f"{title}-v5").unwrapped, 0.0
        mujoco.mj_resetData(env.model, env.data)
        mujoco.mj_forward(env.model, env.data)
        for _ in range(10):
            robot, _ = advance(page, 1)
            _, reward, *_, info = env.step(np.array(robot["sent"]))
            total += reward - info.get("reward_contact", 0.0)
            assert env.data.qpos == pytest.approx(robot["state"]["position"], abs=1e-9)
            assert total == pytest.approx(robot["total"], abs=1e-6)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the page with the theme of the site, and return its path."""
    pytest.importorskip("material")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    docs, out = tmp_path_factory.mktemp("docs"), tmp_path_factory.mktemp("site")
    for name in ("try.md", "theme/extra.css", "theme/try", "images/try.webp"):
        (docs / name).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (DOCS / name).is_dir() else shutil.copy
        copy(DOCS / name, docs / name)
    only = {"docs_dir": str(docs), "site_dir": str(out), "nav": ["try.md"], "hooks": []}
    build(load_config(str(ROOT / "mkdocs.yml"), plugins=["search"], **only))
    return out / "try.html"


@pytest.mark.slow  # three robots at two sizes
@pytest.mark.parametrize("size", [(1280, 720), (390, 844)], ids=str)
def test_robots_faults_and_returns_are_visible_without_scrolling(browser, chromium, site, size):
    scripts = [browser.BUILT / f"{name}.js" for name in browser.SCRIPTS]
    if not all(script.is_file() for script in scripts):
        pytest.skip("no scripts of the page: make docs makes them")
    for script in scripts:
        shutil.copy(script, site.parent / "theme" / "try")
    page = chromium.new_page(viewport=dict(zip(("width", "height"), size, strict=True)))
    page.set_default_timeout(LONG)
    page.goto(f"{site.as_uri()}?still")
    assert inside(page, "#try button, #try img", size) == 2
    page.get_by_text("Start", exact=True).click()
    for name in ROBOTS:
        page.locator("#try select").first.select_option(name)
        page.locator(f"#try[data-robot={name}]").wait_for()
        advance(page, 1)
        joints = page.locator("#try .joints > div").count()
        assert inside(page, "#try .joints > div, #try .joints input", size) == 2 * joints >= 12
        assert inside(page, "#try .menu select, #try .menu input", size) == 3
        assert inside(page, "#try .presets button", size) == 6
        assert inside(page, "#try canvas, #try figcaption", size) == 4
        for caption in page.locator("#try figcaption").all_text_contents():
            assert re.fullmatch(r"with(out)? AFM: return -?\d+, -?\d+\.\d m/s", caption)
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), int)
        for colour in ([0xD5, 0x5E, 0x00], [0x00, 0x72, 0xB2]):  # of the two robots
            hue = picture @ colour / np.linalg.norm(colour)
            alike = hue > 0.97 * np.linalg.norm(picture, axis=-1)
            assert (alike & (hue > 60)).sum() > 300
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]


def inside(page, selector, size):
    """Return how many elements are shown, all of which must be within the window."""
    boxes = [element.bounding_box() for element in page.locator(selector).all()]
    shown = [box for box in boxes if box is not None]
    for box in shown:
        assert box["x"] >= 0 and box["x"] + box["width"] <= size[0]
        assert box["y"] >= 0 and box["y"] + box["height"] <= size[1]
    return len(shown)


def test_without_the_scripts_the_page_says_so(opened):
    page, _ = opened()
    page.get_by_text("this site was built without mujoco").wait_for()


def test_what_is_missing_or_another_package_is_said(browser, monkeypatch, tmp_path):
    monkeypatch.setattr(browser, "BUILT", tmp_path)
    with pytest.raises(ValueError, match=r"package\.tgz is missing"):
        browser.files_of("package.tgz", "", {})
    (tmp_path / "package.tgz").write_bytes(b"")
    with pytest.raises(ValueError, match="another checksum"):
        browser.files_of("package.tgz", "", {})
