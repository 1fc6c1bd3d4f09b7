"""MuJoCo models: how they are read, their state space, and other physics."""

from __future__ import annotations

import copy
import json
import os
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import roma
import torch
from torch import Tensor

from afm_rl.dynamics.mjcf import compile_mjcf
from afm_rl.errors import ConfigurationError, check_number, printable, warn
from afm_rl.imports import needs
from afm_rl.regimes import Physics
from afm_rl.spaces.manifold import Manifold
from afm_rl.storage.child import in_child


class MuJoCoSpace(Manifold):
    r"""Positions, velocities and activations, :math:`(q, \dot q, w)`, with angles and rotations.

    Quaternions are scalar-first in the state, as in MuJoCo, and rotation vectors in the body's
    frame in the tangent space, as in its velocities: ``difference`` agrees with
    ``mj_differentiatePos``.

    Args:
        size: number of state coordinates, S.
        angles: coordinates that wrap at +-pi: hinges without limits.
        quaternions: first coordinate of each quaternion: ball and free joints.

    >>> space = MuJoCoSpace(5, angles=[4], quaternions=[0])
    >>> level = torch.tensor([1.0, 0.0, 0.0, 0.0, 3.0])
    >>> moved = space.add(level, torch.tensor([0.0, 0.0, 0.1, 0.5]))
    >>> space.difference(moved, level)
    tensor([0.0000, 0.0000, 0.1000, 0.5000])
    """

    def __init__(
        self, size: int, angles: Sequence[int] = (), quaternions: Sequence[int] = ()
    ) -> None:
        super().__init__(size, angles)
        self.quaternions = list(quaternions)
        self.tangent_size = size - len(self.quaternions)

    def _parts(self, vector: Tensor, width: int) -> list[Tensor]:
        """Split at the quaternions, each ``width`` wide: plain, turn, plain, turn, ..., plain."""
        sizes, at = [], 0
        for first in self.quaternions:
            sizes += [first - at, width]
            at = first + 4
        return list(vector.split([*sizes, self.size - at], -1))

    def project(self, raw: Tensor) -> Tensor:
        """Scale the quaternions in ``(*B, S)`` to length 1."""
        parts = self._parts(raw, 4)
        parts[1::2] = [roma.quat_normalize(part) for part in parts[1::2]]
        return torch.cat(parts, -1)

    def difference(self, state: Tensor, origin: Tensor) -> Tensor:
        """Return the tangent vector ``(*B, D)`` that leads from ``origin`` to ``state``."""
        raw = super().difference(state, origin)
        if not self.quaternions:
            return raw
        parts = self._parts(raw, 4)
        for k, first in enumerate(self.quaternions):
            here, there = (x[..., first : first + 4].roll(-1, -1) for x in (origin, state))
            turn = roma.quat_product(roma.quat_conjugation(here), there)
            parts[2 * k + 1] = roma.unitquat_to_rotvec(turn)
        return torch.cat(parts, -1)

    def add(self, origin: Tensor, tangent: Tensor) -> Tensor:
        """Return the state ``(*B, S)`` reached from ``origin`` along ``tangent``."""
        turns = self._parts(tangent, 3)
        for k, first in enumerate(self.quaternions):
            here = origin[..., first : first + 4].roll(-1, -1)
            turned = roma.quat_product(here, roma.rotvec_to_unitquat(turns[2 * k + 1]))
            turns[2 * k + 1] = turned.roll(1, -1) - origin[..., first : first + 4]
        return super().add(origin, torch.cat(turns, -1))


try:
    import mujoco
except ImportError:  # an extra
    mujoco = None

HUGE = 1e9  # MuJoCo resets a simulation that holds larger numbers
JOINT_DRIVES = 0, 6  # mjTRN_JOINT and mjTRN_SO3: what drives a joint
NAMES_FILES = re.compile(r"file|dir\s*=|plugin")  # whatever may
POSITION_INPUT = 1  # mjINPUT_POS, of PID servos, and mjCHART_EXPMAP, of orientations


def read_model(source: Any) -> tuple[Any, int]:
    """Return a copy of the ``MjModel`` in a source, and the simulation steps per action."""
    needs("dynamics=mujoco", "mujoco", "mujoco")
    skip, inner = 1, host_of(source)
    if isinstance(source, str | Path):
        found = _parse(source)
    elif isinstance(getattr(inner, "model", inner), mujoco.MjModel):  # gymnasium, or plain
        found, skip = getattr(inner, "model", inner), frame_skip_of(source)
    elif hasattr(source, "physics"):  # dm_control
        found = source.physics.model.ptr
        skip = round(source.control_timestep() / source.physics.timestep())
    else:
        raise ConfigurationError(
            f"dynamics.model={source!r}: expected an MJCF file or string, an mjModel, or a MuJoCo "
            "environment of gymnasium or dm_control"
        )
    name = f"dynamics.model={str(source)[:80]!r}"
    if found.nu == 0:
        raise ConfigurationError(f"{name}: expected actuators, found none")
    check_physics(name, found)
    return copy.copy(found), skip


