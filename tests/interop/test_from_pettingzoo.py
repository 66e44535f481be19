"""PettingZoo's environments as ours, against stepping them by hand with the same actions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from host_cases import Anything, Guess, Leaving

from matd3_jax import envs
from matd3_jax.envs import Box, Discrete, MultiDiscrete, OptionError


def played(env, actions, key=0):
    """States, and time steps, of one episode's actions (one tuple each), compiled."""
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    state, observation = reset(jax.random.key(key))
    steps, first = [], (state, observation)
    for action in actions:
        steps.append(step(jax.random.key(0), state, action))
        state = steps[-1].state
    return first, steps


def draw(env, number, seed=0):
    keys = jax.random.split(jax.random.key(seed), (number, len(env.agents)))
    return [tuple(space.sample(k) for space, k in zip(env.action_spaces, row, strict=True)) for row in keys]


# ---- against stepping by hand ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("continuous", [False, True])
def test_an_episode_of_mpe2(continuous):
    from mpe2 import simple_spread_v3

    kwargs = {"continuous_actions": continuous, "N": 2, "max_cycles": 6}
    env = envs.make("pettingzoo", id="mpe2.simple_spread_v3", kwargs=kwargs)
    envs.check(env)
    assert env.agents == ("agent_0", "agent_1") and env.episode_length == 6 and env.teams == ("agents", "agents")
    assert env.action_spaces == ((Box(5, -1.0, 1.0),) * 2 if continuous else (Discrete(5),) * 2)
    actions = draw(env, 6)
    (state, seen), steps = played(env, actions)
    own = simple_spread_v3.parallel_env(**kwargs)
    want, _ = own.reset(seed=int(state.seed))
    np.testing.assert_array_equal(np.concatenate(seen), np.concatenate([want[a] for a in env.agents]))
    for action, ts in zip(actions, steps, strict=True):
        given = [(np.asarray(a) + 1) / 2 if continuous else int(a) for a in action]
        want, reward, _, truncated, _ = own.step(dict(zip(env.agents, given, strict=True)))
        np.testing.assert_allclose(ts.observation, [want[a] for a in env.agents], atol=1e-6)
        np.testing.assert_allclose(ts.reward, [reward[a] for a in env.agents], rtol=1e-6)
        np.testing.assert_allclose(env.full_observation(ts.state), own.state(), atol=1e-6)
        assert bool(ts.truncated) == all(truncated.values()) and not ts.terminated
    assert ts.truncated and env.pool.used == 0


def test_episodes_follow_from_their_keys():
    env = envs.make("pettingzoo", id="mpe2.simple_tag_v3")
    observations = [env.reset(jax.random.key(key))[1][0] for key in (1, 2, 1)]
    np.testing.assert_array_equal(observations[0], observations[2])
    assert not np.array_equal(observations[0], observations[1])


def test_batches_of_batches_reset_where_episodes_end():
    env = envs.from_pettingzoo(Guess, episode_length=3)
    keys = jax.random.split(jax.random.key(0), (2, 4))
    both = jax.jit(jax.vmap(jax.vmap(env.step_or_reset)))
    state, seen = jax.jit(jax.vmap(jax.vmap(env.reset)))(keys)
    for t in range(1, 8):
        said = jax.random.uniform(jax.random.key(t), (2, 4, 2, 1), minval=-1.0, maxval=1.0)
        after, state, seen_next = both(
            keys, jax.random.split(jax.random.key(t), (2, 4)), state, (said[:, :, 0], said[:, :, 1])
        )
        numbers = np.stack([seen[0][..., 0], seen[1][..., 0]], axis=-1)
        np.testing.assert_allclose(after.reward, -np.abs(2 * (said[..., 0] + 1) - 2 * numbers), atol=1e-5)
        end = t % 3 == 0
        assert (np.asarray(after.truncated) == end).all() and not after.terminated.any()
        np.testing.assert_allclose(after.observation[0][..., 1], 0.3 if end else t % 3 / 10, atol=1e-6)
        np.testing.assert_allclose(seen_next[0][..., 1], 0.0 if end else t % 3 / 10, atol=1e-6)
        assert (np.asarray(state.step) == t % 3).all()
        seen = seen_next
    assert env.pool.used == 8 and len(np.unique(state.number)) == 8


