"""What goes into a tick, what is remembered, and what comes out."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Settings(NamedTuple):
    """The numbers of the belief and of the decision."""

    nominal_log_odds: float = 1.0
    """Prior log-odds of no fault."""
    discount: float = 0.95
    """Of losses, per step; 0.95: a memory of about 20 steps."""
    noise: float = 0.05
    """Standard deviation of unexplained effects at first, a share of the largest action."""
    noise_learning_rate: float = 0.1
    """Share of its square renewed at every step."""
    innovation_gate: float = 1.0
    """Innovation up to which a transition needs no explanation, standard deviations."""
    student_t_dof: float = 1.0
    """Degrees of freedom of the residuals."""
    saturation: str = "mixed"
    """What gives way when a plan is out of reach, see :mod:`~afm_rl.correction.achievable`."""


class Memory(NamedTuple):
    """What is remembered of B missions; actions and effects are shares of the largest action.

    A actuators, M pairs of command and effect with the newest last, H hypotheses, G context
    coordinates, D + 1 commands that have perhaps not acted yet.
    """

    commands: Tensor
    """Of the pairs, ``(B, A, M)``."""
    effects: Tensor
    """Their effective actions, ``(B, A, M)``."""
    stds: Tensor
    """Standard deviations of these, ``(B, A, M)``."""
    validity: Tensor
    """1: since the change; .5: from before it; 0: the effect is not known, ``(B, M)``."""
    contexts: Tensor
    """Where they were measured, ``(B, G, M)``."""
    losses: Tensor
    """Discounted negative log-likelihoods, ``(B, A, H)``."""
    forecasts: Tensor
    """The effects that hypotheses expect next, ``(B, A, H)``."""
    noise: Tensor
    """Standard deviation of effects that no hypothesis explains, ``(B, A)``."""
    expected: Tensor
    """The effect that is expected next, ``(B, A)``."""
    surprises: Tensor
    """A fading trace of surprising effects, ``(B, A)``."""
    usual: Tensor
    """Logarithm of the innovation that two of three healthy steps do not exceed, ``(B, 1)``."""
    corrected: Tensor
    """Was the last step corrected? 0 or 1, ``(B, 1)``."""
    delay: Tensor
    """Steps by which commands are believed to be late, ``(B, 1)``."""
    pending: Tensor
    """Effects of the newest commands, ``(B, A, D)``."""
    plans: Tensor
    """The last three planned actions, also beyond the bounds, ``(B, A, 3)``; within a tick four."""
    hidden: Tensor
    """I - P, with P the projection onto what the model sees of commands, ``(B, A, A)``."""


class Measurement(NamedTuple):
    """The newest N pairs as they were measured; N > 1 where a model learns."""

    commands: Tensor
    """What acted, ``(B, A, N)``."""
    effects: Tensor
    """Effective actions, ``(B, A, N)``."""
    stds: Tensor
    """Standard deviations of these, ``(B, A, N)``."""
    validity: Tensor
    """Does the transition count? 0 or 1, ``(B, N)``."""
    innovation: Tensor
    """Largest normalised error of the newest transition, ``(B, 1)``."""
    contexts: Tensor
    """Context coordinates, ``(B, G, N)``."""
    hidden: Tensor | None
    """I - P of the newest transition, ``(B, A, A)``; None: the model sees all of every command."""


class Plan(NamedTuple):
    """What is planned, and between which bounds."""

    action: Tensor
    """The planned action, ``(B, A)``."""
    low: Tensor
    """Lowest command that the robot takes, ``(B, A)``."""
    high: Tensor
    """Highest, ``(B, A)``."""
    limit_low: Tensor
    """Lowest command that may be sent now, as by a limit of its rate, ``(B, A)``."""
    limit_high: Tensor
    """Highest, ``(B, A)``."""
    queue: Tensor | None = None
    """Commands that are known to act later, the next one first, ``(B, A, D)``; None: no delay."""
    context: Tensor | None = None
    """Where the robot is, ``(B, G)``; None: all ground is alike."""


class Step(NamedTuple):
    """What is executed instead of a planned action."""

    command: Tensor
    """``(B, A)``."""
    effect: Tensor
    """The effect that is expected of it, ``(B, A)``."""
    effect_low: Tensor
    """Lowest effect that a command can have, ``(B, A)``."""
    effect_high: Tensor
    """Highest, ``(B, A)``."""
    corrected: Tensor
    """Is it another command than the plan? ``(B,)``."""
