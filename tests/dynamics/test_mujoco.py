"""MuJoCo's own simulation as a dynamics model."""

import copy
import math
import os
import zipfile

import numpy as np
import pytest
import torch
from harness import refused

from afm_rl.dynamics import DynamicsModel, MuJoCoDynamics, Oracle, effective_action
from afm_rl.dynamics.mujoco_model import changed_model, check_files
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain, Compose, Physics

mujoco = pytest.importorskip("mujoco")

JOINTED = """<mujoco><option timestep="0.005"/><worldbody>
<geom type="plane" size="5 5 .1"/>
<body pos="0 0 .5"><freejoint/><geom size=".1"/>
  <body pos=".2 0 0"><joint type="ball"/><geom size=".05"/>
    <body pos=".2 0 0"><joint name="turns" type="hinge"/><geom size=".05" pos=".1 0 0"/>
      <body pos=".2 0 0"><joint name="limited" type="hinge" limited="true" range="-1 1"/>
        <geom size=".05" pos=".1 0 0"/>
</body></body></body></body></worldbody>
<actuator><motor joint="turns" ctrlrange="-2 2"/>
<general joint="limited" dyntype="filter" dynprm=".05" ctrlrange="-1 1"/></actuator></mujoco>"""


SEVERAL_INPUTS = """<mujoco><worldbody><body pos="0 0 1"><joint name="hip" type="ball"/>
<geom size=".1"/><body pos="0 0 -.3"><joint name="knee"/><geom size=".1"/><body pos="0 0 -.3">
<joint name="foot"/><geom size=".1"/></body></body></body></worldbody>
<actuator><orientation joint="hip" kp="5" ctrlrange="-2 2"/><position joint="knee" kp="20"/>
<pid name="ankle" joint="foot" kp="5"/></actuator><keyframe><key name="home"
qpos="0.98006658 0 0.19866933 0 -0.3 0.1"/></keyframe></mujoco>"""  # by 0.4 about y


@pytest.fixture(scope="module")
def model():
    return MuJoCoDynamics(JOINTED, frame_skip=4)


@pytest.fixture(scope="module")
def states(model):
    """States ``(6, S)`` on the way of a moving body, in double precision."""
    plan = torch.randn(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    still = torch.from_numpy(model.step.rest[model.step.state])
    return model.rollout(still, plan.unsqueeze(0))[0, ::10]


def test_it_is_the_simulation_itself(model, states):
    data = mujoco.MjData(model.step.settings[0])
    mujoco.mj_resetData(model.step.settings[0], data)
    data.qpos, data.qvel, data.act = np.split(states[3].numpy(), [model_size := data.qpos.size, -1])
    data.ctrl = [0.5, -0.3]
    for _ in range(4):
        mujoco.mj_step(model.step.settings[0], data)
    reached = torch.from_numpy(np.concatenate([data.qpos, data.qvel, data.act]))
    found = model(states[3], torch.tensor([0.5, -0.3]).double())
    torch.testing.assert_close(found, reached, rtol=0, atol=1e-7)
    assert model_size == 13 and model.state_size == 13 + 11 + 1


def test_its_space_is_that_of_mujoco(model, states):
    space = model.manifold
    assert space.is_angle.nonzero().flatten().tolist() == [11]
    assert space.tangent_size == 2 * 11 + 1
    tangent = 0.3 * torch.randn(5, 23, generator=torch.Generator().manual_seed(1)).double()
    moved = space.add(states[:5], tangent)
    torch.testing.assert_close(space.difference(moved, states[:5]), tangent)
    found = np.zeros(11)
    for k in range(5):
        pair = (states[k, :13].numpy(), moved[k, :13].numpy())
        mujoco.mj_differentiatePos(model.step.settings[0], found, 1.0, *pair)
        found[9] = math.remainder(found[9], 2 * math.pi)  # MuJoCo counts the turns
        torch.testing.assert_close(tangent[k, :11], torch.from_numpy(found))
    torch.testing.assert_close(space.project(3 * moved)[..., 3:7], moved[..., 3:7])


def test_each_input_of_an_actuator_is_an_action():
    model = MuJoCoDynamics(SEVERAL_INPUTS, frame_skip=10)
    assert model.action_size == 6
    assert model.names[1] == ["hip_0", "hip_1", "hip_2", "knee", "ankle_0", "ankle_1"]
    home = torch.tensor([0, 0.4, 0, -0.3, 0.1, 0], dtype=torch.float64)
    torch.testing.assert_close(model.home, home)
    data = mujoco.MjData(model.mjcf)
    mujoco.mj_resetDataKeyframe(model.mjcf, data, 0)
    data.ctrl[:] = model.home
    mujoco.mj_forward(model.mjcf, data)
    np.testing.assert_allclose(data.actuator_force, 0, atol=1e-6)  # all servos are where they hold
    state = torch.from_numpy(np.concatenate([data.qpos, data.qvel]))
    action = home + torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0]).double()
    found = effective_action(model, state, home, model(state, action), torch.ones(6).double())
    torch.testing.assert_close(found.action, action, rtol=0, atol=1e-2)


