"""One update of the paper in NumPy float64 with hand-written gradients: what `update.update` is tested against.

Written from the paper and the description of the authors' program, agent after agent and critic after critic; it knows
nothing of jax, of groups or of stacked networks. Arrays are [batch, size]; a network is a list of layers (kernel,
bias), with layer normalization (kernel, bias, gain, shift) for the hidden ones.
"""

import copy
import dataclasses

import numpy as np

# ---- networks --------------------------------------------------------------------------------------------------------


def forward(layers, x):
    """Output of a ReLU perceptron with linear output, and what each layer read and normalized."""
    kept = []
    for n, (kernel, bias, *norm) in enumerate(layers):
        read, x, seen = x, x @ kernel + bias, None
        if norm:
            gain, shift = norm
            scale = np.sqrt(x.var(axis=1, keepdims=True) + 1e-6)
            unit = (x - x.mean(axis=1, keepdims=True)) / scale
            x, seen = unit * gain + shift, (unit, scale)
        on = x > 0 if n < len(layers) - 1 else np.ones_like(x, bool)
        x = np.where(on, x, 0)
        kept.append((read, seen, on))
    return x, kept


def backward(layers, kept, slope):
    """Gradients [(kernel, bias, ...)] and the gradient of the input, for the gradient `slope` of the output."""
    gradients = []
    for (kernel, _, *norm), (read, seen, on) in zip(reversed(layers), reversed(kept), strict=True):
        slope, of_norm = slope * on, ()
        if norm:
            unit, scale = seen
            of_norm = ((slope * unit).sum(axis=0), slope.sum(axis=0))
            slope = slope * norm[0]
            # The mean and the scale depend on all units of the row.
            slope = slope - slope.mean(axis=1, keepdims=True) - unit * (slope * unit).mean(axis=1, keepdims=True)
            slope = slope / scale
        gradients.insert(0, (read.T @ slope, slope.sum(axis=0), *of_norm))
        slope = slope @ kernel.T
    return gradients, slope


# ---- heads of critics ------------------------------------------------------------------------------------------------


class Scalar:
    """Outputs [batch, 1]: the value itself."""

    def __init__(self, algorithm):
        pass

    def value(self, output):
        """(values [batch], slope of their sum with respect to the outputs)."""
        return output[:, 0], np.ones_like(output)

    def target(self, outputs, reward, discount):
        """From the outputs of all target critics."""
        return reward + discount * np.min([output[:, 0] for output in outputs], axis=0)

    def target_slopes(self, outputs):
        """Of what the target takes, with respect to the outputs of each critic: that of the smaller value, row by
        row."""
        values, slopes = zip(*map(self.value, outputs), strict=True)
        smallest = np.argmin(values, axis=0)
        return [np.where((smallest == c)[:, None], slope, 0) for c, slope in enumerate(slopes)]

    def loss(self, output, target):
        """(mean loss, its slope with respect to the outputs)."""
        error = output[:, 0] - target
        return (error**2).mean(), 2 * error[:, None] / len(error)


class Categorical(Scalar):
    """Outputs [batch, atoms]: logits of a distribution of returns (Bellemare et al. 2017, algorithm 1)."""

    def __init__(self, algorithm):
        self.low, self.high = algorithm.critic_range
        self.count = algorithm.critic_atoms
        self.spacing = (self.high - self.low) / (self.count - 1)
        self.returns = np.array([self.low + k * self.spacing for k in range(self.count)])

    def value(self, output):
        p = softmax(output)
        mean = p @ self.returns
        return mean, p * (self.returns - mean[:, None])

    def target(self, outputs, reward, discount):
        chosen = np.zeros_like(outputs[0])
        for b in range(len(chosen)):
            each = [softmax(output)[b] for output in outputs]
            p = min(each, key=lambda p: p @ self.returns)
            for k in range(self.count):
                moved = min(max(reward[b] + discount[b] * self.returns[k], self.low), self.high)
                position = (moved - self.low) / self.spacing
                lower = min(int(np.floor(position)), self.count - 2)
                chosen[b, lower] += p[k] * (lower + 1 - position)
                chosen[b, lower + 1] += p[k] * (position - lower)
        return chosen

    def loss(self, output, target):
        p = softmax(output)
        return -(target * np.log(p)).sum(axis=1).mean(), (p - target) / len(p)


