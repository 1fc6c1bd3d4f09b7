"""Missions in other people's tasks, from settings to tables."""

import copy
import math
import re
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from harness import agent_of, composed, refused
from omegaconf import OmegaConf

from afm_rl.errors import ConfigurationError
from afm_rl.missions import build, prepare, run
from afm_rl.missions.collected import transitions
from afm_rl.missions.run import Stopped
from afm_rl.missions.scores import _measured
from afm_rl.progress import Bar

FLIP = "regimes=[{gain_0: -1}]"
SMALL = ["planner.candidates=16", "planner.elites=4", "planner.horizon=8"]
MODEL = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="0.1"/></body>
</worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
PENDULUM = ["robot=gymnasium", "robot.id=Pendulum-v1"]


@pytest.mark.slow
def test_a_reversal_is_undone_in_a_task_of_dm_control():
    pytest.importorskip("dm_control")
    reacher = ["robot=dm_control", "robot.domain=reacher", "robot.task=easy", "robot.steps=60"]
    flipped = ["regimes=[{gain_0: -1, gain_1: -1}]", "robot.schedule.at=[]", "seeds=[1]"]
    planner = ["planner.candidates=24", "planner.elites=6"]
    found = {
        method: run(agent_of(*reacher, *flipped, *planner, f"method={method}")).missions.iloc[0]
        for method in ("physics", "afm_physics", "oracle")
    }
    assert found["physics"]["after"] < 0.1
    assert found["afm_physics"]["after"] >= 0.9
    assert found["oracle"]["after"] >= 0.9
    assert math.isnan(found["oracle"]["before"])


