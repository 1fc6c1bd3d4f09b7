"""The page of the site on which an exported file drives a robot, in a real browser."""

import shutil

import pytest
import torch
from pages import DOCS
from torchrl.data import Bounded

from afm_rl.correction import LeastSquares
from afm_rl.dynamics import Dubins
from afm_rl.transforms import ActionFlowPolicy
from afm_rl.transforms.controller import Controller, export_controller

LONG = 60_000  # ms, for slow machines


@pytest.fixture
def browser(monkeypatch):
    """What makes the script of the page."""
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    import browser

    return browser


@pytest.fixture
def opened(chromium, tmp_path):
    """Open the page beside a script, as a file; return what it asked for, too."""
    (tmp_path / "theme").mkdir()
    shutil.copy(DOCS / "theme" / "try.js", tmp_path / "theme")
    (tmp_path / "try.html").write_text("<!doctype html>" + (DOCS / "try.md").read_text())
    asked = []

    def start(script=None):
        if script is not None:
            (tmp_path / "theme" / "try_runtime.js").write_text(script)
        page = chromium.new_page()
        page.set_default_timeout(LONG)
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: asked.append(str(error)))
        page.goto(f"file://{tmp_path}/try.html")
        page.get_by_text("Start", exact=True).click()
        return page, asked

    return start


def shown(page, robot=1, steps=0):
    """Return what the page says of one tick of a robot (1: with AFM), after further steps."""
    data = f"document.querySelectorAll('figcaption')[{robot}].dataset"
    page.wait_for_function(f"{data}.command")
    after = steps + int(page.evaluate(f"{data}.step"))
    page.wait_for_function(f"{data}.step >= {after}")
    said = page.evaluate(f"({{...{data}}})")
    return {name: [float(number) for number in said[name].split(",")] for name in said}


@pytest.mark.slow  # torch's exporter, and 50 steps of driving
def test_a_reversed_motor_is_corrected_in_the_browser(browser, opened, tmp_path):
    pytest.importorskip("onnx")
    if not browser.RUNTIME.is_file():
        pytest.skip("no onnxruntime-web: make docs brings it in")
    low, high = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])
    policy = ActionFlowPolicy(Dubins(), Bounded(low, high), LeastSquares(low, high))
    export_controller(Controller(None, policy), tmp_path / "policy.onnx")
    page, asked = opened(browser.script(tmp_path / "policy.onnx"))
    healthy = shown(page)
    assert healthy["command"] == pytest.approx(healthy["plan"], abs=1e-6)
    page.locator("input").nth(1).fill("-1")
    corrected, alone = shown(page, steps=50), shown(page, robot=0)
    assert corrected["command"][1] == pytest.approx(-corrected["plan"][1], abs=0.02)
    assert corrected["distance"][0] < 0.2 < alone["distance"][0]
    assert all(url.startswith(("file:", "blob:")) for url in asked)  # nothing from elsewhere


def test_without_the_runtime_the_page_says_so(opened):
    page, _ = opened()
    page.get_by_text("this site was built without onnxruntime-web").wait_for()


def test_what_is_missing_or_another_package_is_said(browser, tmp_path):
    policy, package = tmp_path / "policy.onnx", tmp_path / "package.tgz"
    policy.touch()
    with pytest.raises(ValueError, match=r"package\.tgz is missing"):
        browser.script(policy, package)
    package.write_bytes(b"")
    with pytest.raises(ValueError, match="another checksum"):
        browser.script(policy, package)