@pytest.mark.parametrize("threads", [0, 2])
def test_whole_plans_are_single_steps_in_a_row(states, threads):
    model = MuJoCoDynamics(JOINTED, frame_skip=4, threads=threads)
    plans = torch.randn(6, 3, 5, 2, generator=torch.Generator().manual_seed(0)).double()
    whole = model.rollout(states, plans)
    assert whole.shape == (6, 3, 5, 25)
    torch.testing.assert_close(
        whole, DynamicsModel.rollout(model, states, plans), atol=1e-8, rtol=0
    )


def test_a_subclass_that_overrides_the_prediction_plans_with_it(states):
    class Weak(MuJoCoDynamics):
        def forward(self, state, action):
            return super().forward(state, 0.5 * action)

    strong, weak = (kind(JOINTED, frame_skip=4) for kind in (MuJoCoDynamics, Weak))
    plans = torch.randn(6, 3, 4, 2, generator=torch.Generator().manual_seed(0)).double()
    expected = strong.rollout(states, 0.5 * plans)
    torch.testing.assert_close(weak.rollout(states, plans), expected, atol=1e-8, rtol=0)
    half = 0.5 * strong.jacobian(states[0], plans[0, 0, 0] / 2)
    torch.testing.assert_close(weak.jacobian(states[0], plans[0, 0, 0]), half, atol=1e-6, rtol=1e-3)


def test_derivatives_are_those_of_mujoco(states):
    model = MuJoCoDynamics(JOINTED)
    action = torch.tensor([0.5, -0.3]).double()
    native = model.step.settings[0]
    data = mujoco.MjData(native)
    by_state, by_action = np.zeros((23, 23)), np.zeros((23, 2))
    data.qpos, data.qvel, data.act = np.split(states[2].numpy(), [13, -1])
    data.ctrl = action.numpy()
    mujoco.mj_forward(native, data)
    mujoco.mjd_transitionFD(native, data, 1e-6, True, by_state, by_action, None, None)
    jacobian = model.jacobian(states[2], action)
    torch.testing.assert_close(jacobian, torch.from_numpy(by_action), rtol=1e-3, atol=1e-5)
    ahead, slope, drive = model.linearise(states[2], action)
    torch.testing.assert_close(ahead, model(states[2], action))
    plain = [10, *range(13, 24)]  # of the raw coordinates after the quaternions, velocities
    velocities = torch.from_numpy(by_state)[11:22, 11:22]
    torch.testing.assert_close(slope[13:24, 13:24], velocities, rtol=1e-2, atol=1e-3)
    torch.testing.assert_close(drive[13:], torch.from_numpy(by_action)[11:], rtol=1e-3, atol=1e-5)
    assert slope[plain].isfinite().all()


def test_actions_beyond_their_range_still_count(model, states):
    far, half = torch.tensor([6.0, -3.0]).double(), model.action_high
    found = effective_action(model, states[1], 0 * far, model(states[1], far), half)
    torch.testing.assert_close(found.action[0], far[0], rtol=1e-2, atol=0)


def test_rows_that_are_not_finite_stay_alone(model, states):
    given = states.clone()
    given[1, 0], given[4, 20] = torch.nan, 1e12
    after = model(given, torch.zeros(6, 2).double())
    assert after.isnan().all(-1).tolist() == [False, True, False, False, True, False]


def test_a_plan_is_simulated_up_to_its_first_number_that_is_not_finite(model, states):
    plans = torch.rand(6, 1, 5, 2, generator=torch.Generator().manual_seed(0)).double()
    whole, lengths = model.rollout(states, plans), torch.tensor([0, 2, 5, 2, 1, 4])
    rest = torch.arange(5) >= lengths[:, None]
    found = model.rollout(states, torch.where(rest[:, None, :, None], torch.nan, plans))
    assert torch.equal(found.isnan().any(-1), rest[:, None])
    assert torch.equal(found[~found.isnan()], whole[~found.isnan()])


