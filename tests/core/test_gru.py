"""Recurrent networks: one step against flax, sequences and losses against loops in NumPy of float64."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from gru_reference import one_step
from ledger import HYPER

from matd3_jax import envs
from matd3_jax.core import gru, losses, minibatch, replay
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.minibatch import Noise

UNITS, SEQUENCES, LENGTH, BURN_IN = 3, 5, 4, 2


def unrolled(p, warm, inputs, more, start):
    """(before, after) [sequences, learned steps, units]: first steps by the parameters `warm`, the others by `p`."""
    state, before, after = start, [], []
    for t in range(inputs.shape[1]):
        new = one_step(warm if t < BURN_IN else p, state, inputs[:, t])
        before.append(state)
        after.append(new)
        state = new * more[:, t, None]
    return np.stack(before, axis=1)[:, BURN_IN:], np.stack(after, axis=1)[:, BURN_IN:]


def test_one_step_is_flax_s():
    params = gru.init(jax.random.key(0), (2,), 4, UNITS)
    params = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(jax.random.key(1), leaf.shape), params)
    state, inputs = (jax.random.normal(jax.random.key(k), (2, 6, size)) for k, size in ((2, UNITS), (3, 4)))
    found = gru.step(params, state, inputs)
    for k in range(2):
        kernel, own = (jnp.split(params[name][k], 3, axis=-1) for name in ("kernel", "recurrent_kernel"))
        bias = jnp.split(params["bias"][k], 3)
        theirs = {f"i{gate}": {"kernel": kernel[g], "bias": bias[g]} for g, gate in enumerate("zrn")}
        theirs |= {f"h{gate}": {"kernel": own[g]} for g, gate in enumerate("zrn")}
        theirs["hn"]["bias"] = params["candidate_bias"][k]
        want, _ = nn.GRUCell(UNITS).apply({"params": theirs}, state[k], inputs[k])
        np.testing.assert_allclose(found[k], want, rtol=1e-5, atol=1e-6)


def test_fresh_kernels():
    """Uniform within 1 / sqrt(units), each network's its own."""
    params = gru.init(jax.random.key(0), (2, 3), 200, 16)
    for name in ("kernel", "recurrent_kernel"):
        assert np.abs(params[name]).max() < 0.25
        np.testing.assert_allclose(np.var(params[name]), 0.25**2 / 3, rtol=0.05)
        assert len(np.unique(params[name][..., 0, 0])) == 6
    assert not params["bias"].any() and not params["candidate_bias"].any()


def cases(rng):
    """(layout, rows [sequences, steps, row_size]) of two agents that see and do different things."""
    algorithm = Algorithm(hidden=(6,), actor="gru", gru_units=UNITS)
    env = envs.make("simple_speaker_listener")
    layout = JointLayout.of(env, {"agents": algorithm}, 1, LENGTH, BURN_IN)
    rows = rng.normal(size=(SEQUENCES, BURN_IN + LENGTH, layout.row_size)).astype(np.float32)
    more = 14 + 8 + 2  # x, actions, rewards
    ended, terminated = rng.random((2, *rows.shape[:2]))
    rows[..., more] = ended > 0.3
    rows[..., -1] = np.where(ended > 0.3, 1, terminated > 0.5)
    assert layout.row_size == more + 1 + 2 * UNITS + 14 + 1
    return layout, rows


