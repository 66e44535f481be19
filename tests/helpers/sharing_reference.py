"""One update of agents that have networks in common, in NumPy float64: what sharing is tested against.

Written from the equations of docs/algorithms.md with the parts of `reference`: a one-hot of the agent is put behind
what its networks read, and the gradients of all agents that own a network are averaged.
"""

import copy
import dataclasses

import numpy as np
from reference import (
    Adam,
    act,
    act_slope,
    adam_step,
    backward,
    clip,
    forward,
    head,
    long_step,
    smooth,
    take_apart,
    towards,
    worst_case,
)


@dataclasses.dataclass
class Network:
    """A network with its target and its optimizer."""

    online: list
    target: list
    adam: Adam


@dataclasses.dataclass
class Actor:
    """An actor and its owners, numbers of agents; several are told apart by a one-hot."""

    owners: list
    network: Network
    average: list | None = None


@dataclasses.dataclass
class Critics:
    """A set of critics and its owners; of a `team` it knows no owners and learns from the mean of their rewards."""

    owners: list
    networks: list
    team: bool = False


@dataclasses.dataclass
class Agent:
    space: object
    observation_size: int
    algorithm: object
    hyper: object
    team: str


def with_index(read, owners, i):
    if len(owners) == 1:
        return read
    index = np.zeros((len(read), len(owners)))
    index[:, owners.index(i)] = 1
    return np.concatenate([read, index], axis=1)


def of(sets, i):
    return next(one for one in sets if i in one.owners)


def averaged(all_gradients):
    return [tuple(sum(parts) / len(all_gradients) for parts in zip(*layers, strict=True))
            for layers in zip(*all_gradients, strict=True)]  # fmt: skip


def acting(agents, actors, x, gumbel, which):
    """Everybody's actions, by the actors as they are (`online`) or by their targets."""
    found = []
    for j, agent in enumerate(agents):
        one = of(actors, j)
        output = forward(getattr(one.network, which), with_index(x[j], one.owners, j))[0]
        found.append(act(agent.space, output, gumbel(agent.space.size), agent.algorithm.actor_output)[0])
    return found