def test_a_transition_as_predicted_costs_no_derivative_beside_one_that_is_not(model, states):
    """In a batch each row has what it has alone, and keeps its derivative."""
    simulated, step = [], model.step
    action, half = torch.full((6, 2), 0.5).double(), model.action_high
    after = torch.where(
        torch.arange(6)[:, None] == 3, model(states, -action), model(states, action)
    )
    kept = torch.ones(6, model.manifold.tangent_size, 2).double()
    given = states, action, after, half

    def counted(rows, controls):
        simulated.append(int(np.isfinite(controls).all((-2, -1)).sum()))
        return step(rows, controls)

    try:
        model.step = counted
        found = effective_action(model, *given, quiet=1.0, guess=-action, derivative=kept)
    finally:
        model.step = step
    assert simulated[0] == 6 and max(simulated[1:]) <= 3  # the forecasts, then one row's search
    assert torch.equal(found.derivative[:3], kept[:3])
    row = [part[3] for part in given[:3]]
    alone = effective_action(model, *row, half, quiet=1.0, guess=-action[3], derivative=kept[3])
    for part, single in zip(found, alone, strict=True):
        torch.testing.assert_close(part[3], single)


def test_a_copy_simulates_alike(model, states):
    action = torch.ones(2).double()
    torch.testing.assert_close(copy.deepcopy(model)(states, action), model(states, action))


def test_environments_bring_model_and_frame_skip():
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("InvertedPendulum-v5")
    env.reset(seed=0)
    model, inner = MuJoCoDynamics(env), env.unwrapped
    state = torch.from_numpy(np.concatenate([inner.data.qpos, inner.data.qvel]))
    inner.model.opt.gravity[2] = -1.0  # the world changes, the model does not
    before = model(state, torch.ones(1).double())
    env.step(np.ones(1))
    reached = np.concatenate([inner.data.qpos, inner.data.qvel])
    assert not np.allclose(before.numpy(), reached)
    again = MuJoCoDynamics(env)(state, torch.ones(1).double())
    np.testing.assert_allclose(again.numpy(), reached, atol=1e-12)


@refused(
    ("<mujoco><worldbody>", "XML"),
    ("missing.xml", "no such file"),
    ("<mujoco/>", "actuators"),
    (3.0, "expected an MJCF"),
)
def test_bad_models_are_named(source):
    MuJoCoDynamics(source)


MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ASSETS = "<asset><mesh name='m' file='%s'/></asset>"
PART = "<mujoco><worldbody><geom size='0.1'/></worldbody></mujoco>"


@pytest.fixture
def folders(tmp_path):
    """Folders ``robot`` and ``other``, each with a mesh, a part and a folder ``sub``."""
    for name in ("robot", "other"):
        (tmp_path / name / "sub").mkdir(parents=True)
        (tmp_path / name / "mesh.obj").write_text(MESH)
        (tmp_path / name / "part.xml").write_text(PART)
    (tmp_path / "robot" / "linked.obj").symlink_to(tmp_path / "other" / "mesh.obj")
    (tmp_path / "robot" / "linked").symlink_to(tmp_path / "other")
    (tmp_path / "robot" / "up.xml").write_text(
        "<mujoco><include file='../other/part.xml'/></mujoco>"
    )
    (tmp_path / "robot" / "near.xml").write_text("<mujoco><include file='part.xml'/></mujoco>")
    (tmp_path / "robot" / "sub" / "up.xml").write_text("<m><include file='../part.xml'/></m>")
    os.mkfifo(tmp_path / "robot" / "pipe.xml")
    with zipfile.ZipFile(tmp_path / "robot" / "packed.zip", "w") as file:
        file.writestr("mesh.obj", MESH)
    return tmp_path


def written(folders, inside):
    path = folders / "robot" / "robot.xml"
    path.write_text(JOINTED.replace("<worldbody>", inside.format(folders) + "<worldbody>", 1))
    return str(path)


