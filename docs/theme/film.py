"""Film the try page: two HalfCheetahs, one motor of which is reversed.

make docs && python docs/theme/film.py

It needs Chromium, and the extra `test`. Each step of the policy is a picture, so the film runs in
real time. The first line of a picture states robot, time and fault, the last one the methods.
"""

import io
import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from afm_rl.storage.files import write_whole

ROOT = Path(__file__).resolve().parents[2]
PAGE, FILM = ROOT / "site" / "try.html", ROOT / "docs" / "images" / "try.webp"
SIZE = {"width": 860, "height": 700}
STEP = 50  # ms
AT, STEPS = 50, 140
HIDDEN = "#try :is(.menu, .presets, .joints, .legend) { display: none; } #try p { margin: 0; }"
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def pictures(page):
    """Return a picture of each step."""
    said, robots = page.locator("#try .said"), page.locator("#try")
    fault = "no fault"
    for step in range(STEPS):
        if step == AT:
            page.get_by_text("Reverse a joint").dispatch_event("click")
            fault = "the motor of the front thigh is reversed"
        caption = f"HalfCheetah, {step * STEP / 1000:.1f} s: {fault}"
        said.evaluate("(said, caption) => (said.textContent = caption)", caption)
        robots.evaluate("robots => robots.advance(1)")
        yield Image.open(io.BytesIO(robots.screenshot())).convert("RGB")


def main():
    """Write the film."""
    path = shutil.which("chromium") or shutil.which("chrome")
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(600_000)
        page.goto(f"{PAGE.as_uri()}?still")
        page.add_style_tag(content=HIDDEN)
        page.get_by_text("Start", exact=True).click()
        page.locator("#try[data-robot]").wait_for()
        first, *others = pictures(page)
        browser.close()
    film, settings = io.BytesIO(), {"duration": STEP, "loop": 0, "quality": 55, "method": 4}
    first.save(film, "webp", save_all=True, append_images=others, **settings)
    write_whole(FILM, film.getvalue())
    print(f"wrote {FILM}, {len(film.getvalue()):,} bytes")


if __name__ == "__main__":
    main()