def update(agents, actors, critics, batches, gumbel, normal, move, order=None):
    """One update: (actors, critics, metrics [3, agents]) after it.

    Args:
        batches: replay rows of each agent, as for `reference.update`.
        order: numbers of the agents whose actors move one after another, against the others' policies of then.
    """
    before, actors, critics = actors, copy.deepcopy(actors), copy.deepcopy(critics)
    metrics = np.full((3, len(agents)), np.nan)
    parts = []
    for i, agent in enumerate(agents):
        rows = batches[i] if batches[i].ndim == 2 else long_step(batches[i], agents, agent.hyper.gamma)
        parts.append(take_apart(rows, agents))

    def read_of(i, x, a):
        return np.concatenate([*x, *a] if agents[i].algorithm.critic != "own" else [x[i], a[i]], axis=1)

    def alphas(i):
        h = agents[i].hyper
        return [h.adversarial_step_team if one.team == agents[i].team else h.adversarial_step for one in agents]

    for one in critics:
        first = agents[one.owners[0]]
        h, algorithm, critic = first.hyper, first.algorithm, head(first.algorithm)
        gradients = [[] for _ in one.networks]
        for i in one.owners[:1] if one.team else one.owners:
            owners = [i] if one.team else one.owners
            x, a, rewards, next_x, discount = parts[i]
            next_a = acting(agents, before, next_x, gumbel, "target")
            if algorithm.smoothing:
                next_a = [smooth(other.space, action, normal(other.space.size), h.target_noise, h.target_noise_clip)
                          for other, action in zip(agents, next_a, strict=True)]  # fmt: skip
            if algorithm.adversarial:

                def slope(read, i=i, owners=owners, nets=one.networks, critic=critic):
                    passes = [forward(network.target, with_index(read, owners, i)) for network in nets]
                    slopes = critic.target_slopes([output for output, _ in passes])
                    both = zip(nets, passes, slopes, strict=True)
                    total = sum(backward(network.target, kept, slope)[1] for network, (_, kept), slope in both)
                    return total[:, : read.shape[1]]

                next_a = worst_case(agents, i, next_x, next_a, slope, alphas(i))
            read = with_index(read_of(i, next_x, next_a), owners, i)
            reward = np.mean([rewards[j] for j in one.owners], axis=0) if one.team else rewards[i]
            outputs = [forward(network.target, read)[0] for network in one.networks]
            y = critic.target(outputs, algorithm.reward_scale * reward, h.gamma * discount)
            read, losses = with_index(read_of(i, x, a), owners, i), []
            for c, network in enumerate(one.networks):
                q, kept = forward(network.online, read)
                loss, slope = critic.loss(q, y)
                gradients[c].append(backward(network.online, kept, slope)[0])
                losses.append(loss)
                if c == 0:
                    metrics[1, one.owners if one.team else i] = critic.value(q)[0].mean()
            metrics[0, one.owners if one.team else i] = np.mean(losses)
        for c, network in enumerate(one.networks):
            found = clip(averaged(gradients[c]), algorithm.clip, h.max_grad_norm)[0]
            network.online, network.adam = adam_step(network.online, network.adam, found, h.critic_lr, algorithm.adam)

    def actor_gradient(i, one, x, a):
        agent, judges = agents[i], of(critics, i)
        h, algorithm, critic = agent.hyper, agent.algorithm, head(agent.algorithm)
        owners = [i] if judges.team else judges.owners
        climbed = judges.networks if algorithm.actor_critics == "all" else judges.networks[:1]

        def value(read):
            total, slopes = 0, 0
            for network in climbed:
                output, kept = forward(network.online, with_index(read, owners, i))
                q, slope = critic.value(output)
                total = total + q / len(climbed)
                slopes = slopes + backward(network.online, kept, slope / len(climbed))[1]
            return total, slopes[:, : read.shape[1]]

        output, kept = forward(one.network.online, with_index(x[i], one.owners, i))
        own, kept_act = act(agent.space, output, gumbel(agent.space.size), algorithm.actor_output)
        mixed = [own if j == i else action for j, action in enumerate(a)]
        if algorithm.adversarial:
            mixed = worst_case(agents, i, x, mixed, lambda read: value(read)[1], alphas(i))
        q, slope = value(read_of(i, x, mixed))
        metrics[2, i] = -q.mean() + h.logit_regularizer * (output**2).mean()
        central = algorithm.critic != "own"
        start = sum(o.shape[1] for o in x) + sum(o.shape[1] for o in a[:i]) if central else x[i].shape[1]
        slope = act_slope(agent.space, kept_act, -slope[:, start : start + agent.space.size] / len(q))
        return backward(one.network.online, kept, slope + h.logit_regularizer * 2 * output / output.size)[0]

    def step(one, gradients):
        agent, network = agents[one.owners[0]], one.network
        h, algorithm = agent.hyper, agent.algorithm
        found = clip(averaged(gradients), algorithm.clip, h.max_grad_norm)[0]
        network.online, network.adam = adam_step(network.online, network.adam, found, h.actor_lr, algorithm.adam)
        network.target = towards(network.target, network.online, h.tau)
        if one.average is not None:
            one.average = towards(one.average, network.online, algorithm.actor_average)

    if order is None:
        for one in actors:
            if move[one.owners[0]]:
                step(one, [actor_gradient(i, one, *parts[i][:2]) for i in one.owners])
    else:
        for i in order:
            x = parts[i][0]
            step(of(actors, i), [actor_gradient(i, of(actors, i), x, acting(agents, actors, x, gumbel, "online"))])
    for one in critics:
        if move[one.owners[0]]:
            for network in one.networks:
                network.target = towards(network.target, network.online, agents[one.owners[0]].hyper.tau)
    return actors, critics, metrics
