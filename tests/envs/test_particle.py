"""What holds for all particle tasks: resets, actions, contacts, batches, gradients."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.envs import Box, Discrete, MultiDiscrete, Simplex, make
from matd3_jax.envs.particle.world import choose, others, softplus

TASKS = (
    "simple_spread",
    "simple_speaker_listener",
    "simple_crypto",
    "simple_push",
    "simple_adversary",
    "simple_tag",
    "simple",
    "simple_reference",
    "simple_world_comm",
)


def sample(env, key):
    """A random action of every agent."""
    return tuple(space.sample(jax.random.fold_in(key, i)) for i, space in enumerate(env.action_spaces))


@pytest.mark.parametrize("name", TASKS)
def test_reset_distribution(name):
    """Uniform places (mean, variance and range), uniform independent goals and keys, all at rest."""
    env, n = make(name), 6000
    state, observation = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), n))
    for place, bound in (
        (state.pos, 1.0),
        (state.landmark, 0.9 if name in ("simple_tag", "simple_world_comm") else 1.0),
    ):
        place = np.asarray(place, np.float64)
        assert np.abs(place).max() <= bound and np.abs(place).max() > 0.99 * bound
        # Standard errors of mean and mean square of a uniform variable on [-b, b]; 5 of them over some 20 columns.
        assert np.abs(place.mean(axis=0)).max() < 5 * bound / np.sqrt(3 * n)
        assert np.abs((place**2).mean(axis=0) - bound**2 / 3).max() < 5 * bound**2 * np.sqrt(4 / 45 / n)
        flat = place.reshape(n, -1)
        assert np.abs(np.corrcoef(flat.T) - np.eye(flat.shape[1])).max() < 5 / np.sqrt(n)
    assert not np.any(state.vel) and not np.any(state.step)
    assert (state.comm is None) == (not env.dim_c)
    assert state.comm is None or not np.any(state.comm)
    for index, count in ((state.goal, env.num_goals), (state.key, env.num_keys)):
        assert (index is None) == (count == 0)
        if index is not None:
            assert index.shape == (n, *env.goal_shape)
            for one in np.reshape(index, (n, -1)).T:
                share = np.bincount(one, minlength=count) / n
                assert share.shape == (count,) and np.abs(share - 1 / count).max() < 5 * np.sqrt(0.25 / n)
    if name == "simple_crypto":
        assert abs(np.corrcoef(state.goal, state.key)[0, 1]) < 5 / np.sqrt(n)
    if name == "simple_reference":
        assert abs(np.corrcoef(np.transpose(state.goal))[0, 1]) < 5 / np.sqrt(n)
    if name in ("simple_tag", "simple_crypto", "simple_reference"):
        # Not bit for bit: reset and observe are compiled apart and may round differently.
        chex.assert_trees_all_close(observation, jax.jit(jax.vmap(env.observe))(state), atol=1e-6)


@pytest.mark.parametrize("rules", ["orig", "mpe2"])
@pytest.mark.parametrize("name", TASKS)
def test_sizes_and_spaces(name, rules):
    table = {
        "simple_spread": ((18, 18, 18), (5, 5, 5)),
        "simple_speaker_listener": ((3, 11), (3, 5)),
        "simple_crypto": ((4, 8, 8), (4, 4, 4)),
        "simple_push": ((8, 19), (5, 5)),
        "simple_adversary": ((8, 10, 10), (5, 5, 5)),
        "simple_tag": ((16, 16, 16, 14), (5, 5, 5, 5)),
        "simple": ((4,), (5,)),
        "simple_reference": ((21, 21), ((5, 10), (5, 10))),
        "simple_world_comm": ((34, 34, 34, 34, 28, 28), ((5, 4), 5, 5, 5, 5, 5)),
    }
    sizes, choices = table[name]
    env = make(name, rules=rules)
    assert env.observation_sizes == sizes and env.full_observation_size == sum(sizes)
    parts = [n if isinstance(n, tuple) else (n,) for n in choices]
    assert env.action_spaces == tuple(map(Simplex, parts))
    discrete = tuple(MultiDiscrete(n) if isinstance(n, tuple) else Discrete(n) for n in choices)
    assert make(name, rules=rules, actions="discrete").action_spaces == discrete
    boxes = tuple(
        Box(2 + sum(n[1:]), -1.0, 1.0) if moves and rules == "orig" else Box(sum(n), 0.0, 1.0)
        for n, moves in zip(parts, env.world.movable, strict=True)
    )
    assert make(name, rules=rules, actions="continuous").action_spaces == boxes
    assert len(env.teams) == len(env.agents) and env.return_weights == (1.0,) * len(env.agents)
    for agent, team in zip(env.agents, env.teams, strict=True):
        assert (team == "adversaries") == agent.startswith(("adversary", "leadadversary", "eve"))


@pytest.mark.parametrize("name", ["simple_spread", "simple_speaker_listener", "simple_tag", "simple_reference"])
def test_single_equals_vmap_and_full_observation(name):
    env, key = make(name), jax.random.key(1)
    keys = jax.random.split(key)
    state, _ = jax.jit(jax.vmap(env.reset))(keys)
    action = jax.vmap(lambda k: sample(env, k))(keys)
    batch = jax.jit(jax.vmap(env.step, in_axes=(None, 0, 0)))(key, state, action)
    step, full = jax.jit(env.step), jax.jit(env.full_observation)
    for i in range(2):
        one_state, one_action, want = jax.tree.map(lambda x: x[i], (state, action, batch))  # noqa: B023
        one = step(key, one_state, one_action)
        chex.assert_trees_all_close(one, want, atol=1e-5)
        np.testing.assert_array_equal(full(one.state), np.concatenate(one.observation))
        assert full(one.state).shape == (env.full_observation_size,)


def test_equal_instances_compile_once():
    traces = []

    def step(env, state, action):
        traces.append(env)
        return env.step(None, state, action)

    program = jax.jit(step, static_argnums=0)
    env, same = make("simple_push"), make("simple_push", episode_length=25)
    longer = make("simple_push", episode_length=39)
    assert env == same and hash(env) == hash(same) and env != longer and env is not same
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    for step_ in range(3):
        state = program(env if step_ else same, state, sample(env, jax.random.key(step_))).state
    assert len(traces) == 1
    program(longer, state, sample(env, jax.random.key(0)))
    assert len(traces) == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        env.rules = "mpe2"


def test_episode_length():
    env = make("simple_push", episode_length=3)
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    ends = []
    for _ in range(3):
        ts = step(jax.random.key(0), state, sample(env, jax.random.key(0)))
        state = ts.state
        ends.append((bool(ts.truncated), bool(ts.terminated)))
    assert ends == [(False, False), (False, False), (True, False)]


@pytest.mark.parametrize(
    ("name", "rules"), [*((name, "orig") for name in TASKS), ("simple_spread", "mpe2"), ("simple_adversary", "mpe2")]
)
def test_finite_when_everything_coincides(name, rules):
    """Agents and landmarks all at one point: values and slopes are finite (the originals divide by zero)."""
    env = make(name, rules=rules)
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    state = state._replace(pos=jnp.full_like(state.pos, 0.25), landmark=jnp.full_like(state.landmark, 0.25))
    still = tuple(jnp.zeros(space.size) for space in env.action_spaces)

    def total(pos, vel, action):
        ts = env.step(None, state._replace(pos=pos, vel=vel), action)
        return sum(map(jnp.sum, ts.observation)) + jnp.sum(ts.reward), ts

    slopes, ts = jax.jit(jax.grad(total, argnums=(0, 1, 2), has_aux=True))(state.pos, state.vel, still)
    chex.assert_tree_all_finite((slopes, ts))
    np.testing.assert_array_equal(ts.state.pos, state.pos)  # nobody is pushed anywhere
    if rules == "orig" and name != "simple_crypto":
        assert np.any(slopes[2][-1])  # the action does have an influence on this step


def test_contact_force_by_hand():
    """Two agents 0.01 inside each other: 100 * softplus(0.01 / 0.001) * 0.001 apart along the line between them."""
    env = make("simple_push")
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    pos = jnp.array([[0.0, 0.0], [0.054, 0.072]])  # 0.09 apart, radii 0.05 each
    force = env.world.contact_force(pos, state.landmark)
    size = 100 * 0.001 * np.logaddexp(0, 10)
    np.testing.assert_allclose(force, [[-0.6 * size, -0.8 * size], [0.6 * size, 0.8 * size]], rtol=1e-5)
    still = (jnp.zeros(5), jnp.zeros(5))
    ts = env.step(None, state._replace(pos=pos), still)
    np.testing.assert_allclose(ts.state.vel, 0.1 * force, rtol=1e-5)
    np.testing.assert_allclose(ts.state.pos, pos + 0.1 * ts.state.vel, rtol=1e-5)
    ts = make("simple_push", rules="mpe2").step(None, state._replace(pos=pos), still)
    np.testing.assert_allclose(ts.state.vel, 0.1 * force, rtol=1e-5)
    np.testing.assert_array_equal(ts.state.pos, pos)  # mpe2 moves with the old velocity


def test_orig_actions_agree():
    """The original's three kinds of action: same control, signs of the integers opposite to the vector's."""
    soft, discrete, box = (make("simple_speaker_listener", actions=a) for a in ("soft", "discrete", "continuous"))
    state, _ = jax.jit(soft.reset)(jax.random.key(0))
    words = jnp.eye(3)
    controls = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
    for integer, (vector_entry, control) in enumerate(zip((0, 2, 1, 4, 3), controls, strict=True)):
        word = integer % 3
        with_vector = soft.step(None, state, (words[word], jnp.eye(5)[vector_entry]))
        with_integer = discrete.step(None, state, (jnp.int32(word), jnp.int32(integer)))
        with_box = box.step(None, state, (words[word], jnp.array(control, jnp.float32)))
        chex.assert_trees_all_close(with_vector, with_integer, with_box, atol=1e-6)
        np.testing.assert_allclose(with_vector.state.vel[1], 0.1 * 5 * np.array(control), atol=1e-6)
        np.testing.assert_array_equal(with_vector.state.comm, [words[word], np.zeros(3)])


def test_orig_movers_that_speak():
    """The three kinds of action of one that does both: same movement, same word."""
    soft, discrete, box = (make("simple_reference", actions=a) for a in ("soft", "discrete", "continuous"))
    state, _ = jax.jit(soft.reset)(jax.random.key(0))
    steps = [jax.jit(env.step) for env in (soft, discrete, box)]
    for move, entry, force in ((1, 2, [-1, 0]), (4, 3, [0, 1])):
        for word in (0, 9):
            said = jnp.eye(10)[word]
            actions = (
                jnp.concatenate([jnp.eye(5)[entry], said]),
                jnp.array([move, word], jnp.int32),
                jnp.concatenate([jnp.array(force), 2 * said - 1]),
            )
            still = (jnp.zeros(15), jnp.zeros(2, jnp.int32), jnp.array([0.0, 0.0] + [-1.0] * 10))
            ends = [step(None, state, (a, s)) for step, a, s in zip(steps, actions, still, strict=True)]
            for end in ends:
                np.testing.assert_allclose(end.state.vel, [0.5 * np.array(force), [0, 0]], atol=1e-6)
                np.testing.assert_array_equal(end.state.comm[0], said)
                np.testing.assert_array_equal(end.observation[1][-10:], said)


def test_mpe2_soft_is_its_continuous_action():
    for name in ("simple_tag", "simple_speaker_listener", "simple_reference"):
        soft, box = (make(name, rules="mpe2", actions=a) for a in ("soft", "continuous"))
        state, _ = jax.jit(soft.reset)(jax.random.key(4))
        action = jax.jit(lambda key: sample(soft, key))(jax.random.key(5))  # noqa: B023
        got, want = jax.jit(soft.step)(None, state, action), jax.jit(box.step)(None, state, action)
        chex.assert_trees_all_close(got, want, atol=1e-6)
        assert np.abs(got.state.vel[-1]).max() > 0.01


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("simple_spread", {"num_agents": 1}),
        ("simple_spread", {"num_agents": 2, "rules": "mpe2", "local_ratio": 1}),
        ("simple_adversary", {"num_good": 1}),
        ("simple_tag", {"num_adversaries": 1, "num_good": 1, "num_obstacles": 0}),
        ("simple_tag", {"num_adversaries": 1, "num_good": 4, "num_obstacles": 5}),
        ("simple_reference", {"rules": "mpe2", "local_ratio": 0, "actions": "discrete"}),
        ("simple_world_comm", {"num_adversaries": 1, "num_good": 1, "num_obstacles": 0, "num_food": 1}),
        ("simple_world_comm", {"num_forests": 0, "actions": "continuous"}),
        ("simple_world_comm", {"num_adversaries": 2, "num_good": 3, "num_forests": 1, "actions": "discrete"}),
    ],
)
def test_smallest_and_odd_counts(name, options):
    env = make(name, **options)

    @jax.jit
    def play(key):
        state, observation = env.reset(key)
        return observation, env.step(None, state, sample(env, key))

    observation, ts = play(jax.random.key(0))
    assert tuple(map(len, observation)) == env.observation_sizes == tuple(map(len, ts.observation))
    assert ts.reward.shape == (len(env.agents),)
    chex.assert_tree_all_finite(ts)


def test_helpers():
    pairs = np.arange(4 * 4 * 2).reshape(4, 4, 2)
    want = np.stack([np.delete(row, i, axis=0) for i, row in enumerate(pairs)])
    np.testing.assert_array_equal(others(jnp.asarray(pairs)), want)
    rows = jnp.array([[1.5, -2.0], [0.1, 7.0], [3.0, 4.0]])
    for i in range(3):
        np.testing.assert_array_equal(choose(jnp.int32(i), rows), rows[i])
    np.testing.assert_array_equal(choose(jnp.array([2, 0, 2]), rows), rows[jnp.array([2, 0, 2])])
    with jax.enable_x64(True):
        x = np.r_[np.linspace(-40, 40, 4001), -1e4, 1e4]
        np.testing.assert_allclose(softplus(jnp.asarray(x)), np.logaddexp(x, 0), rtol=0, atol=2e-13)
        slope = jax.vmap(jax.grad(softplus))(jnp.asarray(x))
        np.testing.assert_allclose(slope, np.exp(-np.logaddexp(0, -x)), rtol=0, atol=1e-10)
