"""MuJoCo models whose physics have changed."""

from __future__ import annotations

import copy
from typing import Any

from afm_rl.regimes import Physics

NAMES = Physics.names
SLIDE, FREE = 2, 0  # MuJoCo's numbers of joints that let a body travel
LONG = (3, 5)  # and of capsules and cylinders, whose second size is half their length


def changed_model(model: Any, row: tuple[float, ...]) -> Any:
    """Return a copy of an ``MjModel`` with other physics.

    * ``mass``: masses and inertias of all bodies times a factor,
    * ``friction``: sliding friction of contacts and dry friction of joints,
    * ``damping``: of joints and tendons,
    * ``gravity``, and ``wind_x``, ``wind_y``, a steady acceleration (m/s^2),
    * ``length``: of links (bodies that only turn, and what is fixed to them) and of tendons'
      limits; masses stay, inertias grow with the square,
    * ``payload``: a share of the whole mass, at the centre of the heaviest body.

    Args:
        model: the nominal model.
        row: values of :attr:`Physics.names <afm_rl.regimes.Physics>`.
    """
    import mujoco

    value = dict(zip(NAMES, row, strict=True))
    found = copy.copy(model)
    heaviest = int(model.body_mass[1:].argmax()) + 1
    load = value["payload"] * model.body_mass[1:].sum() / model.body_mass[heaviest]
    found.body_mass[:] *= value["mass"]
    found.body_inertia[:] *= value["mass"]
    found.body_mass[heaviest] *= 1 + load
    for part in (found.geom_friction[:, 0], found.pair_friction[:, :2], found.dof_frictionloss):
        part[:] *= value["friction"]
    for part in (found.dof_damping, found.tendon_damping):
        part[:] *= value["damping"]
    found.opt.gravity[:] *= value["gravity"]
    found.opt.gravity[:2] += value["wind_x"], value["wind_y"]
    links = _links(model)
    below = [body for body in range(1, model.nbody) if model.body_parentid[body] in links]
    geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in links]
    sites = [site for site in range(model.nsite) if model.site_bodyid[site] in links]
    found.body_pos[below] *= value["length"]
    found.body_ipos[links] *= value["length"]
    found.body_inertia[links] *= value["length"] ** 2
    found.geom_pos[geoms] *= value["length"]
    found.site_pos[sites] *= value["length"]
    found.geom_size[[geom for geom in geoms if model.geom_type[geom] in LONG], 1] *= value["length"]
    found.tendon_range[:] *= value["length"]
    mujoco.mj_setConst(found, mujoco.MjData(found))
    return found


def _links(model: Any) -> list[int]:
    """Return the moving bodies that do not travel by themselves."""
    links: list[int] = []
    for body in range(1, model.nbody):
        first = model.body_jntadr[body]
        kinds = model.jnt_type[first : first + model.body_jntnum[body]] if first >= 0 else ()
        carried = model.body_parentid[body] in links
        if (carried or len(kinds)) and not any(kind in (SLIDE, FREE) for kind in kinds):
            links.append(body)
    return links
