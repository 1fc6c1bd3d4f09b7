"""Runs that are interrupted and go on give what they would have given, to the bit."""

import random
from pathlib import Path

import pytest
import torch
from harness import assert_same_results

import afm_rl.conf
from afm_rl.errors import ArtefactError
from afm_rl.missions import run
from afm_rl.missions.run import Stopped
from afm_rl.missions.state import StepLog, fingerprint
from afm_rl.storage.artefacts import Checkpoints

METHODS = sorted(path.stem for path in Path(afm_rl.conf.__file__).parent.glob("method/*.yaml"))
METHODS = [name for name in METHODS if "knode" not in name]
METHODS += ["physics planner=cem", "online_pe dynamics.propagation=sample"]
METHODS += ["online_pe updater.optimizer._target_=torch.optim.Adam"]


@pytest.fixture
def agent(make_agent, ring, spot):
    """Make an agent for three missions on two tracks, of which one ends early."""

    def make(method, **settings):
        settings = {"tracks": [ring, spot], "seeds": [3, 8], "budget": 14, **settings}
        return make_agent(*f"method={method}".split(), **settings)

    return make


FEW = ("afm_physics", "online_pe")  # the others run every night
EACH = [pytest.param(m, marks=[] if m in FEW else pytest.mark.slow) for m in METHODS]


@pytest.mark.parametrize("method", EACH)
def test_interrupted_runs_are_bit_identical(agent, tmp_path, method):
    before, changed = torch.manual_seed(2).get_state(), {"robot.schedule.at": []}
    whole = run(agent(method, **changed))
    assert torch.equal(before, torch.random.get_rng_state())  # left alone
    for stop in sorted(random.Random(method).sample(range(1, 14), 2)):
        with pytest.raises(Stopped, match=f"step {stop}"):
            broken = agent(method, **changed)
            run(broken, checkpoint=tmp_path, stopped=lambda loop, at=stop: loop.step == at)
        torch.rand(5)  # the global generator goes its own way
    assert_same_results(whole, run(agent(method, **changed), checkpoint=tmp_path))


def test_a_checkpoint_is_written_when_it_is_time_and_stays(agent, tmp_path):
    path = tmp_path / "deep" / "run"
    whole = run(agent("physics"), checkpoint=path)
    assert not path.exists()
    assert_same_results(whole, run(agent("physics"), checkpoint=path, every=0))
    assert [file.name for file in path.iterdir()] == [
        f"checkpoint-{step:07d}.safetensors" for step in (13, 14)
    ]
    assert_same_results(whole, run(agent("physics"), checkpoint=path))  # nothing is left to do


def test_a_run_without_a_checkpoint_can_be_stopped_too(agent):
    with pytest.raises(Stopped):
        run(agent("physics"), stopped=lambda loop: True)


@pytest.fixture
def kept(agent, tmp_path):
    """The checkpoint of a run that was stopped."""
    path = tmp_path / "run"
    with pytest.raises(Stopped):
        run(agent("physics"), checkpoint=path, stopped=lambda loop: loop.step == 3)
    (file,) = path.iterdir()
    return file


@pytest.mark.parametrize(
    ("method", "settings", "named"),
    [
        ("physics", {"budget": 15}, "settings.budget: 14 -> 15"),
        ("physics", {"seeds": [3]}, "settings.seeds: [3, 8] -> [3]"),
        ("physics", {"robot.env.dt": 0.1}, "settings.robot.env.dt: 0.2 -> 0.1"),
        ("oracle", {}, "settings.dynamics._target_: afm_rl.missions.factories.physics -> "),
    ],
)
def test_checkpoints_of_other_missions_are_refused(agent, kept, method, settings, named):
    before = kept.read_bytes()
    other = agent(method, **settings)
    whole = fingerprint(other)
    with pytest.raises(ArtefactError, match="made by other missions") as found:
        run(other, checkpoint=kept.parent)
    assert fingerprint(other) == whole
    assert named in str(found.value) and str(kept) in str(found.value)
    assert kept.read_bytes() == before


def test_a_checkpoint_of_other_weights_is_refused(agent, tmp_path):
    path = tmp_path / "run"
    with pytest.raises(Stopped):
        run(agent("frozen_pe"), checkpoint=path, stopped=lambda loop: loop.step == 3)
    other = agent("frozen_pe")
    other.model.biases[0].data += 1e-6
    with pytest.raises(ArtefactError, match="parts: "):
        run(other, checkpoint=path)


def test_settings_without_influence_may_change(agent, kept):
    run(agent("physics", progress=False, threads=2, cache="elsewhere"), checkpoint=kept.parent)


def test_a_damaged_checkpoint_is_refused(agent, kept):
    data = bytearray(kept.read_bytes())
    data[-9] ^= 1
    kept.write_bytes(data)
    learning = agent("online_pe")
    whole = fingerprint(learning)
    with pytest.raises(ArtefactError, match="damaged.* to start again"):
        run(learning, checkpoint=kept.parent)
    assert fingerprint(learning) == whole  # its parameters are not expanded either
    (kept.parent / "checkpoint-0000001.safetensors").touch()
    with pytest.raises(ArtefactError, match="to go on from checkpoint-0000001.safetensors"):
        run(agent("physics"), checkpoint=kept.parent)


def test_states_come_back(transitions, tmp_path):
    state, _ = transitions(4)
    tree = {"a": {0: {"x/y": state}, "1": {}}, "b": [1, None], "c": 0.1}
    Checkpoints(tmp_path, {}).write(3, tree)
    again = Checkpoints(tmp_path, {}).read()
    assert torch.equal(again["a"][0].pop("x/y"), state)
    assert again == {"a": {0: {}, "1": {}}, "b": [1, None], "c": 0.1}


def test_a_log_is_ordered_by_mission_and_grows_also_after_it_was_taken_up():
    log, columns = StepLog(["step", "half"], whole=["step"], room=4), torch.tensor([1.0, 0.5])
    for step in range(30):
        missions = torch.tensor([[0, 1, 2], [0, 2], [2]][step // 10])  # some leave
        log.add(missions, step, step * columns.expand(len(missions), 2))
        if step == 4:
            state = log.state_dict()
            log = StepLog(["step", "half"], whole=["step"], room=4)
            log.load_state_dict(state)
    table = log.table()
    assert table["mission"].tolist() == [0] * 20 + [1] * 10 + [2] * 30
    assert table["t"].tolist() == [*range(20), *range(10), *range(30)]
    assert table["step"].equals(table["t"]) and table["half"].eq(table["t"] / 2).all()