def host_of(env: Any) -> Any:
    """Return what holds ``model`` and ``data``: an environment, or one that it contains."""
    held = (part for part in _parts(env) if hasattr(part, "model") and hasattr(part, "data"))
    return next(held, getattr(env, "unwrapped", env))


def frame_skip_of(env: Any) -> int:
    """Return the simulation steps per action of an environment, or of one that it contains."""
    steps = (part.frame_skip for part in _parts(env) if hasattr(part, "frame_skip"))
    return next(steps, 1)


def _parts(env: Any) -> Iterator[Any]:
    """Yield an environment without wrappers, then those that are its attributes."""
    inner = getattr(env, "unwrapped", env)
    yield inner
    for value in list(getattr(inner, "__dict__", {}).values()):
        if isinstance(value, gymnasium.Env):
            yield value.unwrapped


def check_physics(name: str, model: Any) -> None:
    """Refuse a time step that is not above 0, and masses that nothing can move."""
    check_number(f"{name}: timestep", float(model.opt.timestep), low=0.0, open_low=True)
    for kind, values in (("mass", model.body_mass), ("inertia", model.body_inertia)):
        for body, most in enumerate(np.abs(values).reshape(model.nbody, -1).max(-1)):
            if not most < HUGE:
                raise ConfigurationError(
                    f"{name}: body {model.body(body).name or body!r} has {kind} {most:g}; expected "
                    f"a finite number below {HUGE:g}"
                )


def _parse(source: str | Path) -> Any:
    """Return the model of an MJCF file or text, which need not be trusted."""
    text = str(source)
    name = f"dynamics.model={text[:80]!r}"
    if text.lstrip().startswith("<"):
        alone = not NAMES_FILES.search(text)
        answer = (_standalone if alone else _compiled)(name, text)
    elif Path(text).is_file():
        answer = _compiled(name, os.path.abspath(text))  # so that included files include
    else:
        raise ConfigurationError(f"dynamics.model={text}: no such file")
    warnings, _, binary = answer.partition(b"\n")
    for line in json.loads(warnings):
        warn(f"{name}: {line}")
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": binary})


def _compiled(name: str, source: str) -> bytes:
    return in_child(name, compile_mjcf, name, source, packages=["mujoco"])


@lru_cache(maxsize=16)
def _standalone(name: str, text: str) -> bytes:
    """Return a model that depends on no other file; a text is compiled once."""
    return _compiled(name, text)


def check_files(place: str, source: str, trusted: Sequence[str] = (), most: int = 300_000) -> None:
    """Refuse an MJCF that may read files outside its own folder and trusted folders.

    Every value that could name a file counts, also in a comment, in each folder that is named; so
    do those of the files that it may read. An MJCF in a trusted folder may read everything; one
    that is a text has no folder.

    Args:
        place: name of the setting.
        source: path of a file, or text that begins with ``<``; nothing else is looked at.
        trusted: folders.
        most: files that one model may name.

    Raises:
        ConfigurationError: naming the file; also for archives, pipes and devices.

    >>> check_files("robot.xml", '<mujoco><include file="/etc/passwd"/></mujoco>', ["/etc"])
    >>> check_files("robot.xml", '<mujoco><include file="/etc/passwd"/></mujoco>')
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: robot.xml: may read /etc/passwd, outside its folder; copy it \
there, or trust its folder on the command line: trust=[/etc]
    """
    homes = [os.path.realpath(folder) for folder in trusted]
    todo: list[str | bytes] = [source]
    folder = os.path.dirname(os.path.abspath(source))
    if source.lstrip().startswith("<"):
        todo, folder = [source.encode(errors="replace")], os.getcwd()
    elif not os.path.isfile(source) or _inside(folder, homes):
        return
    else:
        homes.append(os.path.realpath(folder))
    bases, middles, names, seen = {folder}, {""}, set[str](), set[str]()
    known = 0
    while todo:
        for key, name in _named(todo.pop()):
            (middles if key.endswith("dir") else names).update((name, os.path.basename(name)))
        if len(bases) + len(middles) + len(names) == known:
            continue  # as it is after most meshes
        known = len(bases) + len(middles) + len(names)
        archives = re.compile(r"\.(zip|mjz|mjb)(/|$)", re.IGNORECASE)
        packed = next(filter(archives.search, names), None)
        if packed or len(bases) * len(middles) * len(names) > most:
            reason = f"{printable(packed)}, which is packed" if packed else "too many files"
            raise ConfigurationError(f"{place}: may read {reason}; expected a few plain files")
        joined = {os.path.join(*parts) for parts in product(bases, middles, names)}
        for file in (joined | set(map(os.path.normpath, joined))) - seen:  # MuJoCo reads the latter
            seen.add(file)
            if not os.path.exists(file):
                continue
            shown = printable(file, 200)
            if not _inside(file, homes):
                home = printable(os.path.dirname(os.path.realpath(file)), 200)
                option = f"--trust {home}" if place.startswith("--") else f"trust=[{home}]"
                raise ConfigurationError(
                    f"{place}: may read {shown}, outside its folder; copy it there, or trust "
                    f"its folder on the command line: {option}"
                )
            if os.path.isfile(file):
                bases.add(os.path.dirname(os.path.normpath(file)))
                todo.append(file)
            elif not os.path.isdir(file):
                raise ConfigurationError(f"{place}: may read {shown}: expected a file")