def test_rewards_before_and_after_a_change():
    rewards = torch.tensor([1.0] * 100 + [0.0] * 30 + [1.0] * 70)
    assert _measured(rewards, 100) == [1.0, 0.0, 1.0, 28.0]
    assert _measured(rewards, 0)[1:3] == [1.0, pytest.approx(0.7)]
    assert math.isnan(_measured(0.0 * rewards + torch.arange(200) // -100, 100)[3])
    assert _measured(-rewards, 100)[3] == 0.0


def test_the_change_comes_when_the_schedule_says():
    small = [*PENDULUM, *SMALL, "robot.steps=30", FLIP, "method=physics"]
    for more, at in ((["robot.schedule.at=[0.5]"], 15), (["robot.schedule.at=[]"], 0)):
        agent = agent_of(*small, *more)
        results = run(agent)
        active = results.steps["regime_active"].tolist()
        assert active.index(1) == at
        assert agent.base_env.simulation.changes_at(agent.missions["mission"]).item() == at


@refused(
    (["robot=gymnasium", "robot.id=Nothing-v0"], "robot.id='Nothing-v0': .*doesn't exist"),
    (["robot=gymnasium", "robot.id=CartPole-v1"], "CartPole-v1: its action is discrete"),
    (["robot=gymnasium", "robot.id='this:Pendulum-v1'"], "robot.id='this': only"),
    (["robot=gymnasium", "robot.id=Swimmer-v5"], "robot.id=Swimmer-v5: its reward is not"),
    (["robot=dm_control", "robot.domain=nothing"], "robot.domain=nothing robot.task=hard: "),
    (["robot=mujoco"], "robot.xml: expected a setting"),
    (["robot=mujoco", "robot.xml=no.xml", "robot.reward=tests.x"], "robot.reward='tests.x': "),
    ([*PENDULUM, "robot.reward=os.getcwd"], "robot.reward='os.getcwd': only parts of afm_rl"),
    ([*PENDULUM, "tracks=ethz_2"], "tracks=.*: expected all, or Pendulum-v1"),
    ([*PENDULUM, "cost=goal_position"], "cost: reads 2 numbers from 'goal'"),
    (["cost=reward"], "cost=reward: robot=ugv has no reward"),
    (["robot=reacher", "robot.physics={size: [1, 2]}"], "unknown parameter 'size'; allowed: mass"),
)
def test_mistakes_are_said_in_one_line(overrides):
    if "robot=dm_control" in overrides:
        pytest.importorskip("dm_control")
    agent_of(*overrides, "method=physics", trusted=["tests"])


PAGE = Path(__file__).parents[2] / "docs/howto/my_task.md"
MORE = """
class Short(Boat):
    def _step(self, tensordict):
        out = super()._step(tensordict)
        return out.set("done", self.state[:1] > 1.0)

class Free(Boat):
    def __init__(self):
        super().__init__()
        self.action_spec = Unbounded((1,))

def wide(state, action, after):
    return -after.abs()

def short(state):
    return -state[..., 0].abs()

def broken(state, action, after):
    raise KeyError("mine")
"""
BOAT = ["robot=boat", "robot.steps=24"]
FITTED = [FLIP, "dynamics.members=2", "dynamics.hidden=[16]", "robot.data.rounds=[120,40]"]
FITTED += ["robot.data.fit.epochs=8"]


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Write the files that a page shows, and more; make agents whose settings name them."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf" / "robot").mkdir(parents=True)
    for text in re.findall(r"```\w+\n(.*?)```", PAGE.read_text(), re.DOTALL):
        if name := re.search(r"(?:# |<!-- )([\w/]+\.(?:xml|py|yaml))", text):
            (tmp_path / name[1]).write_text(text + MORE * name[1].endswith(".py"))
    sys.modules.pop("mine", None)

    def make(*overrides, small=True):
        path = f"hydra.searchpath=[file://{tmp_path}/conf]"
        return agent_of(path, *SMALL, *(FITTED if small else ()), *overrides, trusted=["mine"])

    yield make
    sys.modules.pop("mine", None)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model leaves")
def test_an_environment_of_mine_learns_and_goes_on_where_it_was_stopped(mine, tmp_path):
    chosen = [*BOAT, "robot.env._target_=mine.Short", "method=afm_frozen_pe", "seeds=3"]

    def agent():
        made = mine(*chosen)
        prepare(made, tmp_path / "cache", echo=said.append)
        return made

    said: list[str] = []
    whole = run(agent())
    errors, rewards = said[1:3]
    assert re.fullmatch(r"ensemble: root mean square error .*: s_0 [\d.e-]+, s_1 [\d.e-]+", errors)
    assert rewards.count(",") == 2  # random first; two rounds
    missions = whole.missions
    assert (missions["terminated"] == (missions["steps"] < 23)).all()
    with pytest.raises(Stopped):
        run(agent(), checkpoint=tmp_path / "run", stopped=lambda loop: loop.step == 9)
    again = run(agent(), checkpoint=tmp_path / "run")
    assert said[1:3] == said[-2:]  # from the cache, too
    pd.testing.assert_frame_equal(whole.steps, again.steps, check_exact=True)


def test_progress_is_a_share_of_the_episode_not_of_the_budget(monkeypatch):
    shares = []
    monkeypatch.setattr(Bar, "listener", lambda share: None)
    monkeypatch.setattr(Bar, "close", lambda bar: shares.append(bar.n / bar.total))
    run(agent_of(*PENDULUM, *SMALL, "robot.steps=12", "budget=5000", FLIP, "method=physics"))
    assert shares[0] == 1.0


@pytest.mark.slow
def test_robots_of_the_how_to_are_corrected_as_it_shows_them(mine):
    pytest.importorskip("mujoco")
    cart = ["robot=mujoco", "robot.xml=cart.xml", "robot.reward=mine.home", "robot.steps=40"]
    for chosen in (cart, ["robot=glider", "robot.steps=40"]):
        steps = run(mine(*chosen, "method=afm_physics", small=False)).steps.iloc[26:]
        planned, executed = (steps.filter(regex=f"^{name}_") for name in ("planned", "executed"))
        assert (planned.to_numpy() * executed.to_numpy() <= 0).mean() > 0.9, chosen
    boat = mine("robot=boat", "method=afm_frozen_pe", small=False)
    assert boat.robot.data.rounds == [500, 300]


@refused(
    ([*BOAT, "method=physics"], "robot.model: the physics of this robot are not known"),
    ([*BOAT, "robot.reward=mine.wide"], r"robot.reward: returned \(2, 3, 2\) for states"),
    ([*BOAT, "robot.reward=mine.short"], r"robot.reward\(state\): expected a function of 3"),
    ([*BOAT, "robot.reward=mine.broken"], "robot.reward: fails for states .*'mine'"),
    ([*BOAT, "robot.reward=mine.nothing"], "robot.reward='mine.nothing': cannot be found"),
    ([*BOAT, "robot.reward=null"], "robot.reward: expected a function for planning"),
    ([*BOAT, "robot.env._target_=mine.Free"], "robot: Free: actions a_0 have no limits"),
    (
        [*PENDULUM, "robot.model={_target_: afm_rl.dynamics.Dubins}", "method=physics"],
        "robot.model: 3 state coordinates and 2 actions; expected 2 and 1, as Pendulum-v1",
    ),
)
def test_mistakes_in_code_of_mine_are_said_in_one_line(overrides, mine):
    learns = "method=physics" not in overrides
    mine(*overrides, *["method=frozen_pe"] * learns, small=learns)


def test_limits_may_be_set_where_there_are_none(mine):
    limits = ["robot.action_low=[-1]", "robot.action_high=[0]"]
    agent = mine(*BOAT, "robot.env._target_=mine.Free", *limits, "method=frozen_pe")
    assert agent.robot.action_high == [0]


@refused(
    ("<mujoco><bodi/></mujoco>", "robot.xml='<mujoco><bodi/></mujoco>': .*unrecognized"),
    ("<mujoco/>", "expected actuators, found none"),
    (MODEL.replace('ctrlrange="-1 1"', ""), "robot: mjcf: actions x have no limits"),
    ("nothing.xml", "robot.xml=nothing.xml: no such file"),
)
def test_mistakes_in_models_are_said_in_one_line(xml, mine):
    pytest.importorskip("mujoco")
    cfg = copy.deepcopy(composed("robot=mujoco", "robot.reward=mine.home", "method=physics"))
    cfg.robot.xml = xml
    build(cfg, ["mine"])


@pytest.mark.parametrize("place", ["robot.xml", "robot.model.model"])
def test_an_mjcf_that_settings_name_reads_no_folder_but_its_own(mine, tmp_path, place):
    pytest.importorskip("mujoco")
    for name in ("boat", "parts"):
        (tmp_path / name).mkdir()
    (tmp_path / "own.xml").write_text(MODEL)
    (tmp_path / "parts" / "hull.xml").write_text("<mujoco><option timestep='0.01'/></mujoco>")
    path = tmp_path / "boat" / "boat.xml"
    path.write_text(MODEL.replace("<mujoco>", "<mujoco><include file='../parts/hull.xml'/>"))
    overrides = ["robot=mujoco", f"robot.xml={tmp_path}/own.xml", "robot.reward=mine.home"]
    cfg = copy.deepcopy(composed(*overrides, "method=physics"))
    if place == "robot.xml":
        cfg.robot.xml = str(path)
    else:
        model = {"_target_": "afm_rl.dynamics.MuJoCoDynamics", "model": str(path)}
        cfg = OmegaConf.merge(cfg, {"robot": {"model": model}})
    message = rf"{place}: may read .*hull.xml, outside .* command line: trust=\[{tmp_path}/parts\]"
    with pytest.raises(ConfigurationError, match=message):
        build(cfg, ["mine"])
    for folder in ("boat", "parts"):
        assert build(cfg, ["mine", f"{tmp_path}/{folder}"]).robot.name in ("boat", "own")


def test_physics_change_under_way_and_the_oracle_knows_them():
    pytest.importorskip("mujoco")
    pole = ["robot=gymnasium", "robot.id=InvertedPendulum-v5", "robot.steps=12", *SMALL]
    changed = ["regimes=[{mass: 3.0, gravity: 0.5}]", "seeds=2"]
    errors = {}
    for method in ("physics", "oracle"):
        steps = run(agent_of(*pole, *changed, f"method={method}")).steps
        errors[method] = steps.groupby("regime_active")["error"].max()
    assert errors["physics"][0] == 0.0
    assert errors["physics"][1] > 0.01
    assert errors["oracle"][1] == 0.0
    drawn = agent_of(*pole, "regimes=[physics, permutation]", "seeds=3", "method=physics")
    assert drawn.regime_names == ["physics"] * 3 + ["permutation"] * 3


def test_data_under_regimes_are_of_each_by_turns():
    pendulum = agent_of("robot=gymnasium", "method=frozen_pe").robot
    healthy, changed = (
        transitions(pendulum, 32, 0, regimes=regimes)
        for regimes in ((), [{"gain_0": 0.0}, {"gain_0": 1.0}])
    )

    def missed(data, gain):
        """Error of the nominal model with part of the action, for each of eight episodes."""
        ahead = pendulum.model(data["observation"], gain * data["action"])
        return (ahead - data["next", "observation"]).abs().reshape(8, -1).amax(1)

    assert torch.equal(missed(healthy, 1.0), torch.zeros(8))
    assert torch.equal(missed(changed, 0.0)[::2], torch.zeros(4))
    assert torch.equal(missed(changed, 1.0)[1::2], torch.zeros(4))
    assert (missed(changed, 1.0)[::2] > 0).all()
