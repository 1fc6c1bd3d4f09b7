"""A policy under faults, without a correction and with several: a call, a command, a page."""

import threading

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box
from harness import refused
from tensordict.nn import TensorDictModule
from torch import nn

from afm_rl import compare
from afm_rl.cli import compare as command
from afm_rl.comparison import Comparison
from afm_rl.comparison.compare import FAULTS
from afm_rl.comparison.episodes import Played, read_methods
from afm_rl.correction import ActionFlow, LeastSquares
from afm_rl.errors import ArtefactError

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
SHORT = {"episodes": 2, "steps": 60, "at": 20, "progress": False}
LOW, HIGH = -torch.ones(2).double(), torch.ones(2).double()


def glide(state, action):
    """Return where two carts of 1 kg are after 0.1 s: positions, then speeds."""
    place, speed = state.split(2, -1)
    speed = speed + 0.1 * action
    return torch.cat([place + 0.1 * speed, speed], -1)


class Carts(gymnasium.Env):
    """Two carts, whose force holds them at the origin; they are lost beyond 3 m."""

    def __init__(self, start=1.0):
        self.action_space = Box(-1.0, 1.0, (2,), np.float64)
        self.observation_space = Box(-np.inf, np.inf, (4,), np.float64)
        self.start = start

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        place = self.start * self.np_random.uniform(0.8, 1.0, 2)
        self.state = torch.from_numpy(np.r_[place, 0.0, 0.0])
        return self.state.numpy().copy(), {}

    def step(self, action):
        self.state = glide(self.state, torch.as_tensor(action))
        away = float(self.state[:2].abs().max())
        return self.state.numpy().copy(), 1.0 - away, away > 3.0, False, {}


LOCKED = Carts()
LOCKED.lock = threading.Lock()  # which cannot be copied


def hold(observation):
    """Pull both carts to the origin."""
    place, speed = np.split(observation, 2, -1)
    return np.clip(-place - 1.5 * speed, -1.0, 1.0)


def compared(env=Carts, policy=hold, faults=("one reversed", "late 2"), *methods, **settings):
    methods = methods or ("none",)
    return compare(env, policy, faults, methods, **{"model": glide, **SHORT, **settings})


@pytest.fixture(scope="module")
def found():
    """All methods, under two faults."""
    mine = {"none": "none", "AFM": "AFM", "mine": LeastSquares(LOW, HIGH), "oracle": "oracle"}
    return compare(Carts, hold, ("one reversed", "late 2"), mine, model=glide, **SHORT)


@pytest.mark.check
def test_afm_and_the_oracle_keep_what_a_reversal_costs(found):
    share = found.table.pivot_table(index="fault", columns="method", values="share")
    assert (share.loc["none"] == 1).all()
    assert share.at["one reversed", "none"] < 0.2
    assert (share.loc["one reversed", ["AFM", "oracle"]] > 0.9).all()
    assert share.at["late 2", "oracle"] > 0.95
    survived = found.table.set_index(["fault", "method"])["survived"]
    assert survived["one reversed", "none"] == 0 and survived["one reversed", "AFM"] == 1
    oracle = found.episodes[found.episodes["method"] == "oracle"]
    healthy = oracle["fault"].isin(["none", "one reversed"])
    assert np.allclose(oracle["after"][healthy].iloc[:2], oracle["after"][healthy].iloc[2:])


@pytest.mark.check
def test_the_table_is_that_of_the_episodes(found):
    episodes, table = found.episodes, found.table.set_index(["fault", "method"])
    means = episodes.groupby(["fault", "method"])["after"].mean()
    assert np.allclose(table["return"], means[table.index])
    wide = episodes.pivot(index=["fault", "seed"], columns="method", values="after")
    apart = (wide["AFM"] - wide["none"]).groupby("fault").mean()
    differences = table["difference"].xs("AFM", level="method")
    assert np.allclose(differences, apart[differences.index])
    assert (table["return_low"].dropna() <= table["return"][table["return_low"].notna()]).all()
    rewards = found.played["AFM"].rewards
    assert rewards.shape == (60, 6)
    assert np.allclose(rewards[20:].sum(0), episodes[episodes["method"] == "AFM"]["after"])