OUTSIDE = "outside its folder"


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("<include file='../other/part.xml'/>", OUTSIDE),
        ('<include\nfile\n=\n"{}/other/part.xml"/>', OUTSIDE),
        ("<include file='&#46;&#x2e;/other/part.xml'/>", OUTSIDE),
        ("<include file='..\\other\\part.xml'/>", OUTSIDE),
        ("<include file='sub/../../other/part.xml'/>", OUTSIDE),
        ("<include file='up.xml'/>", OUTSIDE),
        ("<!-- a quote: file=' --><include file='linked/part.xml'/>", OUTSIDE),
        (ASSETS % "../other/mesh.obj", OUTSIDE),
        (ASSETS % "linked.obj", OUTSIDE),
        ("<compiler meshdir='../other'/>" + ASSETS % "mesh.obj", OUTSIDE),
        ("<compiler assetdir='{}/other'/>" + ASSETS % "mesh.obj", OUTSIDE),
        ("<compiler meshdir='sub'/>" + ASSETS % "../../other/mesh.obj", OUTSIDE),
        ("<asset><texture name='t' type='2d' file='../other/mesh.obj'/></asset>", OUTSIDE),
        ("<asset><texture name='t' type='cube' fileup='../other/mesh.obj'/></asset>", OUTSIDE),
        ("<asset><model name='p' file='../other/part.xml'/></asset>", OUTSIDE),
        ("<plugin plugin='x'><config key='map' value='../other/mesh.obj'/></plugin>", OUTSIDE),
        ("<include file='pipe.xml'/>", "expected a file"),
        ("<include file='/dev/zero'/>", OUTSIDE),
        (ASSETS % "packed.zip/mesh.obj", "which is packed"),
        ("<include file='part.xml'/>", ""),
        ("<include file='near.xml'/>", ""),
        ("<compiler meshdir='sub'/>" + ASSETS % "../mesh.obj", ""),
        ("<compiler strippath='true'/>" + ASSETS % "/home/elsewhere/mesh.obj", ""),
        ("<asset><model name='p' file='part.xml'/></asset>", ""),
    ],
)
def test_an_mjcf_of_others_reads_its_own_folder(folders, inside, message):
    path = written(folders, inside)
    if not message:
        check_files("robot.xml", path)
        assert MuJoCoDynamics(path).mjcf.nu == 2
        return
    with pytest.raises(ConfigurationError, match=f"robot.xml: may read .*{message}") as caught:
        check_files("robot.xml", path)
    assert "\n" not in str(caught.value)
    if message == OUTSIDE and "dev" not in inside:
        check_files("robot.xml", path, [str(folders / "other")])
    check_files("robot.xml", path, [str(folders)])  # it is trusted itself
    with pytest.raises(ConfigurationError, match="may read"):
        check_files("robot.xml", path, [str(folders / "robot" / "sub")])


def test_files_that_a_user_names_in_python_are_read(folders):
    path = written(folders, "<compiler meshdir='../other'/>" + ASSETS % "mesh.obj")
    assert MuJoCoDynamics(path).mjcf.nmesh == 1


def test_an_mjcf_without_a_folder_reads_nothing(folders, monkeypatch):
    monkeypatch.chdir(folders / "robot")
    check_files("robot.xml", PART)
    with pytest.raises(ConfigurationError, match="robot.xml: may read .*part.xml, outside"):
        check_files("robot.xml", "<mujoco><include file='part.xml'/></mujoco>")


POLE = """<mujoco><option timestep="0.01" gravity="0 0 -10"/><worldbody>
<body name="cart" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0" damping="2"/>
  <geom type="box" size=".1 .1 .1" mass="1" contype="0"/>
  <body name="pole"><joint name="turns" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -1" size=".01" mass=".2" contype="0"/>
</body></body></worldbody>
<actuator><motor joint="x" gear="1" ctrlrange="-1 1"/></actuator></mujoco>"""


def told(**values):
    """Return how a cart with a hanging pole accelerates from rest, and after 3 s of swinging."""
    model = MuJoCoDynamics(POLE)
    model.set_physics(Physics().encode(values))
    model.double()
    still, push = torch.zeros(4).double(), torch.ones(1).double()
    swung = model.rollout(torch.tensor([0, 0.1, 0, 0]).double(), torch.zeros(1, 600, 1).double())
    crossings = (swung[0, :, 1].diff().sign().diff() != 0).nonzero().flatten()
    return model(still, push)[2].item() / 0.01, crossings.double().diff().mean().item()


def test_other_physics_are_what_their_names_say():
    speed, period = told()
    assert speed == pytest.approx(1 / 1.05, rel=0.02)  # a pole that hangs takes a quarter along
    assert told(mass=2.0)[0] == pytest.approx(speed / 2, rel=0.02)
    assert told(payload=1.0)[0] == pytest.approx(1 / 2.25, rel=0.02)
    assert told(wind_x=0.5)[0] == pytest.approx(speed + 0.5, rel=0.02)
    assert told(gravity=4.0)[1] == pytest.approx(period / 2, rel=0.05)
    push, short = told(length=0.25)
    assert short == pytest.approx(period / 2, rel=0.05)
    assert push == pytest.approx(speed, rel=0.02)  # masses stay
    model = MuJoCoDynamics(POLE)
    moving, none = torch.tensor([0.0, 0.0, 1.0, 0.0]), torch.zeros(1)
    lost = 1 - model(moving, none)[2]
    model.set_physics(Physics().encode({"damping": 2.0}))
    assert (1 - model(moving, none)[2]) / lost == pytest.approx(2.0, rel=0.05)