class Quantile(Scalar):
    """Outputs [batch, quantiles]: quantiles of the return (Kuznetsov et al. 2020, equations 7 to 11)."""

    def __init__(self, algorithm):
        self.count = algorithm.critic_quantiles
        self.left = self.count - algorithm.dropped_quantiles

    def value(self, output):
        return output.sum(axis=1) / self.count, np.full_like(output, 1 / self.count)

    def places(self, outputs, b):
        """(critic, quantile) of the quantiles that row b keeps, from the smallest on."""
        every = [(c, k) for c in range(len(outputs)) for k in range(self.count)]
        return sorted(every, key=lambda place: outputs[place[0]][b, place[1]])[: len(outputs) * self.left]

    def target(self, outputs, reward, discount):
        rows = range(len(reward))
        kept = [[outputs[c][b, k] for c, k in self.places(outputs, b)] for b in rows]
        return np.array([reward[b] + discount[b] * np.array(kept[b]) for b in rows])

    def target_slopes(self, outputs):
        slopes = [np.zeros_like(output) for output in outputs]
        for b in range(len(outputs[0])):
            for c, k in self.places(outputs, b):
                slopes[c][b, k] = 1 / (len(outputs) * self.left)
        return slopes

    def loss(self, output, target):
        total, slope = 0.0, np.zeros_like(output)
        terms = output.size * target.shape[1]
        for (b, k), theta in np.ndenumerate(output):
            level = (2 * k + 1) / (2 * self.count)
            for y in target[b]:
                error = y - theta
                weight = level if error >= 0 else 1 - level
                total += weight * (error**2 / 2 if abs(error) <= 1 else abs(error) - 1 / 2) / terms
                slope[b, k] -= weight * max(-1, min(1, error)) / terms
        return total, slope


def head(algorithm):
    return {"scalar": Scalar, "categorical": Categorical, "quantile": Quantile}[algorithm.critic_head](algorithm)


# ---- actions ---------------------------------------------------------------------------------------------------------


def is_box(space):
    return type(space).__name__ == "Box"


def choices(space):
    """Slices of the single choices in an action vector."""
    ends = np.cumsum(space.sizes)
    return [slice(end - size, end) for end, size in zip(ends, space.sizes, strict=True)]


def softmax(logits):
    weight = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weight / weight.sum(axis=1, keepdims=True)


def act(space, output, gumbel, squash="sigmoid"):
    """(action, what `act_slope` needs): a Gumbel-softmax sample, its one-hot for hard choices, or a scaled sigmoid or
    tanh."""
    if is_box(space) and squash == "tanh":
        half = (space.high - space.low) / 2
        return space.low + half * (1 + np.tanh(output)), np.cosh(output) ** -2 / 2
    if is_box(space):
        sigmoid = 1 / (1 + np.exp(-output))
        return space.low + (space.high - space.low) * sigmoid, sigmoid * (1 - sigmoid)
    soft = np.concatenate([softmax((output + gumbel)[:, part]) for part in choices(space)], axis=1)
    if type(space).__name__ == "Simplex":
        return soft, soft
    hard = np.zeros_like(soft)
    for part in choices(space):
        hard[np.arange(len(soft)), part.start + soft[:, part].argmax(axis=1)] = 1
    return hard, soft


def act_slope(space, kept, slope):
    """Gradient of the actor's output for the gradient `slope` of the action (hard choices: straight through)."""
    if is_box(space):
        return slope * (space.high - space.low) * kept
    out = np.zeros_like(slope)
    for part in choices(space):
        s, d = kept[:, part], slope[:, part]
        out[:, part] = s * (d - (s * d).sum(axis=1, keepdims=True))
    return out


