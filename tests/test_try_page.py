"""The page of the site on which robots run, in a real browser."""

import shutil
from pathlib import Path

import pytest
from pages import DOCS

LONG = 100_000  # ms, for slow machines


@pytest.fixture
def browser(monkeypatch):
    """What makes the scripts of the page."""
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    import browser

    return browser


@pytest.fixture
def opened(chromium, tmp_path):
    """Open the page as a file, with scripts that were built; return what it asked for, too."""
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
    """The page with two HalfCheetahs, which move when they are told to."""
    scripts = [browser.BUILT / f"{name}.js" for name in browser.SCRIPTS]
    if not all(script.is_file() for script in scripts):
        pytest.skip("no scripts of the page: make docs makes them")
    page, asked = opened(scripts)
    page.locator("#try[data-robot=half_cheetah]").wait_for()
    return page, asked


def advance(page, steps):
    """Return what becomes of the robots, the one alone and the one with AFM."""
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
def test_the_page_simulates_as_mujoco_does_here(browser, running):
    mujoco = pytest.importorskip("mujoco")
    assets = pytest.importorskip("gymnasium.envs.mujoco.mujoco_env").__file__
    page, _ = running
    for name, (file, _) in browser.ROBOTS.items():
        page.locator("#try select").first.select_option(name)
        page.locator(f"#try[data-robot={name}]").wait_for()
        model = mujoco.MjModel.from_xml_path(str(Path(assets).parent / "assets" / file))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        for _ in range(10):
            robot, _ = advance(page, 1)
            data.ctrl = robot["sent"]
            mujoco.mj_step(model, data, nstep=4 if name == "walker2d" else 5)
            assert data.qpos == pytest.approx(robot["state"]["position"], abs=1e-9)


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