# ---- agents that leave -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", [False, True], ids=["removed", "kept in agents"])
def test_agents_that_leave_see_nothing_and_get_nothing(keep):
    made = []

    def make():
        made.append(Leaving(keep=keep))
        return made[-1]

    env = envs.from_pettingzoo(make)
    (_, seen), steps = played(env, [(jnp.int32(0), jnp.int32(1), jnp.int32(2))] * 7)
    assert [float(o[0]) for o in seen] == [1, 1, 1]
    rewards = [ts.reward.tolist() for ts in steps]
    assert rewards == [[1, 1, 1], [1, 1, 1], [0, 1, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]]
    shown = [[float(o[0]) for o in ts.observation] for ts in steps]
    # What they see with their last reward is shown, nothing after it; after the end all stands still.
    assert shown == [[2, 2, 2], [3, 3, 3], [0, 4, 4], [0, 0, 5], [0, 0, 6], [0, 0, 6], [0, 0, 6]]
    assert [bool(ts.terminated) for ts in steps] == [False] * 4 + [True] * 3
    assert not any(ts.truncated for ts in steps)
    given = next(env_.given for env_ in made if env_.given)
    assert given[0] == {"first": 5, "second": 6, "third": 7} and len(given) == 5


@pytest.mark.parametrize(
    ("leave", "terminated", "truncated"),
    [
        (((1, False), (2, False), (2, False)), True, False),
        (((1, False), (2, True), (2, False)), False, True),
        (((2, True), (2, True), (2, True)), False, True),
    ],
)
def test_ends_are_told_apart(leave, terminated, truncated):
    _, steps = played(envs.from_pettingzoo(lambda: Leaving(leave)), [(jnp.int32(0),) * 3] * 2)
    assert not steps[0].terminated and not steps[0].truncated
    assert (bool(steps[1].terminated), bool(steps[1].truncated)) == (terminated, truncated)


def test_a_shorter_time_limit_truncates():
    _, steps = played(envs.from_pettingzoo(Leaving, episode_length=2), [(jnp.int32(0),) * 3] * 2)
    assert not steps[0].truncated and steps[1].truncated and not steps[1].terminated


# ---- spaces ----------------------------------------------------------------------------------------------------------

BOX = spaces.Box(np.float32([[-1, 0], [2, -3]]), np.float32([[1, 10], [3, -1]]))