def smooth(space, action, normal, sigma, bound):
    """Target policy smoothing: clipped noise, in half ranges and back into the bounds for a Box."""
    epsilon = np.clip(sigma * normal, -bound, bound)
    if is_box(space):
        return np.clip(action + epsilon * (space.high - space.low) / 2, space.low, space.high)
    return action + epsilon


def worst_case(agents, i, x, actions, value_slope, steps):
    """The joint action after one step of every agent but i against agent i, row after row: `steps[j]` long, against the
    gradient of its critic's value, in half ranges and within the bounds for a Box (M3DDPG).

    value_slope: of inputs [batch, inputs]: the gradient of the values' sum with respect to them.
    """
    slope = value_slope(np.concatenate([*x, *actions], axis=1))
    cuts = np.cumsum([part.shape[1] for part in (*x, *actions)])[:-1]
    slopes = np.split(slope, cuts, axis=1)[len(x) :]
    moved = []
    for j, (agent, action, gradient) in enumerate(zip(agents, actions, slopes, strict=True)):
        new = action.copy()
        for b, row in enumerate(gradient):
            length = np.sqrt(row @ row)
            if j == i or length == 0:
                continue
            half = (agent.space.high - agent.space.low) / 2 if is_box(agent.space) else 1
            new[b] -= steps[j] * half * row / length
            if is_box(agent.space):
                new[b] = np.minimum(np.maximum(new[b], agent.space.low), agent.space.high)
        moved.append(new)
    return moved


# ---- optimizer -------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Adam:
    """Moments [(kernel, bias, ...)] and number of steps taken."""

    first: list
    second: list
    count: int


def clip(gradients, mode, bound):
    """(gradients within the norm, number of the norms that were too large)."""
    flat = [g for layer in gradients for g in layer]
    if mode == "none":
        return gradients, 0
    norms = [np.sqrt((g**2).sum()) for g in flat]
    if mode == "network":
        norms = [np.sqrt(sum(norm**2 for norm in norms))] * len(flat)
    scaled = iter([g * (bound / norm if norm > bound else 1) for g, norm in zip(flat, norms, strict=True)])
    return [tuple(next(scaled) for _ in layer) for layer in gradients], sum(norm > bound for norm in norms)


def adam_step(layers, state, gradients, lr, kind):
    """(layers, state) after one step of Adam; "epsilon_hat" is TensorFlow 1's."""
    t = state.count + 1

    def moment(old, rate, power):
        return [
            tuple(rate * o + (1 - rate) * g**power for o, g in zip(*pairs, strict=True))
            for pairs in zip(old, gradients, strict=True)
        ]

    state = Adam(moment(state.first, 0.9, 1), moment(state.second, 0.999, 2), t)

    def moved(p, m, v):
        if kind == "epsilon_hat":
            return p - lr * np.sqrt(1 - 0.999**t) / (1 - 0.9**t) * m / (np.sqrt(v) + 1e-8)
        return p - lr * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)

    new = [
        tuple(moved(p, m, v) for p, m, v in zip(*triple, strict=True))
        for triple in zip(layers, state.first, state.second, strict=True)
    ]
    return new, state


def towards(target, online, tau):
    """Polyak: the target a share `tau` nearer to the online network."""
    return [
        tuple(tau * o + (1 - tau) * t for t, o in zip(*pairs, strict=True))
        for pairs in zip(target, online, strict=True)
    ]


# ---- one update ------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Agent:
    """One agent; `algorithm` and `hyper` are read as plain data with the names of the paper's settings."""

    space: object
    observation_size: int
    algorithm: object
    hyper: object
    actor: list
    actor_target: list
    critics: list
    critic_targets: list
    actor_adam: Adam
    critic_adams: list
    average: list | None = None
    team: str = ""


