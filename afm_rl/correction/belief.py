r"""The belief: which of several models of the actuators are to be trusted, axis by axis.

Dynamic model averaging (Raftery, Karny and Ettler 2010, Technometrics 52) with a Student-t
likelihood and a noise that is learnt. Model 0 says that *nothing has changed*.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Belief(NamedTuple):
    """What is believed of M models on A axes; everything is a share of the largest action."""

    losses: Tensor
    """Discounted negative log-likelihood, less its smallest possible value, ``(*B, M, A)``."""
    forecasts: Tensor
    """The effects that the models expect of what acts now, ``(*B, M, A)``."""
    noise: Tensor
    """Standard deviation that no model explains, ``(*B, A)``."""

    def update(
        self,
        effect: Tensor,
        std: Tensor,
        valid: Tensor,
        prior: Tensor,
        discount: float,
        rate: float,
        floor: Tensor | float,
        tails: float,
        constant_delays: Tensor | None = None,
        any_delay: Tensor | None = None,
    ) -> Belief:
        r"""Return the belief after an effect was seen.

        .. math::

            l_h &\leftarrow \big(1 - (1 - \alpha)\,q\big)\,l_h
            + \frac{\nu + 1}{2} \log\Big(1 + \frac{(v - T_h)^2}{\nu\,(s^2 + \sigma^2)}\Big) \\
            s^2 &\leftarrow s^2
            + \beta\,k\,\big(\min\{\max\{(v - T)^2 - \sigma^2, 0\}, 3 s^2\} - s^2\big),
            \qquad k = \frac{s^2}{s^2 + \sigma^2}

        with the forecasts :math:`T_h`, that of the model that is believed most, T, and no noise
        below ``floor``. In noise one has to look back longer, by the :func:`haste` q. An effect of
        which the transition showed nothing has a large :math:`\sigma` and changes little.

        Args:
            effect: v, ``(*B, A)``.
            std: :math:`\sigma` of v, ``(*B, A)``.
            valid: does the transition count? ``(*B, 1)``, 0 or 1.
            prior: log-odds of the models, ``(*B, M, A)``.
            discount: :math:`\alpha`.
            rate: :math:`\beta`.
            floor: least noise.
            tails: degrees of freedom :math:`\nu` of the Student-t distribution.
            constant_delays: indices ``(K,)`` of models, no delay and each one.
            any_delay: which model is that of a delay that changes, ``(M, 1)``: it has the loss of
                the best of them at this step, the same one on all A axes, and
                :math:`\log(K) / A` for the choice.
        """
        kept = 1 - (1 - discount) * haste(self.noise, floor).unsqueeze(-2)
        variance, stated = self.noise.square(), std.square()
        miss = (self.forecasts - effect.unsqueeze(-2)).square()
        scaled = miss / (variance + stated).unsqueeze(-2)
        loss = 0.5 * (tails + 1) * (scaled / tails).log1p()
        if constant_delays is not None and any_delay is not None:
            total = loss[..., constant_delays, :].sum(-1)
            which = constant_delays[total.argmin(-1)][..., None, None].expand_as(loss[..., :1, :])
            choice = math.log(len(constant_delays)) / loss.shape[-1]
            loss = torch.where(any_delay, loss.gather(-2, which) + choice, loss)
            miss = torch.where(any_delay, miss.gather(-2, which), miss)
        losses = kept * self.losses + loss
        losses = torch.where(valid.unsqueeze(-2) > 0, losses, self.losses)
        best = (losses - prior).argmin(-2, keepdim=True)
        excess = miss.gather(-2, best).squeeze(-2) - stated
        excess = torch.minimum(excess.clamp_min(0.0), 3 * variance)
        gain = rate * valid * variance / (variance + stated)
        noise = torch.lerp(variance, excess, gain).sqrt().clamp_min(floor)
        return self._replace(losses=losses, noise=noise)

    def weights(self, prior: Tensor) -> Tensor:
        """Return the posterior probabilities of the models, ``(*B, M, A)``.

        >>> losses = torch.tensor([[0.0], [0.0]])
        >>> even = Belief(losses, losses, torch.ones(1)).weights(torch.zeros(2, 1))
        >>> even.squeeze(-1)
        tensor([0.5000, 0.5000])
        """
        return (prior - self.losses).softmax(-2)

    def shared_prior(self, prior: Tensor, alike: float = 0.5, most: float = 7.0) -> Tensor:
        r"""Return the log prior of an axis, given the losses of the others, ``(*B, M, A)``.

        .. math:: \pi_{ha} \leftarrow (1 - \lambda)\,\pi_{ha} + \lambda\,\mathrm{softmax}_h \Big(
                  \log \pi_{ha} - \sum_{b \neq a} \min\{l_{hb} - \min_k l_{kb},\; 7\} \Big)

        With a probability of :math:`\lambda` all axes have the same fault, as where a supply
        fails, or a unit is wrong. Of twelve axes each then shows it to the others.

        Args:
            prior: log-odds of the models.
            alike: :math:`\lambda`.
            most: what one axis may say against a model: none decides alone.

        >>> losses = torch.tensor([[0.0, 9.0, 9.0], [3.0, 0.0, 0.0]])  # the first shows nothing
        >>> belief = Belief(losses, losses, torch.ones(3))
        >>> prior = torch.tensor([[1.0], [0.0]]).expand(2, 3)
        >>> belief.shared_prior(prior).exp()[:, 0].round(decimals=2)
        tensor([0.3700, 0.6300])
        """
        doubt = (self.losses - self.losses.amin(-2, keepdim=True)).clamp_max(most)
        others = doubt.sum(-1, keepdim=True) - doubt
        alike = alike if prior.shape[-1] > 1 else 0.0
        return torch.lerp(prior.softmax(-2), (prior - others).softmax(-2), alike).log()


def haste(noise: Tensor, floor: Tensor | float) -> Tensor:
    r"""Return :math:`q = \min\{1, (s_0 / s)^2\}`, the weight of a row in noise s, ``(*B, A)``.

    No noise is less than the ``floor``, :math:`s_0`.

    >>> haste(torch.tensor([0.02, 0.04]), floor=0.02)
    tensor([1.0000, 0.2500])
    """
    return (floor / noise).square().clamp_max(1.0)


def prior_of(worth: Tensor, odds: float, noise: Tensor, floor: Tensor | float) -> Tensor:
    """Return the prior log-odds of the models, that of *nothing has changed* first, ``(*B, M, A)``.

    What one model is worth more than another counts where it is quiet: in noise none is exact.

    Args:
        worth: of the others, ``(M - 1,)``.
        odds: of *nothing has changed* against all others together.
        noise: that no model explains, ``(*B, A)``.
        floor: least noise, in which ``worth`` counts in full.
    """
    among = worth.unsqueeze(-1) * haste(noise, floor).unsqueeze(-2)
    return torch.cat([torch.full_like(among[..., :1, :], odds), among.log_softmax(-2)], -2)


def mean_and_std(effects: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation ``(*B, A)`` of the effects ``(*B, M, A)`` of models.

    >>> mean_and_std(torch.tensor([[1.0], [-1.0]]), torch.tensor([[0.5], [0.5]]))
    (tensor([0.]), tensor([1.]))
    """
    mean = (weights * effects).sum(-2)
    return mean, (weights * (effects - mean.unsqueeze(-2)).square()).sum(-2).sqrt()
