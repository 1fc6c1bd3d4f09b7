"""The correction of one mission in numpy, written from the page of its equations.

``afm_rl/correction/README.md`` is the page; the numbers at the lines are those of its
equations. Nothing here is fast. Shapes: A actuators, M pairs, H hypotheses, of which K can be
inverted, C commands.
"""

from collections import namedtuple

import numpy as np

from afm_rl.correction.records import Settings, Step
from afm_rl.correction.table import HELD, MAPS, hypotheses

FUNCTIONS = {  # of the command that is sent now, equation (7)
    "u": lambda u: u,
    "saturating": lambda u: u * np.exp(-1.5 * np.abs(u)),
    "slipping": lambda u: u * np.exp(-5 * np.abs(u)),
    "|u|": np.abs,
    "1": np.ones_like,
}
Fits = namedtuple("Fits", "coefficients curves covariance maps map_covariance")


def basis(u):
    """Return the functions of commands ``(*B,)`` in which rows are linear, ``(*B, 5)``."""
    return np.stack([function(u) for function in FUNCTIONS.values()], -1)


def delayed(x, steps, length):
    """Return a series ``(A, N)`` some steps later, zeros first."""
    return np.hstack([np.zeros((len(x), steps)), x])[:, :length]


def softmax(x):
    """Return probabilities that sum to one along the last axis."""
    weights = np.exp(x - x.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def mean_of(weights, values):
    """Return the mean ``(A, C)`` of values ``(A, K, C)``."""
    return (weights[..., None] * values).sum(1)


def visible(memory, values):
    """Return what the model sees of actions ``(A, ...)``: P a."""
    return values - memory.hidden @ values


class Reference:
    """The core for one mission; ``probes`` ``(A, N)`` are commands from all over the box."""

    def __init__(self, probes, max_delay=8, known_delay=0, contexts=0, settings=None):
        self.settings, self.probes = settings or Settings(), probes
        self.max_delay, self.known_delay = max_delay, known_delay
        self.rows = hypotheses(max_delay, contexts > 0)
        self.maps = MAPS if len(probes) > 1 else ()
        every = [*self.rows, *self.maps, *HELD]
        self.inverted = len(every) - len(HELD)
        self.log_prior = np.array([h.log_prior for h in every])
        self.healthy = np.array([h.healthy for h in every])
        self.delays = np.array([h.delay for h in every])
        self.lags = np.array(["effect" in row.features for row in self.rows])
        self.curved = [k for k, h in enumerate(every) if h.name in ("curve", "by sign")]
        self.constant = [0, *(k for k, h in enumerate(every) if h.name.startswith("late"))]

    def tick(self, memory, measured, plan):
        """Return the next memory, and what to execute for a plan."""
        memory = self.measure(memory, measured)
        memory, correct = self.believe(memory, measured.innovation[0])
        if not correct:
            return self.execute(memory, plan)
        belief = self.belief(memory)
        memory = memory._replace(delay=self.likeliest_delay(memory))
        fits = self.fit(memory, plan)
        answers = np.where(self.healthy, 0, belief)[:, : self.inverted]
        answers[:, 0] = belief[:, self.healthy].sum(1)
        planned = self.sustainable(memory, plan, fits, answers)
        commands = self.propose(memory, plan, fits, planned)
        command, effect, bounds = self.decide(memory, plan, fits, answers, commands, planned)
        kept = answers[:, 0] > 0.5
        kept = kept & (kept.all() | (memory.hidden == 0).all())
        command = np.where(kept, inside(plan), command)
        memory = self.predict(memory, plan, fits, belief, command)
        plans = np.column_stack([memory.plans[:, 1:], plan.action])
        corrected = np.array([not kept.all()])
        bounds = bounds if corrected else (plan.low, plan.high)
        memory = memory._replace(plans=plans, corrected=corrected)
        return memory, Step(command, np.where(kept, command, effect), *bounds, corrected[0])

    # 1. Measure

    def measure(self, memory, measured):
        """Return the memory with the newest pairs in place of its last ones."""
        count, size = len(measured.validity), len(memory.validity)
        before = np.append(memory.validity[size + 1 - count :], 1)
        newest = measured._replace(
            effects=measured.effects.clip(-4, 4),
            stds=np.minimum(measured.stds, 4),
            validity=np.minimum(measured.validity, before),
        )
        for name in ("commands", "effects", "stds", "validity", "contexts"):
            old = getattr(memory, name)[..., 1 : size + 1 - count]
            pairs = np.concatenate([old, getattr(newest, name)], -1)
            memory = memory._replace(**{name: pairs})
        return memory._replace(hidden=measured.hidden)

    # 2. Believe

    def prior(self, memory):
        """Return log-priors ``(A, H)``, the weights q of a pair, and the least noise, ``(A,)``."""
        least_noise = np.abs(memory.commands).max(1).clip(0.25, 1) / 50
        q = np.minimum(1, (least_noise / memory.noise) ** 2)
        faults = np.log(softmax(q[:, None] * self.log_prior[1:]))
        log_prior = np.insert(faults, 0, self.settings.nominal_log_odds, 1)
        return log_prior, q, least_noise

    def believe(self, memory, innovation):
        """Return the memory with what the newest pair showed, and whether to correct."""
        settings, odds = self.settings, self.settings.nominal_log_odds
        v, variance, valid = memory.effects[:, -1], memory.stds[:, -1] ** 2, memory.validity[-1]
        s2, nu = memory.noise**2, settings.student_t_dof
        log_prior, q, least_noise = self.prior(memory)
        error = visible(memory, memory.forecasts - v[:, None])
        loss = (nu + 1) / 2 * np.log1p(error**2 / (nu * (s2 + variance))[:, None])
        best = self.constant[loss[:, self.constant].sum(0).argmin()]
        error[:, -1] = error[:, best]
        loss[:, -1] = loss[:, best] + np.log(len(self.constant)) / len(v)
        forgetting = 1 - (1 - settings.discount) * q[:, None]
        losses = forgetting * memory.losses + loss if valid else memory.losses  # (2)
        likeliest = (losses - log_prior).argmin(1)
        excess = (error[np.arange(len(v)), likeliest] ** 2 - variance).clip(0, 3 * s2)
        rate = settings.noise_learning_rate * valid * s2 / (s2 + variance)
        noise = np.maximum(np.sqrt(s2 + rate * (excess - s2)), least_noise)  # (3)
        # Range
        nominal, first = losses[:, :1], memory.losses[:, :1] <= odds
        losses = np.where(first, np.maximum(losses, nominal - odds), losses)
        least = losses.min(1, keepdims=True)
        half = (self.delays > 0) & (nominal <= least + odds).all()
        losses = np.minimum(losses, least + np.where(half, 8, 16))  # (4)
        # Change
        changed = losses[:, 0].max() > odds
        executed = memory.corrected[0] == 0
        unusual = innovation > settings.innovation_gate * executed * np.exp(memory.usual[0])
        surprise = visible(memory, memory.expected - v) ** 2 > 25 * (s2 + variance)
        surprise = surprise & (valid > 0)
        first = unusual and executed and valid > 0 and memory.usual[0] == 0
        sudden = first or (surprise & (memory.surprises < 0.1)).any()
        begins = sudden or not self.is_changed(memory)
        validity = memory.validity.copy()
        if changed and begins:
            validity[:-1] = np.minimum(validity[:-1], 0.5)
        # Usual innovations
        usual = memory.usual + 0.05 * valid * executed * (unusual - 1 / 3)
        memory = memory._replace(
            losses=losses,
            noise=noise,
            validity=validity,
            surprises=np.maximum(surprise, 0.8 * memory.surprises),
            usual=np.maximum(usual, 0),
        )
        return memory, changed and (unusual or not executed or len(memory.contexts) > 0)

    def is_changed(self, memory):
        return memory.losses[:, 0].max() > self.settings.nominal_log_odds

    def execute(self, memory, plan):
        """Return memory and step if the planned action is executed."""
        command = inside(plan)
        acting = command if plan.queue is None else plan.queue[:, 0]
        x = {name: values[:, -1] for name, values in self.features(memory, acting).items()}
        forecasts = np.tile(x["u-0"][:, None], len(self.log_prior))
        for k, row in enumerate(self.rows):
            terms = zip(row.features, row.mean, strict=True)
            terms = [abs(m) * x[f] for f, m in terms if f.startswith("u-") or f == "effect"]
            forecasts[:, k] = sum(terms)
        losses, changed = memory.losses, self.is_changed(memory)
        memory = memory._replace(
            expected=acting,
            forecasts=forecasts,
            losses=losses if changed else np.minimum(losses, losses[:, :1]),
            delay=memory.delay if changed else self.known_delay_of(memory),
            corrected=np.zeros(1),
            plans=np.column_stack([memory.plans[:, 1:], plan.action]),
            pending=self.newest_commands(memory, plan, command),
        )
        return memory, Step(command, command, plan.low, plan.high, False)

    def belief(self, memory):
        """Return the probability of each hypothesis, ``(A, H)``."""
        log_prior, losses = self.prior(memory)[0], memory.losses
        d = np.minimum(losses - losses.min(1, keepdims=True), 7)
        prior = (softmax(log_prior) + softmax(log_prior - (d.sum(0) - d))) / 2
        return softmax(np.log(prior) - losses)  # (5)

    def likeliest_delay(self, memory):
        """Return the delay of all axes, which is likelier with the others than none, ``(1,)``."""
        delays = np.arange(self.max_delay + 1)
        of_delays = self.delays[:, None] == delays
        prior = softmax(self.prior(memory)[0])
        before, after = prior @ of_delays, (prior * np.exp(-memory.losses)) @ of_delays
        ratio = after / before
        ratio = np.maximum(ratio / ratio.max(1, keepdims=True), 1e-3)
        odds = np.exp(self.settings.nominal_log_odds * (delays == memory.delay))
        weight = before.mean(0) * ratio.prod(0) * odds
        weight[1:] *= delays[1:] < (memory.validity > 0).sum()
        if weight[1:].sum() > weight[0]:
            return np.array([1 + weight[1:].argmax()])
        return self.known_delay_of(memory)

    def known_delay_of(self, memory):
        """Return the last delay, or 0 if a hypothesis without delay is better, ``(1,)``."""
        losses, delays = memory.losses[:, :-1], self.delays[:-1]
        late, without = (losses[:, delays == d].min(1) for d in (memory.delay[0], 0))
        return memory.delay * ((late - without).sum() <= self.settings.nominal_log_odds)

    # 3. Fit

    def features(self, memory, acting):
        """Return all features by name, of the pairs and of what acts next, ``(A, M + 1)``."""
        u = visible(memory, np.column_stack([memory.commands, acting]))
        sent, v, count = u[:, :-1], visible(memory, memory.effects), u.shape[1]
        e = (memory.validity == 1) * (v - sent)
        later = np.arange(count) - np.arange(count - 1)[:, None]
        x = {f"u-{d}": delayed(u, d, count) for d in range(self.max_delay + 1)}
        x["effect"] = delayed(np.where(memory.validity > 0, v, sent), 1, count) - u
        x["miss 1"] = delayed(e, 1, count)
        is_known = delayed(memory.validity[None] == 1, 2, count)
        x["miss 2"] = np.where(is_known, delayed(e, 2, count), x["miss 1"])
        x["sensor"] = -e @ np.where(later > 0, 0.7**later, 0)
        x["age"] = u * np.arange(count)[::-1] / 10
        return x | {name: function(u) for name, function in FUNCTIONS.items()}

    def fit(self, memory, plan):
        """Return the posteriors of all rows, and of the maps."""
        x, v = self.features(memory, np.zeros(len(memory.noise))), visible(memory, memory.effects)
        queue = [] if plan.queue is None else visible(memory, plan.queue).T
        since, age = memory.validity == 1, np.arange(v.shape[1])[::-1]
        rho = 1 / (memory.stds**2 + memory.noise[:, None] ** 2 + 1e-4)
        rho = rho / (since * rho).max()
        of_axes = rho / (since * rho).max(1, keepdims=True)
        fits = []
        for row in self.rows:
            weights = since * row.forgetting**age * (rho if row.shared else of_axes)
            if row.nearness:
                away = ((memory.contexts - plan.context[:, None]) ** 2).sum(0) + (age / 60) ** 2
                known = memory.validity > 0
                nearest = away[known].min()
                weights = known * of_axes * np.exp(row.nearness * (nearest - away))
            fits.append(self.posterior(row, x, v, weights, queue))
        coefficients, curves, covariances = zip(*fits, strict=True)
        maps = self.fit_maps(memory, v, since * of_axes)
        return Fits(coefficients, np.stack(curves, 1), np.stack(covariances, 1), *maps)

    def posterior(self, row, features, v, rho, queue):
        """Return coefficients, and mean and covariance of a row as a function of the command."""
        x, mean = np.stack([features[name] for name in row.features], -1), np.array(row.mean)
        past, now = x[:, :-1], x[:, -1]
        weighted = rho[..., None] * past
        gram = weighted.mT @ past
        pull = weighted.mT @ (v - past @ mean)[..., None]
        if row.shared:
            gram, pull = (np.tile(of.sum(0), (len(v), 1, 1)) for of in (gram, pull))
        covariance = np.linalg.inv(gram + np.diag(row.precision))
        theta = mean + (covariance @ pull)[..., 0]  # (6)
        outside = (theta[:, -1].clip(*row.bounds) - theta[:, -1]) / covariance[:, -1, -1]
        theta = theta + covariance[..., -1] * outside[:, None]
        inputs = np.zeros((len(v), len(FUNCTIONS), len(mean)))  # (7)
        for k, name in enumerate(row.features):
            if name in FUNCTIONS:
                inputs[:, list(FUNCTIONS).index(name), k] = 1
            elif name.startswith("u-"):
                inputs[:, 0, k] = 1
            elif name != "effect":
                inputs[:, -1, k] = now[:, k]
        if "effect" in row.features:
            k = row.features.index("effect")
            inputs[:, 0, k] = -1
            curve, effect = (inputs @ theta[..., None])[..., 0], now[:, k]
            for command in queue:
                effect = (basis(command) * curve).sum(1) + theta[:, k] * effect
            inputs[:, -1, k] = effect
        return theta, (inputs @ theta[..., None])[..., 0], inputs @ covariance @ inputs.mT

    def fit_maps(self, memory, v, rho):
        """Return the affine map and the swapped axes ``(2, A, A + 1)``, and covariances."""
        axes, known = np.arange(len(v)), np.eye(len(v), len(v) + 1)
        u = np.vstack([memory.commands, np.ones(v.shape[1])])
        covariance = np.linalg.inv((rho[:, None] * u) @ u.T + 1e-4 * np.eye(len(u)))
        pull = (rho * v) @ u.T + 1e-4 * visible(memory, known)
        affine = (covariance @ pull[..., None])[..., 0]
        miss = (rho[:, None] * (v[:, None] - memory.commands) ** 2).sum(-1)
        partner = (miss + miss.T).argmin(1)
        partner = np.where(partner[partner] == axes, partner, axes)
        return np.stack([affine, known[partner]])[: len(self.maps)], covariance

    # 4. Propose

    def sustainable(self, memory, plan, fits, answers):
        """Return the planned action; of plans that alternate, what the bounds can sustain."""
        plans = np.column_stack([memory.plans, plan.action])
        turns, planned = np.diff(plans), plan.action.copy()
        for a in np.flatnonzero((turns[:, 1:] * turns[:, :-1] < 0).all(1)):
            h = answers[a].argmax()
            if h >= len(self.rows) or h in self.curved:
                continue
            gain, b, keeps = fits.curves[a, h, 0], fits.curves[a, h, -1], 0
            if self.lags[h]:
                keeps, b = fits.coefficients[h][a, -1], 0
            mean, swing = plans[a, -2:].mean(), turns[a, -1] / 2
            centre = ((1 - keeps) * mean - b) * gain / (gain**2 + 0.02**2)
            room = max(0, min(plan.high[a] - centre, centre - plan.low[a]))
            limit = room * abs(gain) / (1 + keeps)
            planned[a] = mean + swing.clip(-limit, limit)
        return planned

    def propose(self, memory, plan, fits, planned):
        """Return commands to compare, ``(A, C)``, the planned action first."""
        wanted, grid = visible(memory, planned)[:, None], np.linspace(-1, 1, 201)
        gain, offset = fits.curves[..., 0], fits.curves[..., -1]
        inverses = gain * (wanted - offset) / (gain**2 + 0.02**2)
        miss = np.abs(fits.curves[:, self.curved] @ basis(grid).T - wanted[..., None])
        nearest = grid[(miss + 1e-3 * np.abs(grid)).argmin(-1)]
        moves = [visible(memory, np.hstack([nearest, inverses]) - wanted)]
        for matrix, constant in zip(fits.maps[..., :-1], fits.maps[..., -1:], strict=True):
            ridge = matrix.T @ matrix + 0.02**2 * np.eye(len(matrix))
            left = wanted - constant - matrix @ planned[:, None]
            moves.append(np.linalg.solve(ridge, matrix.T @ left))
        commands = [planned[:, None], planned[:, None] + np.hstack(moves), self.probes]
        return np.hstack(commands).clip(plan.low[:, None], plan.high[:, None])  # (8)

    # 5. Decide

    def forecast(self, memory, fits, commands):
        """Return the effects of commands ``(A, C)``, and their variances, ``(A, K, C)``."""
        x = basis(visible(memory, commands)).mT[:, None]  # (A, 1, 5, C)
        effects = fits.curves @ x[:, 0]
        variances = (x * (fits.covariance @ x)).sum(2)
        variances += np.array([[row.feature_variance] for row in self.rows])
        u = np.vstack([commands, np.ones(commands.shape[1])])
        of_affine = (u * (fits.map_covariance @ u)).sum(1)
        of_maps = np.stack([of_affine, 0 * of_affine], 1)[:, : len(self.maps)]
        effects = np.hstack([effects, (fits.maps @ u).swapaxes(0, 1)])
        return effects, np.hstack([variances, of_maps])

    def decide(self, memory, plan, fits, answers, commands, planned):
        """Return the command, its expected effect ``(A,)``, and the effect bounds."""
        effects, noise = self.forecast(memory, fits, commands)[0], memory.noise[:, None, None]
        mean = mean_of(answers, effects)
        std = np.sqrt(np.maximum(mean_of(answers, effects**2) - mean**2, 0))
        in_time = answers[:, : len(self.rows)] @ self.lags > 0.5
        in_time = in_time | (memory.hidden != 0).any()
        low = np.where(in_time, plan.low, (mean - std).min(1))
        high = np.where(in_time, plan.high, (mean + std).max(1))
        wanted = visible(memory, attainable(planned, low, high, self.settings.saturation))

        def rate(commands):
            effects, variances = self.forecast(memory, fits, commands)
            miss = np.abs(effects - wanted[:, None, None]) / noise
            promised = miss[..., :1] - miss + 1e-6 >= 2 * np.sqrt(np.maximum(variances, 0))
            sure = variances < (0.5 / noise) ** 2
            evidence = mean_of(answers, sure * (promised - 0.5)) - 1e-6  # (10)
            moved = np.abs(commands - commands[:, :1])
            size = np.abs(commands)
            silent = (size < 0.1 * size[:, :1]) & (size[:, :1] < memory.noise[:, None])
            supported = (evidence > 0) & ~silent | (moved == 0)
            together = ((evidence * moved).sum(0) >= 0) & ~silent.all(0)
            return mean_of(answers, np.log1p(miss**2)), supported, together

        loss, supported, together = rate(commands)
        loss[:, 0] -= 0.02
        best = np.where(together, loss.sum(0), np.inf).argmin()  # (9)
        each = np.where(supported, loss, np.inf).argmin(1)
        apart = np.column_stack([commands[:, 0], commands[np.arange(len(each)), each]])
        of_apart, _, together = rate(apart)
        command = commands[:, best]
        if together[1] and of_apart[:, 1].sum() <= loss[:, best].sum() + 1e-6:
            command = apart[:, 1]
        command = command.clip(plan.limit_low, plan.limit_high)
        effect = mean_of(answers, self.forecast(memory, fits, command[:, None])[0])[:, 0]
        return command, effect, effect_bounds(memory, plan, low, high)

    # 6. Predict

    def predict(self, memory, plan, fits, belief, command):
        """Return the memory with what each hypothesis expects next."""
        acting = command if plan.queue is None else plan.queue[:, 0]
        x, seen = self.features(memory, acting), visible(memory, acting)
        forecasts = []
        for row, theta in zip(self.rows, fits.coefficients, strict=True):
            now = np.stack([x[name][:, -1] for name in row.features], -1)
            forecasts.append((theta * now).sum(1))
        forecasts += [*(fits.maps @ np.append(acting, 1)), *self.held(memory, seen), seen]
        forecasts = np.stack(forecasts, 1)  # (11)
        pending = self.newest_commands(memory, plan, command)
        if memory.delay[0] + self.known_delay > 0:
            count = len(self.rows)
            shares = np.maximum(belief[:, :count], 1e-9) * (self.delays[:count] == memory.delay)
            curve = mean_of(shares / shares.sum(1, keepdims=True), fits.curves)
            pending = (basis(visible(memory, pending)) @ curve[..., None])[..., 0]
        expected = (belief * forecasts).sum(1)
        return memory._replace(forecasts=forecasts, expected=expected, pending=pending)

    def held(self, memory, acting):
        """Return the effects ``(A,)`` under a rate limit, and under stiction."""
        u, v = (visible(memory, of[:, -20:]) for of in (memory.commands, memory.effects))
        since, now, moved = memory.validity[-20:] == 1, v[:, -1], np.abs(np.diff(v))
        both = since[1:] & since[:-1]
        rate = np.maximum((both * moved)[:, -11:].max(1), 0.05)
        limited = acting.clip(now - rate, now + rate) if both[-1] else acting
        band = (both * (moved < 0.005) * np.abs(u - v)[:, 1:]).max(1).clip(max=0.2)
        return limited, np.where(np.abs(acting - now) <= 1.05 * band, now, acting)

    def newest_commands(self, memory, plan, command):
        """Return the commands that possibly have not acted yet, ``(A, D)``."""
        queue = [] if plan.queue is None else [plan.queue]
        newest = np.hstack([memory.commands, *queue, command[:, None]])
        return newest[:, -max(1, self.max_delay + self.known_delay) :]


def inside(plan):
    """Return the planned action within all bounds, ``(A,)``."""
    return plan.action.clip(plan.low, plan.high).clip(plan.limit_low, plan.limit_high)


def attainable(planned, low, high, mode):
    """Return the effect to ask for, ``(A,)``."""
    limit = np.maximum(np.where(planned < 0, -low, high), 0)
    share = limit / np.maximum(np.abs(planned), 1e-6)
    share = np.where(high - low < 0.05, 1, share)
    if mode == "clip" or (mode == "mixed" and np.mean(share < 0.15) < 0.5):
        return planned
    return planned * min(1, share.min())


def effect_bounds(memory, plan, low, high):
    """Return the bounds that planners keep, ``(A,)`` each."""
    share = (high - low) / (plan.high - plan.low)
    tried = np.ptp(memory.commands, 1) > 0.1 * (plan.high - plan.low)
    little = tried & (share > 0.025) & (share < 0.3)
    ends = np.minimum(low, plan.low), np.maximum(high, plan.high)
    return np.where(little, ends[0], low), np.where(little, ends[1], high)