@pytest.mark.check
def test_a_comparison_shows_itself(found, tmp_path):
    lines = str(found).splitlines()
    assert lines[0] == "Carts, hold: fault at step 20 of 60, 2 episodes of each:"
    heads = [cell.strip() for cell in lines[2].split("|")[1:-1]]
    assert heads[:5] == ["fault", "without AFM", "with AFM", "mine", "oracle"]
    assert heads[-1] == "difference oracle" and len({len(line) for line in lines[2:7]}) == 1
    assert found._repr_html_().count("<tr") == 4
    bars, lines = found.plot("late 2").axes
    assert len(bars.patches) == 12 and "late 2" in lines.get_ylabel()
    found.save(tmp_path / "page")
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in page and "one reversed" in page
    stored = pd.read_csv(tmp_path / "page" / "table.csv")
    assert stored["return"].tolist() == pytest.approx(found.table["return"].tolist())
    assert (tmp_path / "page" / "comparison.png").read_bytes().startswith(b"\x89PNG")
    assert len(pd.read_csv(tmp_path / "page" / "episodes.csv")) == len(found.episodes)


def made(none, other, fell=False):
    """Return a comparison of returns without a fault and with one."""

    def played(returns):
        ends = np.full(len(returns), 2), np.full(len(returns), fell)
        return Played(np.array([np.zeros(len(returns)), returns]), *ends)

    rows = {"none": played(none), "AFM": played(other)}
    return Comparison("<robot>", ["none", "half"], [0, 1, 2], 1, rows, "it is <wrong>", 1)


def test_a_mark_says_where_a_correction_is_worse():
    surely = made([9.0, 10, 11, 5, 6, 7], [9.0, 10, 11, 2, 3, 5])
    assert surely.table["worse"].tolist() == [False, False, False, True]
    assert "WORSE" in str(surely) and "<robot>" not in surely._repr_html_()
    perhaps = made([9.0, 10, 11, 5, 6, 7], [9.0, 10, 11, 2, 6, 8])
    assert perhaps.table["difference"].iloc[-1] < 0 and not perhaps.table["worse"].any()
    always = made([9.0, 10, 11, 5, 6, 7], [9.0, 10, 11, 4, 5, 6])
    assert always.table["worse"].tolist() == [False, False, False, True]


def test_shares_of_costs_count_from_the_worst_mean():
    costs = made([-1.0, -1, -1, -21, -21, -21], [-1.0, -1, -1, -11, -11, -11])
    assert costs.table["share"].tolist() == [1.0, 1.0, 0.0, 0.5]


def test_a_wrong_model_is_said_first_and_stops_nothing(capsys):
    def mirrored(state, action):
        return glide(state, -action)

    found = compared(Carts, hold, ["none"], "AFM", model=mirrored, steps=22)
    assert "acts on -1 times the action" in capsys.readouterr().out
    assert str(found).startswith("THE MODEL IS WRONG: The model predicts only")
    assert "The model is wrong" in found._repr_html_()


def test_the_same_seeds_give_the_same_numbers_and_others_differ():
    first, again, later = (compared(Carts(), seed=seed).episodes for seed in (0, 0, 7))
    pd.testing.assert_frame_equal(first, again)
    assert not np.isclose(first["after"], later["after"]).any()


def test_random_actions_are_those_of_the_seed_and_said():
    found = compared(Carts, None, ["half"], "AFM", steps=22)
    assert found.title == "Carts, random actions"
    rewards = found.played["none"].rewards[:20]
    assert np.array_equal(rewards[:, :2], rewards[:, 2:])
    assert np.array_equal(rewards, found.played["AFM"].rewards[:20])


