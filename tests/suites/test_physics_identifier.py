"""Physics of a body are identified by what no action explains."""

import pytest
import torch
from furuta.identifier import PhysicsIdentifier
from harness import refused
from tensordict import TensorDict

from afm_rl.dynamics import Dubins, MuJoCoDynamics
from afm_rl.learning import GaussianNLLLoss
from afm_rl.missions import run
from afm_rl.missions.run import Stopped
from afm_rl.regimes import Physics

pytest.importorskip("mujoco")
POLE = """<mujoco><option timestep="0.01"/><worldbody>
<body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
  <body name="pole"><joint name="turns" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 1" size=".01" mass=".2"/>
</body></body></worldbody>
<actuator><motor joint="x" ctrlrange="-10 10" gear="10"/></actuator></mujoco>"""
LENGTHS = {"length": [0.5, 1.5]}


def updater_of(missions=3, **settings):
    model = MuJoCoDynamics(POLE, frame_skip=4, noise_std=1e-3)
    model.expand_(missions)
    settings = {"ranges": LENGTHS, "scale": [10.0], "count": 11, **settings}
    updater = PhysicsIdentifier(GaussianNLLLoss(model), **settings)
    updater.start(TensorDict({}, [missions]))
    return updater


def drive(updater, rows, gains, steps=8):
    """Push poles whose physics and motors are not nominal."""
    state = torch.tensor([0.0, 0.2, 0.0, 0.0]).repeat(len(rows), 1)
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        action = 10 * torch.rand(len(rows), 1, generator=generator) - 5
        with updater.model.assuming(rows):
            after = updater.model(state, gains.unsqueeze(-1) * action)
        td = TensorDict({"observation": state, "action": action}, [len(rows)])
        updater(td.set(("next", "observation"), after))
        state = after


def physics(**values):
    return Physics().encode(values)


def test_lengths_are_found_whatever_the_motors_do():
    updater = updater_of()
    rows = torch.stack([physics(length=0.7), physics(length=1.4), physics()])
    drive(updater, rows, torch.tensor([1.0, -1.0, 0.3]))
    torch.testing.assert_close(updater.physics["length"], torch.tensor([0.7, 1.4, 1.0]))
    torch.testing.assert_close(updater.model.physics_now, rows)
    updater.start(TensorDict({}, [3]))
    assert torch.equal(updater.physics["length"], torch.ones(3))


def test_a_nominal_body_with_other_motors_stays_nominal():
    updater = updater_of(ranges={"length": [0.55, 1.5], "gravity": [0.5, 1.4]})
    drive(updater, physics().repeat(3, 1), torch.tensor([-1.0, 0.2, 2.0]))
    assert torch.equal(updater.model.physics_now, physics().repeat(3, 1))
    assert not updater.memory["misfit"].any()  # nothing had to be judged


def test_a_change_is_followed_and_missions_that_end_leave():
    updater = updater_of(2)
    short, long = physics(length=0.6), physics(length=1.3)
    drive(updater, torch.stack([short, long]), torch.ones(2))
    updater.model.select_(torch.tensor([1]))
    drive(updater, short.unsqueeze(0), -torch.ones(1), steps=20)
    torch.testing.assert_close(updater.physics["length"], torch.tensor([0.6]))


def test_bad_readings_teach_nothing():
    updater = updater_of()
    drive(updater, physics(length=1.3).repeat(3, 1), torch.ones(3), steps=1)
    updater.refused = 0
    state = torch.zeros(3, 4)
    td = TensorDict({"observation": state, "action": torch.zeros(3, 1)}, [3])
    before = updater.memory.clone()
    updater(td.set(("next", "observation"), state * torch.nan))
    assert updater.refused == 3
    assert all(torch.equal(updater.memory[name], before[name]) for name in ("misfit", "chosen"))


def test_other_legs_are_identified_behind_reversed_motors(agent_of, tmp_path):
    flipped = "{" + "".join(f"gain_{axis}: -1, " for axis in range(6)) + "length: %s}"
    regimes = f"regimes=[{flipped % 0.8}, {flipped % 1.3}, {{}}]"
    planner = ["planner.candidates=8", "planner.elites=3", "planner.iterations=1"]
    fast = [*planner, "updater.count=13"]
    few = [
        "robot=half_cheetah",
        "robot.physics={length:[0.4,1.6]}",
        "robot.steps=10",
        "method=afm_sysid",
        *fast,
        regimes,
    ]
    agent = agent_of("furuta", *few)
    with pytest.raises(Stopped):
        run(agent, checkpoint=tmp_path, stopped=lambda loop: loop.step == 8)
    found = agent.updater.physics["length"]
    torch.testing.assert_close(found, torch.tensor([0.8, 1.3, 1.0]))
    assert found[2] == 1.0  # healthy, to the bit
    resumed, whole = (run(agent_of("furuta", *few), checkpoint=path) for path in (tmp_path, None))
    assert resumed.steps.equals(whole.steps)


def identify(ranges=LENGTHS, scale=(1.0,), model=None, **settings):
    loss = GaussianNLLLoss(model or MuJoCoDynamics(POLE))
    return PhysicsIdentifier(loss, ranges, scale, **{"count": 11, **settings})


@refused(
    (lambda: identify(model=Dubins()), "needs a model with physics, got Dubins"),
    (lambda: identify({}), "expected what may differ about the body"),
    (lambda: identify({"colour": [0, 1]}), "names are mass"),
    (lambda: identify({"length": [1.0]}), r"length=\[1.0\]: expected \[low, high\]"),
    (lambda: identify({"length": [2.0, 1.0]}), "length: high=1.0"),
    (lambda: identify({"length": [1, 2], "mass": [1, 2]}, count=40), "1600 combinations"),
    (lambda: identify(scale=[1.0, 2.0]), "expected 1 positive numbers"),
)
def test_it_is_refused(make):
    make()
