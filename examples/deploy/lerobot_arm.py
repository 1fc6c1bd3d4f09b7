"""Correct the commands of a LeRobot robot, between ``send_action`` and its motors.

    python examples/deploy/lerobot_arm.py arm.onnx   # where afm-rl is; prints its SHA-256

    arm = make_robot_from_config(config)                 # where LeRobot is
    arm = CorrectedRobot(arm, load("arm.onnx", SHA256))  # of agent.py

LeRobot needs another torch than this library, so the two meet in a file, which needs onnxruntime
and NumPy alone. Everything else of the robot stays as it is. The model is a servo of first order,
q <- q + k (u - q), for joints q and goals u in LeRobot's units (-100 to 100, or degrees).

Never run on an arm: it was checked against the interface of LeRobot 0.4, with a simulated one. It
cannot see an offset that is in command and reading alike, as of a horn that was mounted again; and
what a policy takes to answer is a delay of the loop, not of the motors.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from typing import Any

from agent import Agent

JOINTS = [f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex")]
JOINTS += [f"{name}.pos" for name in ("wrist_flex", "wrist_roll", "gripper")]
LOW, HIGH = [-100.0] * 5 + [0.0], [100.0] * 6
CLIPPED = 0.5  # in the unit of a joint: a command that was changed by more was not obeyed


class CorrectedRobot:
    """A robot whose goals are corrected before they are sent.

    Args:
        robot: of LeRobot.
        agent: what ``load`` makes of the file: (state, planned action) -> action.
        joints: names of the joints, in the order of the agent's numbers.
        record: new file, ``.csv``, of each step: state, planned and sent goals. LeRobot's recorder
            drops what ``send_action`` returns, so that its data set has the planned ones alone.
    """

    def __init__(
        self, robot: Any, agent: Agent, joints: list[str] = JOINTS, record: str | None = None
    ) -> None:
        self.robot, self.agent, self.joints = robot, agent, joints
        self.record = open(record, "x", buffering=1) if record else None  # noqa: SIM115
        self._write(f"{kind}.{x}" for kind in ("state", "planned", "command") for x in joints)
        self.state: list[float] | None = None
        self.follows = False  # does the next state follow from an action of the agent?

    def __getattr__(self, name: str) -> Any:
        if name == "robot":  # not yet, as in a copy
            raise AttributeError(name)
        return getattr(self.robot, name)

    def __enter__(self) -> CorrectedRobot:
        self.robot.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.robot.disconnect()

    def get_observation(self) -> dict[str, Any]:
        """Return what the robot observes, and note its joints."""
        seen = self.robot.get_observation()
        self.state = [float(seen[name]) for name in self.joints]
        return seen

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send goals after which the joints go where ``action`` says; return what was sent.

        A command that the robot clips (``max_relative_target``) was not obeyed: the transition
        after it is not remembered, nor is one without an observation before it.
        """
        state, self.state = self.state, None
        planned = [float(action[name]) for name in self.joints]
        unseen = [math.nan] * len(planned)
        command = self.agent.act(state or unseen, planned, self.follows or state is None)
        sent = self.robot.send_action({**action, **dict(zip(self.joints, command, strict=True))})
        missed = [abs(sent[name] - u) for name, u in zip(self.joints, command, strict=True)]
        self.follows = state is not None and max(missed) < CLIPPED
        self._write([*(state or unseen), *planned, *(float(sent[name]) for name in self.joints)])
        return sent

    def _write(self, cells: Iterable[object]) -> None:
        if self.record:
            self.record.write(",".join(map(str, cells)) + "\n")


def correction(gain: float = 0.5, noise: float = 0.5) -> Any:
    """Return the correction for such an arm.

    Args:
        gain: k, share of the way to its goal that a joint makes in a step of the loop.
        noise: how far the model is trusted per step, in the unit of a joint.
    """
    import torch
    from torchrl.data import Bounded

    from afm_rl.dynamics import KnownDynamics
    from afm_rl.spaces.manifold import Manifold
    from afm_rl.transforms import ActionFlowPolicy
    from afm_rl.transforms.controller import Controller

    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    model = KnownDynamics(
        lambda q, u: q + gain * (u - q), Manifold(len(LOW)), len(LOW), noise, affine=True
    )
    spec = Bounded(low, high, shape=low.shape, dtype=low.dtype)
    return Controller(None, ActionFlowPolicy(model, spec))


if __name__ == "__main__":
    from afm_rl.transforms.controller import export_controller

    print(export_controller(correction(), sys.argv[1]))