@pytest.fixture(scope="module")
def learned():
    """Losses of both agents and their slopes along random directions, found here and in the library."""
    rng = np.random.default_rng(0)
    layout, rows = cases(rng)
    x, action, reward = rows[..., :14], rows[..., 14:22], rows[..., 22:24]
    more, state, next_x, discount = rows[..., 24], rows[..., 25:31], rows[..., 31:45], rows[..., 45]
    found, want = [], []
    parts = {0: (slice(0, 3), slice(0, 3)), 1: (slice(3, 14), slice(3, 8))}  # of x, of the actions
    place = [layout.place(i) for i in range(2)]
    nets = []
    for i in range(2):
        group = layout.groups[place[i][0]]
        keys = jax.random.split(jax.random.key(i), 4)
        nets.append((
            group.init_actor(keys[0]), group.init_critics(keys[1], 22), group.init_actor(keys[2]),
            group.init_critics(keys[3], 22),
        ))  # fmt: skip
    double = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), nets)
    flat = lambda a: a.reshape(-1, *a.shape[2:])  # noqa: E731

    def perceptron(p, inputs):
        ends = [(p[f"kernel_{k}"], p[f"bias_{k}"]) for k in range(2)]
        return reference.forward(ends, inputs)[0]

    def actor(p, warm, i, which, seen):
        o, a = parts[i]
        inputs = np.concatenate([x[..., o], action[..., a]], axis=-1).astype(np.float64)
        states = unrolled(p["gru"], warm["gru"], inputs, more, state[:, 0, UNITS * i : UNITS * (i + 1)])[which]
        return perceptron(p, flat(np.concatenate([seen[:, BURN_IN:, o], states], axis=-1)))

    def critics(p, warm, which, seen, done):
        values = []
        for c in range(2):
            own, first = (jax.tree.map(lambda leaf, c=c: leaf[c], tree) for tree in (p, warm))
            inputs = np.concatenate([x, action], axis=-1).astype(np.float64)
            states = unrolled(own["gru"], first["gru"], inputs, more, np.zeros((SEQUENCES, UNITS)))[which]
            read = np.concatenate([flat(seen[:, BURN_IN:]), done, flat(states)], axis=-1)
            values.append(perceptron(own, read)[:, 0])
        return np.stack(values)

    def softmax(logits):
        return np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)

    for i in range(2):
        g, _ = place[i]
        group, (mu, q, _, q_target) = layout.groups[g], double[i]
        done = np.concatenate([softmax(actor(double[j][2], double[j][2], j, 1, next_x)) for j in range(2)], axis=-1)
        bootstrap = critics(q_target, q_target, 1, next_x, done).min(axis=0)
        y = flat(reward[:, BURN_IN:, i]) + HYPER.gamma * flat(discount[:, BURN_IN:]) * bootstrap
        replayed = flat(action[:, BURN_IN:]).astype(np.float64)

        def critic_loss(p, y=y, q=q, replayed=replayed):
            return np.mean((critics(p, q, 0, x, replayed) - y) ** 2, axis=-1).sum()

        def actor_loss(p, i=i, mu=mu, q=q, replayed=replayed):
            logits, own = actor(p, mu, i, 0, x), replayed.copy()
            own[:, parts[i][1]] = softmax(logits)
            return -critics(q, q, 0, x, own)[0].mean() + HYPER.logit_regularizer * np.mean(logits**2)

        batch = minibatch.minibatch(
            layout, group, jnp.asarray(flat(rows[:, BURN_IN:])),
            jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], minibatch.places(layout, group)), HYPER.gamma,
            sequences=jnp.asarray(rows),
        )  # fmt: skip
        noise = Noise((None, None), (None, None), None)
        targets = [jax.tree.map(lambda leaf: leaf[None], nets[j][2]) for j in range(2)]
        next_action = losses.target_actions(layout, group, HYPER, targets, None, batch, noise)
        target = losses.td_target(layout, group, HYPER, nets[i][3], batch, next_action)

        def found_critic(p, group=group, batch=batch, target=target):
            return losses.critic_loss(layout, group, p, batch, target)[0]

        def found_actor(p, group=group, batch=batch, i=i, noise=noise):
            return losses.actor_loss(layout, group, HYPER, p, nets[i][1], batch, noise)[0]

        found.append({"target": target})
        want.append({"target": y})
        for name, ours, theirs, params, p in (
            ("critic", found_critic, critic_loss, nets[i][1], q), ("actor", found_actor, actor_loss, nets[i][0], mu)
        ):  # fmt: skip
            value, slope = jax.value_and_grad(ours)(params)
            found[i][name], want[i][name] = value, theirs(p)
            for part in ("kernel", "recurrent_kernel", "candidate_bias", "bias", "kernel_0", "kernel_1"):
                inside = part in p["gru"]
                leaf = p["gru"][part] if inside else p[part]
                direction = rng.normal(size=leaf.shape)

                def moved(size, p=p, part=part, inside=inside, leaf=leaf, direction=direction, theirs=theirs):
                    new = leaf + size * direction
                    return theirs({**p, "gru": {**p["gru"], part: new}} if inside else {**p, part: new})

                own = slope["gru"][part] if inside else slope[part]
                found[i][f"{name} {part}"] = np.sum(np.asarray(own) * direction)
                want[i][f"{name} {part}"] = (moved(1e-6) - moved(-1e-6)) / 2e-6
    return found, want


@pytest.mark.slow
@pytest.mark.parametrize("agent", [0, 1])
def test_losses_and_their_slopes(learned, agent):
    """Every part of the recurrent units and of the perceptrons that read their states."""
    found, want = learned
    assert found[agent].keys() == want[agent].keys() and len(found[agent]) == 15
    for name in want[agent]:
        np.testing.assert_allclose(found[agent][name], want[agent][name], rtol=2e-4, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("count", [3, 4, 5, 11])
def test_sequences_follow_each_other(count):
    """Rows of one environment, one env step apart, also across the end of the ring and never across its newest row."""
    capacity, envs_, length, steps = 24, 2, 3, 4
    time, where = np.full(capacity, -1), np.full(capacity, -1)
    for step in range(count * length):
        for k in range(envs_):
            row = (step * envs_ + k) % capacity
            time[row], where[row] = step, k
    written = replay.Written(capacity, envs_ * length, jnp.int32(count))
    size = int(replay.filled(*written))
    ages = np.arange(size - (steps - 1) * envs_)
    numbers = np.asarray(replay.following(written, jnp.asarray(ages), envs_, steps))
    assert numbers.shape == (len(ages), steps)
    np.testing.assert_array_equal(time[numbers], time[numbers[:, :1]] + np.arange(steps))
    np.testing.assert_array_equal(where[numbers], np.broadcast_to(where[numbers[:, :1]], numbers.shape))
    assert {(time[n[0]], where[n[0]]) for n in numbers} == {
        (t, k) for t in range(count * length - size // envs_, count * length - steps + 1) for k in range(envs_)
    }
