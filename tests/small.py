"""Settings that make a run small."""

from omegaconf import OmegaConf

SMALL = {
    "planner.population": 8,
    "planner.elites": 2,
    "dynamics.members": 2,
    "dynamics.hidden": [8, 8],
    "dynamics.pretrain.samples": 256,
    "dynamics.pretrain.epochs": 1,
    "dynamics.pretrain.flights": 4,
    "dynamics.base.members": 2,
    "dynamics.base.hidden": [8, 8],
    "dynamics.base.pretrain.samples": 256,
    "dynamics.base.pretrain.epochs": 1,
    "corrector.width": 8,
    "corrector.train.iterations": 5,
    "robot.contexts": 2,
    "robot.data.rounds": [64, 64],
    "robot.data.fit.epochs": 1,
}


def shrink(cfg, more=()):
    """Make the settings small that are there, in place."""
    for key, value in (SMALL | dict(more)).items():
        if OmegaConf.select(cfg, key) is not None:
            OmegaConf.update(cfg, key, value)
    return cfg