def test_faults_of_ones_own_and_correctors_have_names():
    own = {"mixed": {"gain_0": -1.0, "bias_1": 0.2}}
    found = compared(Carts, hold, own, ActionFlow(LOW, HIGH), steps=22)
    assert [*found.faults] == ["none", "mixed"] and found.methods == ["none", "ActionFlow"]
    assert [*read_methods("AFM")] == ["none", "AFM"]


def test_all_usual_faults_are_met_as_far_as_a_robot_has_them():
    assert compared(faults=None, steps=22).faults == [*FAULTS]


def test_a_policy_of_torch_acts_on_a_batch():
    class Hold(nn.Module):
        def forward(self, observation):
            return torch.from_numpy(hold(observation.numpy()))

    batch, single = compared(policy=Hold()), compared()
    near = {"rtol": 1e-3, "atol": 1e-3}
    np.testing.assert_allclose(batch.episodes["after"], single.episodes["after"], **near)


@refused(
    ("Hoper-v5", hold, {}, "env='Hoper-v5': expected the id .*did you mean Hopper-v"),
    (3, hold, {}, "env=3: expected the id of a gymnasium environment, an environment"),
    (LOCKED, hold, {}, "env=Carts: cannot be copied; give a function that makes one"),
    (lambda: 3, hold, {}, "made a int; expected an environment"),
    (lambda: Carts(1, 2), hold, {}, "cannot be made; give a function .*positional argument"),
    ("CartPole-v1", hold, {}, "action_space=Discrete.*expected vectors of real numbers"),
    (Carts, lambda seen: [0.0], {}, r"an action of the shape \(1,\), but Carts has 2 actions"),
    (Carts, lambda seen: seen[9], {}, "fails on an observation of Carts with 4 numbers: index 9"),
    (Carts, "policy.pt", {}, "policy=policy.pt: expected a file NAME.zip, NAME.onnx"),
    (Carts, 3, {}, "policy=int: expected a function of an observation, a module of TorchRL"),
    (Carts, hold, {"faults": ["halv"]}, "fault='halv': expected one of none, .*mean 'half'"),
    (Carts, hold, {"methods": ["AMF"]}, "method AMF='AMF': expected one of none, AFM"),
    (Carts, hold, {"methods": [ActionFlow(LOW[:1], HIGH[:1])]}, "a corrector of 1 actions, but"),
    (Carts, hold, {"methods": [ActionFlow(LOW, HIGH)] * 2}, "the same name twice; give a dict"),
    (Carts, hold, {"at": 60}, "at=60: the fault begins after an episode of 60 steps"),
    (Carts, hold, {"episodes": 0}, "episodes=0: expected a whole number of at least 1"),
    (lambda: Carts(4.0), hold, {}, "ends its episodes after 1 steps, with a return of -2.*step 20"),
    (lambda: Carts(4.0), None, {}, "before the fault at step 20; give a policy .policy=None acts"),
    says="^(compare|check_model|regimes|ActionFlowWrapper).*{}",
)
def test_mistakes_are_said_in_a_line_before_anything_runs(env, policy, settings):
    compare(env, policy, **{"faults": ["none"], "model": glide, **SHORT, **settings})


def test_the_sizes_of_a_stored_policy_are_compared(tmp_path):
    from afm_rl.planning import StoredPolicy, save_policy

    layers = [(torch.zeros(1, 3), torch.zeros(1))]
    save_policy(tmp_path / "small.safetensors", StoredPolicy(layers, LOW[:1], HIGH[:1]), {})
    with pytest.raises(ValueError, match="has 3 observations and 1 actions, but Carts has 4 and 2"):
        compared(policy=tmp_path / "small.safetensors")
    (tmp_path / "none.zip").write_bytes(b"nothing")
    with pytest.raises(ArtefactError, match="none.zip: no model of Stable-Baselines3"):
        compared(policy=tmp_path / "none.zip")