@pytest.mark.parametrize(
    ("space", "ours", "played_", "given"),
    [
        (BOX, Box(4, -1.0, 1.0), [0.5, -1.0, 0.0, 1.0], [[0.5, 0.0], [2.5, -1.0]]),
        (BOX, Box(4, -1.0, 1.0), [np.nan, np.inf, 7.0, -7.0], [[0.0, 5.0], [3.0, -3.0]]),
        (spaces.Discrete(4, start=-1), Discrete(4), 3, 2),
        (spaces.MultiDiscrete([3, 2], start=[1, 0]), MultiDiscrete((3, 2)), [2, 1], [3, 1]),
        (spaces.MultiDiscrete([[3, 2], [2, 2]]), MultiDiscrete((3, 2, 2, 2)), [2, 1, 0, 1], [[2, 1], [0, 1]]),
        (spaces.MultiBinary(3), MultiDiscrete((2, 2, 2)), [1, 0, 1], [1, 0, 1]),
    ],
)
def test_actions(space, ours, played_, given):
    made = []

    def make():
        made.append(Anything(spaces.Box(-1, 1, (2,)), space))
        return made[-1]

    env = envs.from_pettingzoo(make)
    envs.check(env)
    assert env.action_spaces == (ours,)
    played(env, [(jnp.asarray(played_),)])
    (found,) = next(env_.given for env_ in made if env_.given)
    np.testing.assert_allclose(found, given, rtol=1e-6)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-5, 5, (2, 3), np.float64),
        spaces.Discrete(4, start=2),
        spaces.MultiDiscrete([3, 2]),
        spaces.MultiBinary(3),
        spaces.Tuple((spaces.Box(0, 1, (2,)), spaces.Discrete(3))),
        spaces.Dict({"b": spaces.Box(0, 1, (2,)), "a": spaces.MultiDiscrete([2, 2])}),
    ],
    ids=lambda space: type(space).__name__,
)
def test_observations_are_flattened_as_gymnasium_does(space):
    made = []

    def make():
        made.append(Anything(space, spaces.Discrete(2)))
        return made[-1]

    env = envs.from_pettingzoo(make)
    assert env.observation_sizes == (spaces.flatdim(space),) and env.full_observation_size == spaces.flatdim(space)
    (_, seen), steps = played(env, [(jnp.int32(1),)])
    own = next(env_ for env_ in made if env_.given)
    np.testing.assert_array_equal(seen[0], spaces.flatten(space, own.shown[-2]).astype(np.float32))
    np.testing.assert_array_equal(steps[0].observation[0], spaces.flatten(space, own.shown[-1]).astype(np.float32))


# ---- teams, states, instances ----------------------------------------------------------------------------------------


def test_teams():
    tag = envs.make("pettingzoo", id="mpe2.simple_tag_v3")
    assert tag.teams == ("adversaries",) * 3 + ("agents",) and tag.return_weights == (1.0,) * 4
    crypto = envs.make("pettingzoo", id="mpe2.simple_crypto_v3", adversaries=["eve_0"], shared_reward=True)
    assert dict(zip(crypto.agents, crypto.teams, strict=True))["eve_0"] == "adversaries"
    assert crypto.teams.count("agents") == 2 and crypto.return_weights == (1.0, 0.5, 0.5)
    with pytest.raises(OptionError, match="has no agent 'eve'; did you mean 'eve_0'"):
        envs.make("pettingzoo", id="mpe2.simple_crypto_v3", adversaries=["eve"])


def test_a_start_can_be_stepped_from_again_and_what_came_later_cannot():
    env = envs.from_pettingzoo(Guess)
    start, _ = env.reset(jax.random.key(3))
    said = [(jnp.full(1, x), jnp.zeros(1)) for x in (-0.5, 0.5)]
    one, other = (env.step(None, start, action) for action in said)
    np.testing.assert_array_equal(one.observation, other.observation)  # the same numbers come
    assert one.reward[0] != other.reward[0] and one.state.number != other.state.number
    further = [env.step(None, ts.state, said[0]) for ts in (one, other)]
    np.testing.assert_array_equal(further[0].observation, further[1].observation)
    again = env.step(None, one.state, said[0])  # the same question: answered, not stepped
    np.testing.assert_array_equal(again.reward, further[0].reward)
    with pytest.raises(Exception, match="Guess cannot be put back to an earlier state"):
        env.step(None, one.state, said[1])


def test_one_reset_for_a_whole_batch():
    """As cross-play has it: one key for all pairs of teams."""
    env = envs.from_pettingzoo(Guess)

    def two(said):
        state, _ = env.reset(jax.random.key(3))
        first = env.step(None, state, (said, said))
        return first.reward, env.step(None, first.state, (said, said)).reward

    together = jax.jit(jax.vmap(two))(jnp.array([[-0.5], [0.5]]))
    for i, said in enumerate((-0.5, 0.5)):
        np.testing.assert_array_equal([part[i] for part in together], two(jnp.array([said])))