def _inside(path: str, folders: Sequence[str]) -> bool:
    real = Path(os.path.realpath(path))
    return any(real.is_relative_to(folder) for folder in folders)


def _named(source: str | bytes) -> Iterator[tuple[str, str]]:
    """Yield attribute and value of whatever in a file, or a text, could name a file or a folder.

    >>> list(_named(b"<include file = 'a&#46;xml'/>"))
    [('file', 'a.xml'), ('file', 'a.xml')]
    """
    text = source
    if isinstance(text, str):  # MuJoCo reads no larger files
        text = Path(text).read_bytes() if os.path.getsize(text) < 1 << 31 else b""
    # Plugins have a "value".
    names = rb"\b(file\w*|value|assetdir|meshdir|texturedir)\s*=\s*([\"'])"
    letters = re.compile(r"&(?:#x([0-9a-fA-F]{1,6})|#([0-9]{1,7})|(amp|lt|gt|quot|apos));")
    for match in re.finditer(names, text):
        end = text.find(match[2], match.end())
        if end > 0:
            value = letters.sub(_letter, os.fsdecode(text[match.end() : end]))
            yield from ((match[1].decode(), v) for v in (value, value.replace("\\", "/")))


def _letter(match: re.Match[str]) -> str:
    hexadecimal, decimal, word = match.groups()
    if word:
        return {"amp": "&", "lt": "<", "gt": ">", "quot": '"', "apos": "'"}[word]
    code = int(hexadecimal, 16) if hexadecimal else int(decimal)
    return chr(code) if code < 0x110000 else match[0]


def space_of(model: Any) -> Manifold:
    """Return the state space of an ``MjModel``."""
    angles, quaternions = [], []
    for kind, first, limited in zip(
        model.jnt_type, model.jnt_qposadr, model.jnt_limited, strict=True
    ):
        if kind == mujoco.mjtJoint.mjJNT_HINGE and not limited:
            angles.append(int(first))
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            quaternions.append(int(first))
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            quaternions.append(int(first) + 3)
    size = model.nq + model.nv + model.na
    return MuJoCoSpace(size, angles, quaternions) if quaternions else Manifold(size, angles)


def state_names(model: Any) -> list[str]:
    """Name positions ``q_JOINT``, velocities ``v_JOINT`` and activations ``w_k``."""
    places, turn, rates = ("_x", "_y", "_z"), ("_qw", "_qx", "_qy", "_qz"), ("_wx", "_wy", "_wz")
    positions, velocities = [], []
    ends: tuple[str, ...]
    moves: tuple[str, ...]
    for joint, kind in enumerate(model.jnt_type):
        name = model.joint(joint).name or str(joint)
        ends, moves = ("",), ("",)  # of a slide or a hinge
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            ends, moves = turn, rates
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            ends, moves = (*places, *turn), (*places, *rates)
        positions += [f"q_{name}{end}" for end in ends]
        velocities += [f"v_{name}{end}" for end in moves]
    return [*positions, *velocities, *(f"w_{k}" for k in range(model.na))]


def actuator_names(model: Any) -> list[str]:
    """Return a name per control: of the actuator, else of the joint that it drives, or ``a_k``.

    The controls of an actuator with several inputs, such as an orientation, are ``NAME_0``, ...
    """
    names: list[str] = []
    for k in range(model.nactuator):
        name, count = model.actuator(k).name, model.actuator_ctrlnum[k]
        if not name and model.actuator_trntype[k] in JOINT_DRIVES:
            name = model.joint(model.actuator_trnid[k, 0]).name
        for i in range(count):
            own = f"{name}_{i}" if name and count > 1 else name
            names.append(own if own and own not in names else f"a_{len(names)}")
    return names


