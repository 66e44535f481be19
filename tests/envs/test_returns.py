"""Returns of random policies over many episodes, compared with those measured with the original programs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.envs import make

NUM_EPISODES = 4000

# Return of 25 steps: agent -> (mean, standard error), from 1000 episodes of openai/multiagent-particle-envs 83ba4d1
# ("orig": softmax of Gumbel noise, or uniform one-hot vectors) and 600 of mpe2 1.1.1 (uniform actions). Rounded to 0.1.
MEASURED = {
    ("simple_spread", "orig", "soft"): {0: (-224.4, 1.5)},
    ("simple_spread", "orig", "one-hot"): {0: (-231.1, 1.5)},
    ("simple_spread", "mpe2", "discrete"): {0: (-26.2, 0.3), 1: (-26.2, 0.3), 2: (-26.2, 0.3)},
    ("simple_spread", "mpe2", "continuous"): {0: (-24.6, 0.3), 1: (-24.6, 0.3), 2: (-24.6, 0.3)},
    ("simple_speaker_listener", "orig", "soft"): {0: (-71.5, 1.9), 1: (-71.5, 1.9)},
    ("simple_speaker_listener", "orig", "one-hot"): {0: (-80.3, 2.1), 1: (-80.3, 2.1)},
    ("simple_speaker_listener", "mpe2", "discrete"): {0: (-39.6, 1.3), 1: (-39.6, 1.3)},
    ("simple_speaker_listener", "mpe2", "continuous"): {0: (-36.4, 1.3), 1: (-36.4, 1.3)},
    ("simple_crypto", "orig", "soft"): {0: (-24.4, 0.1), 1: (0.0, 0.1), 2: (0.0, 0.1)},
    ("simple_crypto", "orig", "one-hot"): {0: (-37.5, 0.1), 1: (-0.2, 0.2), 2: (-0.2, 0.2)},
    ("simple_crypto", "mpe2", "discrete"): {0: (-37.4, 0.2), 1: (-0.4, 0.2), 2: (-0.4, 0.2)},
    ("simple_crypto", "mpe2", "continuous"): {0: (-33.5, 0.1), 1: (0.2, 0.2), 2: (0.2, 0.2)},
    ("simple_push", "orig", "soft"): {0: (0.8, 0.5), 1: (-27.3, 0.4)},
    ("simple_push", "orig", "one-hot"): {0: (0.6, 0.6), 1: (-28.3, 0.4)},
    ("simple_push", "mpe2", "discrete"): {0: (0.0, 0.7), 1: (-28.3, 0.5)},
    ("simple_push", "mpe2", "continuous"): {0: (0.9, 0.7), 1: (-26.8, 0.5)},
    ("simple_adversary", "orig", "soft"): {0: (-35.8, 0.9), 1: (7.4, 0.5), 2: (7.4, 0.5)},
    ("simple_adversary", "orig", "one-hot"): {0: (-39.4, 1.1), 1: (7.0, 0.5), 2: (7.0, 0.5)},
    ("simple_adversary", "mpe2", "discrete"): {0: (-27.9, 0.5), 1: (7.1, 0.6), 2: (7.1, 0.6)},
    ("simple_adversary", "mpe2", "continuous"): {0: (-27.9, 0.5), 1: (7.2, 0.7), 2: (7.2, 0.7)},
    ("simple_tag", "orig", "soft"): {0: (1.9, 0.2), 2: (1.9, 0.2), 3: (-8.1, 0.4)},
    ("simple_tag", "orig", "one-hot"): {0: (3.0, 0.3), 2: (3.0, 0.3), 3: (-14.5, 0.6)},
    ("simple_tag", "mpe2", "discrete"): {0: (4.9, 0.4), 2: (4.9, 0.4), 3: (-17.0, 0.8)},
    ("simple_tag", "mpe2", "continuous"): {0: (3.9, 0.4), 2: (3.9, 0.4), 3: (-11.2, 0.7)},
    ("simple", "mpe2", "discrete"): {0: (-39.3, 1.4)},
    ("simple_reference", "mpe2", "discrete"): {0: (-28.5, 0.4), 1: (-28.3, 0.4)},
    ("simple_reference", "mpe2", "continuous"): {0: (-27.0, 0.4), 1: (-27.0, 0.4)},
    ("simple_world_comm", "mpe2", "discrete"): {0: (3.1, 0.3), 3: (3.0, 0.3), 4: (-24.6, 1.4), 5: (-25.5, 1.3)},
}


@functools.cache
def rollout(env):
    def play(keys, actions):
        state, _ = jax.vmap(env.reset)(keys)

        def step(carry, action):
            state, total = carry
            ts = jax.vmap(env.step, in_axes=(None, 0, 0))(keys[0], state, action)
            return (ts.state, total + ts.reward), ts.truncated

        (_, total), truncated = jax.lax.scan(step, (state, jnp.zeros((len(keys), len(env.agents)))), actions)
        return total, truncated

    return jax.jit(play)


def random_actions(env, policy, rng):
    """Per agent [time, episode, ...]."""
    shape = (env.episode_length, NUM_EPISODES)
    if policy == "discrete":
        return tuple(
            rng.integers(space.sizes, size=(*shape, len(space.sizes)), dtype=np.int32).reshape(*shape, *space.shape)
            for space in env.action_spaces
        )
    if policy == "continuous":
        return tuple(rng.uniform(size=(*shape, space.size)).astype(np.float32) for space in env.action_spaces)
    if policy == "one-hot":
        return tuple(
            np.eye(space.size, dtype=np.float32)[rng.integers(space.size, size=shape)] for space in env.action_spaces
        )
    weights = [1 / rng.exponential(size=(*shape, space.size)) for space in env.action_spaces]  # exp(Gumbel noise)
    return tuple((w / w.sum(axis=-1, keepdims=True)).astype(np.float32) for w in weights)


@pytest.mark.slow
@pytest.mark.parametrize("case", MEASURED, ids="-".join)
def test_random_policy(case):
    name, rules, policy = case
    env = make(name, rules=rules, actions="soft" if policy == "one-hot" else policy)
    rng = np.random.default_rng(list(MEASURED).index(case))
    keys = jax.random.split(jax.random.key(rng.integers(2**31)), NUM_EPISODES)
    total, truncated = jax.tree.map(np.asarray, rollout(env)(keys, random_actions(env, policy, rng)))
    assert truncated[-1].all() and not truncated[:-1].any()
    for agent, (mean, error) in MEASURED[case].items():
        ours, our_error = total[:, agent].mean(), total[:, agent].std() / np.sqrt(NUM_EPISODES)
        # Four standard errors of the difference; both printed figures may be 0.05 off by rounding.
        allowed = 4 * np.hypot(error + 0.05, our_error) + 0.05
        assert abs(ours - mean) < allowed, f"{env.agents[agent]}: {ours:.2f} +- {our_error:.2f}, measured {mean}"