def take_apart(rows, agents):
    """Replay rows as (observations, actions, rewards, next observations, discount); lists over the agents."""
    sizes = [agent.observation_size for agent in agents]
    widths = [agent.space.size for agent in agents]
    cuts = np.cumsum([*sizes, *widths, *[1] * len(agents), *sizes])
    parts = np.split(rows, cuts, axis=1)
    n = len(agents)
    return parts[:n], parts[n : 2 * n], [r[:, 0] for r in parts[2 * n : 3 * n]], parts[3 * n : 4 * n], parts[-1][:, 0]


def long_step(rows, agents, gamma):
    """n-step returns of consecutive rows [batch, n, row]: plain rows [batch, row - 1], of one step, with the discounted
    sum of rewards, x' of the last row that counts, and discount gamma^(m - 1) (1 - terminated)."""
    size = sum(agent.observation_size for agent in agents)
    # x, actions, rewards, whether the episode continues, x', discount
    goes_on = rows.shape[2] - size - 2
    reward, ending = slice(goes_on - len(agents), goes_on), slice(goes_on + 1, None)
    long = rows[:, 0].copy()
    for b, steps in enumerate(rows):
        m = next((k + 1 for k, row in enumerate(steps) if row[goes_on] == 0), len(steps))
        long[b, reward] = sum(gamma**k * steps[k, reward] for k in range(m))
        long[b, ending] = steps[m - 1, ending]
        long[b, -1] *= gamma ** (m - 1)
    return np.delete(long, goes_on, axis=1)


def update(agents, batches, gumbel, normal, move, sequential, order=None, chosen=None):
    """One update. Returns (agents after it, metrics [3, agents], number of clipped norms).

    Args:
        batches: replay rows [batch, row] for each agent, or [batch, n, row] for n-step returns.
        gumbel, normal: functions of an action size: the noise [batch, size] of every sample, and of the smoothing.
        move: for each agent whether its actor and targets move.
        sequential: agents see the moved target actors of those before them.
        order: numbers of the agents whose actors move, one after another when all critics have learned, each with what
            the others' actors do by then; None: with the replayed actions, each right after its critics.
    """
    before, agents = agents, copy.deepcopy(agents)
    metrics, clipped = np.full((3, len(agents)), np.nan), 0
    for i, agent in enumerate(agents):
        h, algorithm = agent.hyper, agent.algorithm
        rows = batches[i]
        if rows.ndim == 3:
            rows = long_step(rows, agents, h.gamma)
        x, a, r, next_x, discount = take_apart(rows, agents)
        central, critic = algorithm.critic == "central", head(algorithm)
        targets = agent.critic_targets
        if chosen is not None and chosen[i] is not None:
            targets = [targets[c] for c in chosen[i]]

        # Target: r + gamma min_j Q'_j(x', mu'(o')), bootstrapping unless terminated.
        next_a = []
        for j, other in enumerate(agents if sequential else before):
            output = forward(other.actor_target, next_x[j])[0]
            action = act(other.space, output, gumbel(other.space.size), other.algorithm.actor_output)[0]
            if algorithm.smoothing:
                noise = normal(other.space.size)
                action = smooth(other.space, action, noise, h.target_noise, h.target_noise_clip)
            next_a.append(action)
        alphas = [h.adversarial_step_team if other.team == agent.team else h.adversarial_step for other in agents]
        if algorithm.adversarial:

            def slope_of_least(read, targets=targets, critic=critic):
                """Of min_j Q'_j, or what the target takes in its place."""
                passes = [forward(target, read) for target in targets]
                slopes = critic.target_slopes([output for output, _ in passes])
                return sum(
                    backward(target, kept, slope)[1]
                    for target, (_, kept), slope in zip(targets, passes, slopes, strict=True)
                )

            next_a = worst_case(agents, i, next_x, next_a, slope_of_least, alphas)
        read = np.concatenate([*next_x, *next_a] if central else [next_x[i], next_a[i]], axis=1)
        outputs = [forward(target, read)[0] for target in targets]
        y = critic.target(outputs, algorithm.reward_scale * r[i], h.gamma * discount)

        # Critics: mean squared error or cross-entropy, each with its own optimizer.
        read = np.concatenate([*x, *a] if central else [x[i], a[i]], axis=1)
        losses = []
        for c in range(algorithm.num_critics):
            q, kept = forward(agent.critics[c], read)
            loss, slope = critic.loss(q, y)
            losses.append(loss)
            gradients, _ = backward(agent.critics[c], kept, slope)
            gradients, count = clip(gradients, algorithm.clip, h.max_grad_norm)
            clipped += count
            if c == 0:
                metrics[1, i] = critic.value(q)[0].mean()
            agent.critics[c], agent.critic_adams[c] = adam_step(
                agent.critics[c], agent.critic_adams[c], gradients, h.critic_lr, algorithm.adam
            )
        metrics[0, i] = np.mean(losses)
        if move[i] and order is None:
            metrics[2, i], count = move_actor(agents, i, x, a, gumbel, alphas)
            clipped += count
    for i in order or ():
        agent, rows = agents[i], batches[i] if batches[i].ndim == 2 else batches[i][:, 0]
        if batches[i].ndim == 3:  # x and actions are those of the first step
            rows = np.delete(rows, rows.shape[1] - sum(one.observation_size for one in agents) - 2, axis=1)
        x = take_apart(rows, agents)[0]
        acted = [
            act(one.space, forward(one.actor, x[j])[0], gumbel(one.space.size), one.algorithm.actor_output)[0]
            for j, one in enumerate(agents)
        ]
        alphas = [agent.hyper.adversarial_step_team if one.team == agent.team else agent.hyper.adversarial_step
                  for one in agents]  # fmt: skip
        metrics[2, i], count = move_actor(agents, i, x, acted, gumbel, alphas)
        clipped += count
    return agents, metrics, clipped


