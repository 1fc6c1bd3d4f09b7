"""The page: the scene, what can be changed, and what is known."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import numpy as np
from viser import uplot

from afm_rl.play.scene import COLOURS, figure_of
from afm_rl.play.server import LocalServer
from afm_rl.play.world import SIDES, World
from afm_rl.regimes import presets

FRAME = 0.04  # seconds between two pictures
MANY = 9  # actuators
PLOT: Any = {"aspect": 2.0, "scales": {"x": uplot.Scale(time=False)}}
STROKES = {name: f"rgb{colour}" for name, colour in COLOURS.items()}


def text_of(world: World) -> str:
    """Return rewards and falls of both robots, and the belief, as Markdown."""
    sides, score = [world.sides[name] for name in SIDES], world.robot.score
    table = {"": SIDES, "---": ["---"] * 2, "falls": [side.falls for side in sides]}
    table["reward a step"] = [f"{mean(side.rewards):.2f}" for side in sides]
    if score != "reward":
        table[score] = [side.info.get(score, "") for side in sides]
    rows = ["| " + " | ".join(map(str, (name, *row))) + " |" for name, row in table.items()]
    afm, late = sides[1].info["afm"], world.fault.get("delay", 0)
    state = "**corrects**" if afm["corrected"] else "does nothing"
    lines = [f"AFM {state}; innovation {afm['innovation']:.3g}"]
    if f"{late:.0f} steps late" not in afm["belief"] and late > 1:
        lines.append(f"AFM cannot identify a delay of {late:.0f} steps")
    belief = believed(world.robot.names, afm["belief"], afm["noise"])
    return "\n".join([*rows, "", "  \n".join(lines), "", *belief])


def faults_of(world: World) -> str:
    """Return the diagnosis of the faulty actuators."""
    words = str(world.sides["with AFM"].env.diagnosis)
    for k, name in enumerate(world.robot.names):
        words = words.replace(f"actuator {k}:", f"{name}:").replace(f"a_{k}:", f"{name}:")
    return "  \n".join(line for line in words.splitlines() if ": healthy" not in line)


def believed(names: list[str], belief: dict[str, np.ndarray], noise: np.ndarray) -> list[str]:
    """Return a table of the most probable cause of each actuator, and of the mean belief.

    If there are many actuators, the table has only those that have changed.

    >>> believed(["joint"], {"1 step late": np.array([0.97])}, np.array([0.05]))[-1]
    '| joint | 1 step late | 97 | 0.05 |'
    """
    chances = np.stack(list(belief.values()))  # of causes and actuators
    if len(names) > 1:
        names, chances = [*names, "*mean*"], np.c_[chances, chances.mean(1)]
        noise = np.append(noise, noise.mean())
    rows = ["| actuator | belief | % | noise |", "|---|---|---|---|"]
    for name, chance, spread in zip(names, chances.T, noise, strict=True):
        cause = list(belief)[chance.argmax()]
        if len(names) > MANY and cause == list(belief)[0] and name != "*mean*":
            continue
        rows.append(f"| {name} | {cause} | {100 * chance.max():.0f} | {spread:.2g} |")
    return rows


def mean(values: Any) -> float:
    """Return the mean of the newest 50 values."""
    newest = list(values)[-50:]
    return sum(newest) / max(len(newest), 1)


class Page:
    """A page in the browser for a world, on 127.0.0.1 only."""

    def __init__(self, world: World, title: str, port: int) -> None:
        self.world, self.ended = world, False
        with redirect_stdout(io.StringIO()):  # the command says where the page is
            self.server = LocalServer(port, title)
        self.url = f"http://127.0.0.1:{self.server.get_port()}"
        look: Any = {"control_width": "large", "show_logo": False, "show_share_button": False}
        self.server.gui.configure_theme(**look)
        self.server.scene.set_up_direction("+z")
        near = 1.0 if world.robot.home is None else 0.6
        self.server.initial_camera.position = near * np.array([1.6, -6.5, 3.0])
        self.server.initial_camera.look_at = near * np.array([1.6, 0.0, 0.0])  # left of controls
        sides = world.sides.items()
        self.figures = {name: figure_of(self.server, name, side.inner) for name, side in sides}
        self.labels = {
            name: self.server.scene.add_label(f"/label/{name}", name, anchor="bottom-center")
            for name in self.figures
        }
        self.sliders: dict[str, Any] = {}
        self.buttons: list[tuple[Any, Callable[[], None]]] = []
        self._controls()
        self._live()
        inputs: list[Any] = [self.choice, self.speed, self.pause, self.shown]
        inputs += [handle for handle, _ in (*self.buttons, *self.sliders.values())]
        self.server.inputs.update({handle._impl.uuid: handle for handle in inputs})

    def _controls(self) -> None:
        gui, names = self.server.gui, self.world.robot.names
        bias = "Bias" if self.world.robot.home is None else "Offset (rad)"
        self.presets = self.world.robot.faults or presets(len(names))
        self.choice = gui.add_dropdown("What fails", list(self.presets), order=-2.0)
        self.chosen = self.choice.value
        with gui.add_folder("Run"):
            self.speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
            self.pause = gui.add_checkbox("Pause", False)
            self.buttons.append((gui.add_button("Push"), self.world.push))
            self.buttons.append((gui.add_button("Reset"), self.world.reset))
        with gui.add_folder("All actuators"):
            self._slider("delay", "Late by (steps)", 0.0, 10.0, 1.0, 0.0)
            self._slider("lag", "Slow (steps)", 0.0, 6.0, 0.5, 0.0)
            self._slider("noise", "Noise", 0.0, 0.5, 0.05, 0.0)
        for k, name in enumerate(names):
            with gui.add_folder(name, expand_by_default=k == 0):
                self._slider(f"gain_{k}", "Gain", -1.5, 1.5, 0.1, 1.0)
                self._slider(f"bias_{k}", bias, -0.5, 0.5, 0.05, 0.0)
                self._slider(f"loss_{k}", "Lost share", 0.0, 1.0, 0.1, 0.0)

    def _slider(
        self, name: str, label: str, low: float, high: float, step: float, usual: float
    ) -> None:
        self.sliders[name] = self.server.gui.add_slider(label, low, high, step, usual), usual

    def read(self) -> None:
        """Take the faults from the preset and the sliders, and do what was clicked."""
        if self.choice.value != self.chosen:
            self.chosen = self.choice.value
            values = self.presets[self.chosen]
            for name, (slider, usual) in self.sliders.items():
                slider.value = values.get(name, usual)
        # A preset may have more than there are sliders for, such as which command goes where.
        sliders = {name: slider.value for name, (slider, _) in self.sliders.items()}
        self.world.fail({**self.presets[self.chosen], **sliders})
        for button, action in self.buttons:
            if button._impl.uuid in self.server.clicked:
                self.server.clicked.discard(button._impl.uuid)
                action()

    def _live(self) -> None:
        gui, empty = self.server.gui, np.zeros(2)
        with gui.add_folder("Now", order=-1.0):
            self.words = gui.add_markdown("")
            lines = [uplot.Series(label=name, stroke=STROKES[name], width=2) for name in SIDES]
            series = (uplot.Series(label="step"), *lines)
            self.rewards = gui.add_uplot((empty,) * 3, series, title="Reward", **PLOT)
            self.faults = gui.add_markdown("")
        with gui.add_folder("Commands of AFM", order=100.0):
            self.shown = gui.add_dropdown("Actuator", self.world.robot.names)
            looks = {
                "planned": "gray",
                "executed": STROKES["with AFM"],
                "effect": STROKES["without AFM"],
            }
            lines = [uplot.Series(label=name, stroke=x, width=2) for name, x in looks.items()]
            series, data = (uplot.Series(label="step"), *lines), (empty,) * 4
            self.commands = gui.add_uplot(data, series, title="Command", **PLOT)

    def end(self) -> None:
        """End the page, and :meth:`run`."""
        if self.ended:
            return
        self.ended = True
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def run(self) -> None:
        """Let the world go on and draw it, until :meth:`end` or an interrupt."""
        worded = done = time.monotonic()  # up to when the world has been simulated
        while not self.ended:
            self.read()
            now = time.monotonic()
            step = self.world.robot.dt / self.speed.value
            done = now if self.pause.value else max(done, now - FRAME - step)
            last = now
            while not self.pause.value and done + step <= now:
                self.world.step()
                done, before, last = done + step, last, time.monotonic()
                if 2 * last - before > now + FRAME:  # no time for another one: slower than life
                    break
            self.draw()
            if now > worded:
                self.say()
                worded = now + max(0.25, 10 * (time.monotonic() - now))  # a diagnosis takes time
            time.sleep(max(0.0, now + FRAME - time.monotonic()))

    def draw(self) -> None:
        """Draw both robots."""
        with self.world.lock, self.server.atomic():
            for name, figure in self.figures.items():
                figure.draw()
                self.labels[name].position = figure.label

    def say(self) -> None:
        """Renew words and curves."""
        with self.world.lock:
            self.words.content, self.faults.content = text_of(self.world), faults_of(self.world)
            rewards = [np.array(side.rewards) for side in self.world.sides.values()]
            commands = np.array(self.world.sides["with AFM"].commands)
        size = min(map(len, rewards))
        if size > 1:
            steps = np.arange(size, dtype=float)
            self.rewards.data = (steps, *(line[-size:] for line in rewards))
        if len(commands) > 1:
            one = commands[..., self.world.robot.names.index(self.shown.value)].T
            self.commands.data = (np.arange(len(commands), dtype=float), *one.astype(float))