def test_a_rope_between_links_is_as_slack_at_any_length():
    ends = "<site name='{}' pos='{}'/>"
    robot = POLE.replace('<joint name="turns"', ends.format("a", "0 0 -1") + '<joint name="turns"')
    robot = robot.replace('<body name="pole">', ends.format("b", "0 0 0") + '<body name="pole">')
    rope = "<tendon><spatial range='0 1.5'><site site='a'/><site site='b'/></spatial></tendon>"
    model = mujoco.MjModel.from_xml_string(robot.replace("<actuator>", rope + "<actuator>"))
    for length in (1.0, 0.5):
        changed = changed_model(model, Physics().encode({"length": length}).tolist())
        data = mujoco.MjData(changed)
        mujoco.mj_forward(changed, data)
        assert data.ten_length[0] / changed.tendon_range[0, 1] == pytest.approx(1 / 1.5)


def test_no_plans_lead_nowhere():
    model = MuJoCoDynamics(POLE)
    assert model.rollout(torch.zeros(0, 4), torch.zeros(0, 5, 7, 1)).shape == (0, 5, 7, 4)
    model.set_physics(Physics().encode({"mass": 2.0}))
    assert model(torch.zeros(0, 4), torch.zeros(0, 1)).shape == (0, 4)


def test_each_mission_has_physics_of_its_own():
    model, physics = MuJoCoDynamics(POLE), Physics()
    rows = torch.stack([physics.encode({}), physics.encode({"mass": 3.0})])
    plans = torch.rand(2, 5, 7, 1, generator=torch.Generator().manual_seed(0))
    state = torch.zeros(2, 4)
    model.set_physics(rows)
    together = model.rollout(state, plans)
    for row, plan, found in zip(rows, plans, together, strict=True):
        model.set_physics(row)
        assert torch.equal(model.rollout(state[0], plan), found)
    oracle = Oracle(MuJoCoDynamics(POLE), Compose([ActionGain(["gain_0"]), physics]))
    oracle.set_regime(torch.cat([torch.tensor([[1.0], [-1.0]]), rows], -1))
    plans[1] = -plans[1]
    assert torch.equal(oracle.rollout(state, plans), together)
    oracle.select_(torch.tensor([1]))
    assert torch.equal(oracle.rollout(state[:1], plans[1:]), together[1:])


def slider(option="", geom="", compiler=""):
    return f"""<mujoco><compiler {compiler}/><option {option}/><worldbody><body name="sled">
    <joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size=".1" {geom}/></body>
    </worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""


MANY, END = "<replicate count='900'>" * 3, "</replicate>" * 3
REPEATED = f"/>{MANY}<geom size='1'/>{END}<site"


@pytest.mark.check
@refused(
    (slider('timestep="nan"'), r"option '': timestep=nan: expected finite numbers below 1e\+15"),
    (slider('timestep="1e300"'), "option '': timestep=1e300: expected finite numbers"),
    (slider('timestep="0"'), r"timestep=0.0: expected a finite number in \(0, inf]"),
    (slider('timestep="-0.1"'), "timestep=-0.1: expected"),
    (slider(geom='mass="1e12"'), r"body 'sled' has mass 1e\+12; expected .* below 1e\+09"),
    (slider(geom='name="g" mass="nan"'), "geom 'g': mass=nan: expected finite numbers"),
    (slider().replace("ctrlrange", 'gear="nan" ctrlrange'), "motor '': gear=nan: expected finite"),
    (slider('iterations="1000001"'), "iterations=1000001: expected at most"),
    (slider(geom=REPEATED), "729810911 elements, including repeated ones; expected at most 100000"),
    (
        '<mujoco><asset><texture type="2d" builtin="flat" width="60000" height="60000"/></asset>'
        "</mujoco>",
        "width=60000, height=60000: expected at most",
    ),
    says="dynamics.model=.*: {}",
)
def test_a_model_that_cannot_be_simulated_is_refused_by_name(xml):
    MuJoCoDynamics(xml)


def test_a_model_of_numbers_that_are_none_is_refused():
    model = mujoco.MjModel.from_xml_string(slider())
    model.opt.gravity[0] = np.nan
    with pytest.raises(ConfigurationError, match="its first step leads to numbers that are not"):
        MuJoCoDynamics(model)