def test_an_instance_is_copied_and_left_alone():
    instance = Guess()
    env = envs.from_pettingzoo(instance)
    played(env, draw(env, 2))
    assert not hasattr(instance, "t") and env.episode_length == 10


# ---- what is refused -------------------------------------------------------------------------------------------------


class Endless(Guess):
    max_cycles = None


class Masked(Guess):
    def observation_space(self, agent):
        return spaces.Dict({"observation": spaces.Box(0, 1), "action_mask": spaces.MultiBinary(2)})


class MaskedInfos(Guess):
    def reset(self, seed=None, options=None):
        return super().reset(seed)[0], {"a": {"action_mask": [1, 1]}}


class Uncopied(Guess):
    def __deepcopy__(self, memo):
        raise TypeError("no copies")


class Unseeded(Guess):
    def reset(self):
        return super().reset()


REFUSED = {
    "no seeds": (Unseeded, "Unseeded cannot be played: TypeError: "),
    "no time limit": (Endless, "give env.episode_length="),
    "masks": (Masked, "action_mask, which is not supported"),
    "masks in infos": (MaskedInfos, "action_mask, which is not supported"),
    "infinite": (lambda: Anything(BOX, spaces.Box(-np.inf, np.inf, (2,))), "has infinite bounds"),
    "integers": (lambda: Anything(BOX, spaces.Box(0, 9, (2,), np.int32)), "is a Box of int32"),
    "text": (lambda: Anything(BOX, spaces.Text(3)), "is Text; must be Box, Discrete"),
    "sequence": (lambda: Anything(spaces.Sequence(BOX), spaces.Discrete(2)), "has no flat form"),
    "no environment": (3, "neither an environment nor a function"),
    "makes none": (dict, "gives a dict, which has no parallel API"),
    "no copies": (Uncopied(), "cannot be copied (no copies)"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_taken_is_refused_in_a_line(what):
    source, words = REFUSED[what]
    with pytest.raises(OptionError) as error:
        envs.from_pettingzoo(source)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_turns_are_refused():
    from mpe2 import simple_spread_v3

    with pytest.raises(OptionError, match="convert it with pettingzoo.utils.aec_to_parallel"):
        envs.from_pettingzoo(simple_spread_v3.env)


IDS = {
    "": "must name a module with a parallel_env",
    "mpe2.simple_sprad_v3": "mpe2 has no simple_sprad_v3",
    "no_such_package.game": "there is no module no_such_package; pip install no_such_package",
    "json": "it has no parallel_env",
    "mpe2.simple_spread_v3:make": "mpe2.simple_spread_v3 has no make",
    "mpe2.simple_spread_v3:env": "which has no parallel API: convert it",
    "..": "cannot be imported",
}


@pytest.mark.parametrize("name", IDS)
def test_ids_that_are_none_are_refused_in_a_line(name):
    with pytest.raises(OptionError) as error:
        envs.make("pettingzoo", id=name)
    assert IDS[name] in str(error.value) and "\n" not in str(error.value)


def test_arguments_that_do_not_fit():
    with pytest.raises(OptionError, match="cannot be made with env.kwargs={'M': 3}: TypeError: .*'M'"):
        envs.make("pettingzoo", id="mpe2.simple_spread_v3", kwargs={"M": 3})
    with pytest.raises(OptionError, match="must be a group of keys"):
        envs.make("pettingzoo", id="mpe2.simple_spread_v3", kwargs=3)
    with pytest.raises(OptionError, match="hand a function"):
        envs.make("pettingzoo", id="mpe2.simple_spread_v3", kwargs={"N": np.zeros(2)})
    with pytest.raises(OptionError, match="did you mean 'adversaries'"):
        envs.from_pettingzoo(Guess, adversary=["a"])
    assert hash(envs.make("pettingzoo", id="host_cases", kwargs={"fail_at": 3})) != hash(
        envs.make("pettingzoo", id="host_cases:Guess")
    )