def home_of(model: Any, pose: np.ndarray | None = None) -> Tensor | None:
    """Return the controls ``(U,)`` by which position servos hold the robot's pose, others 0.

    That is the keyframe nearest to positions ``pose``; of several, without these, that with the
    name "home", else the first one. Without keyframes it is the pose in which the model is
    described. None where all are 0, or there is no servo.
    """
    data = mujoco.MjData(model)
    if model.nkey:
        names = [model.key(k).name for k in range(model.nkey)]
        first = names.index("home") if "home" in names else 0
        away = 0 if pose is None else np.abs(model.key_qpos - pose).sum(-1)
        mujoco.mj_resetDataKeyframe(model, data, first if pose is None else np.argmin(away))
    mujoco.mj_fwdPosition(model, data)
    home, single = np.zeros(model.nu), model.actuator_ctrlnum == 1
    controls, outputs = model.actuator_ctrladr, model.actuator_outadr
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
    affine = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    for k in np.flatnonzero(single & affine & (bias[:, 1] < 0) & (gain > 0)):
        length = data.actuator_length[outputs[k]]
        home[controls[k]] = -(bias[k, 0] + bias[k, 1] * length) / gain[k]
    # The first of several inputs are the position to hold, or the rotation vector of a ball joint.
    for k in np.flatnonzero(~single & (model.actuator_ctrlspec & POSITION_INPUT > 0)):
        held = data.actuator_length[outputs[k] :][: model.actuator_outnum[k]]
        home[controls[k] :][: len(held)] = held
    home = home.clip(*control_range(model))
    return torch.from_numpy(home) if home.any() else None


def control_range(model: Any) -> np.ndarray:
    """Return the lowest and highest controls ``(2, U)``, infinite where there is no limit."""
    endless = np.array([[-np.inf], [np.inf]])
    return np.where(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange.T, endless)


def changed_model(model: Any, row: tuple[float, ...]) -> Any:
    """Return a copy of an ``MjModel`` with other physics, a row of :attr:`Physics.names`.

    ``mass`` scales masses and inertias, ``friction`` that of contacts and joints, ``damping`` that
    of joints and tendons, ``gravity`` itself; wind is an acceleration (m/s^2). ``length`` is of
    links (bodies that only turn, and what is fixed to them) and of tendons' limits: masses stay,
    inertias grow with the square. The ``payload``, a share of the whole mass, is at the centre of
    the heaviest body.
    """
    import mujoco

    value = dict(zip(Physics.names, row, strict=True))
    changed = copy.copy(model)
    heaviest = int(model.body_mass[1:].argmax()) + 1
    load = value["payload"] * model.body_mass[1:].sum() / model.body_mass[heaviest]
    changed.body_mass[:] *= value["mass"]
    changed.body_inertia[:] *= value["mass"]
    changed.body_mass[heaviest] *= 1 + load
    for part in (
        changed.geom_friction[:, 0],
        changed.pair_friction[:, :2],
        changed.dof_frictionloss,
    ):
        part[:] *= value["friction"]
    for part in (changed.dof_damping, changed.tendon_damping):
        part[:] *= value["damping"]
    changed.opt.gravity[:] *= value["gravity"]
    changed.opt.gravity[:2] += value["wind_x"], value["wind_y"]
    links = _links(model)
    below = [body for body in range(1, model.nbody) if model.body_parentid[body] in links]
    geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in links]
    sites = [site for site in range(model.nsite) if model.site_bodyid[site] in links]
    changed.body_pos[below] *= value["length"]
    changed.body_ipos[links] *= value["length"]
    changed.body_inertia[links] *= value["length"] ** 2
    changed.geom_pos[geoms] *= value["length"]
    changed.site_pos[sites] *= value["length"]
    long = [geom for geom in geoms if model.geom_type[geom] in (3, 5)]  # capsules and cylinders
    changed.geom_size[long, 1] *= value["length"]  # half of it
    changed.tendon_range[:] *= value["length"]
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    return changed


def _links(model: Any) -> list[int]:
    """Return the moving bodies that do not travel by themselves."""
    links: list[int] = []
    for body in range(1, model.nbody):
        first = model.body_jntadr[body]
        kinds = model.jnt_type[first : first + model.body_jntnum[body]] if first >= 0 else ()
        carried = model.body_parentid[body] in links
        travels = any(kind in (0, 2) for kind in kinds)  # free joints and slides
        if (carried or len(kinds)) and not travels:
            links.append(body)
    return links