@pytest.mark.check
def test_an_own_environment_with_a_policy_of_onnx(tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    gains = np.vstack([-np.eye(2), -1.5 * np.eye(2)]).astype(np.float32)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["seen", "gains"], ["action"])],
        "hold",
        [helper.make_tensor_value_info("seen", kind, [1, 4])],
        [helper.make_tensor_value_info("action", kind, [1, 2])],
        [onnx.numpy_helper.from_array(gains, "gains")],
    )
    versions = {"opset_imports": [helper.make_opsetid("", 17)], "ir_version": 8}
    onnx.save(helper.make_model(graph, **versions), tmp_path / "hold.onnx")
    found = compared(Carts(), tmp_path / "hold.onnx", ["one reversed"], "AFM")
    assert found.title == "Carts, hold.onnx"
    share = found.table.set_index(["fault", "method"])["share"]
    assert share["one reversed", "AFM"] > 0.9 > 0.5 > share["one reversed", "none"]


@pytest.fixture
def swimmer():
    """A policy that swims, of Stable-Baselines3."""
    pytest.importorskip("mujoco")
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.PPO("MlpPolicy", "Swimmer-v5", device="cpu", seed=0)
    with torch.no_grad():
        model.policy.action_net.weight.mul_(100)
    return model


@pytest.mark.check
def test_an_id_with_a_model_of_stable_baselines3(swimmer, tmp_path):
    swimmer.save(tmp_path / "swimmer.zip")
    short = SHORT | {"faults": ["one reversed"], "steps": 60}
    stored = compare("Swimmer-v5", tmp_path / "swimmer.zip", **short)
    loaded = compare(gymnasium.make("Swimmer-v5"), swimmer, **short)
    pd.testing.assert_frame_equal(stored.table, loaded.table, atol=1e-3, rtol=1e-3)
    assert stored.table["difference"].abs().max() > 0


@pytest.mark.check
def test_the_command_prints_the_table_and_writes_a_page(swimmer, tmp_path, called, monkeypatch):
    monkeypatch.chdir(tmp_path)
    swimmer.save("swimmer.zip")
    words = ["--faults", "half", "--episodes", "1", "--steps", "40", "--at", "10"]
    done = called(command.main, "afm-rl-compare", "Swimmer-v5", "swimmer.zip", *words)
    assert done.status == 0, done.err
    assert "The model is right" in done.out and "| half " in done.out
    assert "Swimmer-v5, swimmer.zip: fault at step 10 of 40" in done.out
    assert (tmp_path / "outputs" / "compare" / "Swimmer-v5" / "index.html").is_file()
    for wrong in (["Swimmmer-v5"], ["Swimmer-v5", "x.onnx", "--normaliser", "x.pkl"]):
        done = called(command.main, "afm-rl-compare", *wrong)
        assert done.status == 2 and done.err.count("\n") == 1


@pytest.mark.check
def test_an_environment_of_torchrl_with_a_module():
    pytest.importorskip("mujoco")
    from torchrl.envs import DoubleToFloat, GymEnv, TransformedEnv

    torch.manual_seed(1)
    act = nn.Sequential(nn.Linear(8, 2), nn.Tanh())
    module = TensorDictModule(act, ["observation"], ["action"])
    env = TransformedEnv(GymEnv("Swimmer-v5"), DoubleToFloat())
    found = compare(env, module, ["one reversed"], ("AFM", "oracle"), **SHORT)
    plain = compare("Swimmer-v5", act, ["one reversed"], ("AFM", "oracle"), **SHORT)
    assert np.allclose(found.table["return"], plain.table["return"], rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_a_task_of_dm_control():
    suite = pytest.importorskip("dm_control.suite")
    torch.manual_seed(1)
    act = nn.Sequential(nn.Linear(17, 6), nn.Tanh())
    short = {"faults": ["all reversed", "late 2"], "methods": ("AFM", "oracle"), **SHORT}
    found = compare(lambda: suite.load("cheetah", "run"), act, **short)
    after = found.episodes.pivot_table(index="method", columns="fault", values="after")
    assert np.isclose(after.at["oracle", "all reversed"], after.at["none", "none"], rtol=0.01)
    assert np.isclose(after.at["AFM", "none"], after.at["none", "none"], rtol=0.01)