def move_actor(agents, i, x, a, gumbel, alphas):
    """Move actor and targets of agent i with the others' actions `a`. Returns (actor loss, number of clipped norms)."""
    agent = agents[i]
    h, algorithm, batch, critic = agent.hyper, agent.algorithm, len(x[0]), head(agent.algorithm)
    central = algorithm.critic == "central"
    # Climbs the first critic (as it now is), or the mean of all, with its own action drawn again.
    climbed = agent.critics if algorithm.actor_critics == "all" else agent.critics[:1]

    def value(read):
        """(mean value, its slope with respect to the critics' inputs)."""
        total, slopes = 0, 0
        for layers in climbed:
            output, kept = forward(layers, read)
            q, slope = critic.value(output)
            total = total + q / len(climbed)
            slopes = slopes + backward(layers, kept, slope / len(climbed))[1]
        return total, slopes

    output, kept = forward(agent.actor, x[i])
    own, kept_act = act(agent.space, output, gumbel(agent.space.size), algorithm.actor_output)
    mixed = [own if j == i else a[j] for j in range(len(agents))]
    if algorithm.adversarial:
        mixed = worst_case(agents, i, x, mixed, lambda read: value(read)[1], alphas)
    q, slope = value(np.concatenate([*x, *mixed] if central else [x[i], own], axis=1))
    loss = -q.mean() + h.logit_regularizer * (output**2).mean()
    slope = -slope / batch
    start = sum(o.shape[1] for o in x) + sum(o.shape[1] for o in a[:i]) if central else x[i].shape[1]
    slope = act_slope(agent.space, kept_act, slope[:, start : start + agent.space.size])
    slope = slope + h.logit_regularizer * 2 * output / output.size
    gradients, _ = backward(agent.actor, kept, slope)
    gradients, clipped = clip(gradients, algorithm.clip, h.max_grad_norm)
    agent.actor, agent.actor_adam = adam_step(agent.actor, agent.actor_adam, gradients, h.actor_lr, algorithm.adam)

    agent.actor_target = towards(agent.actor_target, agent.actor, h.tau)
    if agent.average is not None:
        agent.average = towards(agent.average, agent.actor, algorithm.actor_average)
    agent.critic_targets = [
        towards(target, online, h.tau) for target, online in zip(agent.critic_targets, agent.critics, strict=True)
    ]
    return loss, clipped
