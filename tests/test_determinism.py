"""The same seed gives the same run: again, in other company, and resumed midway."""

import copy

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp

from afm_rl.dynamics import Dubins, Oracle
from afm_rl.envs import UGVTrack
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, OracleUpdater, ResetAdam, Updater
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.regimes import Schedule
from afm_rl.transforms import ActionFlowTransform

SEEDS = [11, 12, 13]
METHODS = ["physics", "afm physics", "frozen", "afm frozen", "online", "afm online", "oracle"]


class Run:
    """Missions of one method, step by step, in double precision."""

    def __init__(self, method, parts, seeds=SEEDS, planner_seed=0):
        flow, ensemble, gains, box = copy.deepcopy(parts)
        regime = {"v_gain": -1.0, "omega_gain": 0.7}
        base = UGVTrack(schedule=Schedule([3], by="step"), dtype=torch.float64)
        kind = method.split()[-1]
        if kind == "physics":
            self.model = Dubins()
        elif kind == "oracle":
            self.model = Oracle(Dubins(), gains)
        else:
            self.model = ensemble.double()
        world = PlanningEnv(self.model, GoalDistance(), *(bound.double() for bound in box))
        keys = {"seed_key": ["mission", "seed"]}
        self.planner = MPPI(world, horizon=4, population=24, seed=planner_seed, **keys)
        loss = GaussianNLLLoss(self.model)
        chain = [self.planner.make_tensordict_primer()]
        if method.startswith("afm"):
            chain.insert(0, ActionFlowTransform(self.model, flow.double()))
            loss.set_keys(action=("next", "afm", "executed_action"))
        if kind == "online":
            self.model.expand_(len(seeds))
            self.updater = OnlineUpdater(loss, lambda p: ResetAdam(p, lr=1e-3))
        else:
            self.updater = (OracleUpdater if kind == "oracle" else Updater)(loss)
        self.env = TransformedEnv(base, Compose(*chain))
        missions = torch.stack([base.mission("ethz_2", seed, regime) for seed in seeds])
        self.td = self.env.reset(missions, set_state=False)
        self.updater.start(self.td)

    def go(self, steps):
        """Return everything that happened, ``(B, T)``."""
        log = []
        for _ in range(steps):
            td = self.env.step(self.planner(self.td))
            td["loss"] = self.updater(td)["loss"]
            log.append(td.clone())
            self.td = step_mdp(td.exclude("loss"))
        return torch.stack(log, 1)


@pytest.fixture
def parts(universal_flow, trained_ensemble, gains, box):
    return universal_flow, trained_ensemble, gains, box


def differences(left, right, tolerance=0.0):
    """Name the entries in which two logs differ."""
    assert set(left.keys(True, True)) == set(right.keys(True, True))
    pairs = {key: (left.get(key), right.get(key)) for key in left.keys(True, True)}
    close = {"rtol": tolerance, "atol": tolerance, "equal_nan": True}
    return [key for key, (a, b) in pairs.items() if not torch.allclose(a, b, **close)]


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same_run(method, parts):
    before = torch.get_rng_state()
    first = Run(method, parts).go(15)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(99)
    assert differences(first, Run(method, parts).go(15)) == []
    other = Run(method, parts, seeds=[21, 22, 23]).go(15)
    assert {"action", "pose", "loss"} <= set(differences(first, other))


@pytest.mark.parametrize("method", METHODS)
def test_a_mission_runs_alone_as_in_a_batch(method, parts):
    together = Run(method, parts).go(15)
    for row, seed in enumerate(SEEDS):
        alone = Run(method, parts, seeds=[seed]).go(15)
        assert differences(alone[0], together[row], tolerance=1e-7) == []


@pytest.mark.parametrize("method", ["afm physics", "afm online", "oracle"])
def test_a_mission_goes_on_when_others_leave(method, parts):
    whole = Run(method, parts).go(15)
    run = Run(method, parts)
    run.go(6)
    keep = torch.tensor([2, 0])
    run.td = run.td[keep]
    run.model.select_(keep)
    assert differences(run.go(9), whole[keep][:, 6:], tolerance=1e-7) == []


@pytest.mark.parametrize("method", METHODS)
def test_a_run_resumes_from_its_stored_parts(method, parts):
    whole, first = Run(method, parts).go(15), Run(method, parts)
    first.go(6)
    stored = copy.deepcopy(
        {
            "td": first.td.to_dict(),
            "model": first.model.state_dict(),
            "noise": first.env.base_env.state_dict(),
            "planner": first.planner.streams.state_dict(),
        }
    )
    again = Run(method, parts)
    again.td.update(stored["td"])
    again.model.load_state_dict(stored["model"])
    again.env.base_env.load_state_dict(stored["noise"])
    again.planner.streams.load_state_dict(stored["planner"])
    again.updater.start(again.td)
    assert differences(again.go(9), whole[:, 6:]) == []


def test_the_planner_seed_matters_only_without_mission_seeds(parts):
    one, other = (Run("physics", parts, planner_seed=seed).go(3) for seed in (1, 2))
    assert differences(one, other) == []
