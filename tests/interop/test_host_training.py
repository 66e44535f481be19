"""Whole runs with environments that are stepped in Python on the host, seeds over two CPU devices."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_cases import Guess

import matd3_jax
from matd3_jax import config, envs
from matd3_jax.cli import command, train
from matd3_jax.core import rollout
from matd3_jax.envs.host.pool import Pool
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play, trajectory
from matd3_jax.runtime.multihost import SINGLE_PROCESS
from matd3_jax.training import checkpoint, host_states
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SMALL = {
    **{"total_steps": 240, "learning_starts": 80, "num_envs": 2, "rollout_length": 7, "batch_size": 16},
    **{"replay_capacity": 560, "log_every": 56, "eval_every": 56, "eval_episodes": 2, "checkpoint_minutes": 0},
}
LINES = [f"{key}={value}" for key, value in SMALL.items()] + ["algo.hidden=[8]"]


def guess(**options):
    return envs.from_pettingzoo(Guess, **options)


@pytest.fixture(scope="module")
def three():
    """Three seeds on two devices, the second with a copy of the last seed."""
    assert len(jax.devices()) >= 2
    return matd3_jax.train("algo.hidden=[8]", env=guess(), seeds=3, seed=1, **SMALL)


def rows_of(result, seed):
    filled = result.training.trainer.schedule.filled_rows(int(result.state.rollouts))
    assert filled == result.training.total_steps  # nothing was overwritten
    parts = result.training.layout.row_parts(np.asarray(result.state.replay)[seed, :filled])
    return parts.x, parts.action, parts.reward, parts.next_x, parts.discount


def test_the_replay_holds_what_the_environment_did(three):
    """Every row keeps the environment's rules, and each environment's rows follow each other."""
    for seed in range(3):
        x, action, reward, next_x, discount = rows_of(three, seed)
        np.testing.assert_allclose(reward, -np.abs(2 * (action + 1) - 2 * x[:, [0, 2]]), atol=1e-5)
        # [rollouts, steps, environments], one environment's rows one after another.
        own, after = (np.stack(part.reshape(-1, 7, 2, 4).swapaxes(1, 2), axis=0) for part in (x, next_x))
        own, after = (part.swapaxes(0, 1).reshape(2, -1, 4) for part in (own, after))
        t = np.round(10 * own[..., 1]).astype(int)
        np.testing.assert_allclose(t, np.broadcast_to(np.arange(t.shape[1]) % 10, t.shape))
        np.testing.assert_allclose(after[..., 1], (t + 1) / 10, atol=1e-6)  # the true last observation, too
        going = t[:, 1:] > 0
        np.testing.assert_array_equal(own[:, 1:][going], after[:, :-1][going])
        assert (own[:, 1:][~going] != after[:, :-1][~going]).any()
        assert (discount > 0).all()  # a time limit: bootstrapped
        starts = own[..., 0][t == 0]
        assert len(np.unique(starts)) == len(starts) > 20
    assert not np.array_equal(rows_of(three, 0)[0], rows_of(three, 1)[0])


def test_a_seed_is_the_same_with_others_and_alone():
    """To the bit, with random actions: the environments of a seed do not depend on which device steps them."""
    lines = [f"{key}={value}" for key, value in SMALL.items()]
    replays = []
    for seeds, seed in ((3, 0), (1, 1)):
        settings = config.load([*lines, "warmup=random", f"seeds={seeds}", f"seed={seed}"])
        training = TrainingSession(settings, guess())
        assert training.trainer.sharding.devices_per_seed == 1
        state, _ = training.trainer.warm_up(training.trainer.init(training.keys()))
        replays.append(np.asarray(state.replay)[:, :70])
    assert len(replays[0]) == 4  # a copy of the last seed, which plays in environments of its own
    np.testing.assert_array_equal(replays[0][1], replays[1][0])
    np.testing.assert_array_equal(replays[0][2], replays[0][3])
    assert not np.array_equal(replays[0][0], replays[0][1])


def test_evaluations_play_whole_episodes_of_their_own(three):
    used = three.training.env.pool.used
    assert used == 4 * 2  # the environments of training: those of evaluations are given back
    assert (three.metrics["eval_episode_length"][:, -1] == 10).all()
    first, second = (three.evaluate(episodes=3) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert three.training.env.pool.used == used
    played = trajectory.play(three.training, three.state, seed=2, number=1)
    assert played.length == 10 and played.truncated
    np.testing.assert_allclose(played.returns["agents"][-1], first[2, 1].sum(), rtol=1e-5)


def test_q_bias_is_refused():
    with pytest.raises(UserError, match="diagnostics.q_bias=true puts environments back"):
        matd3_jax.train("diagnostics.q_bias=true", env=guess(), **SMALL)


def test_a_team_as_one_agent():
    env = JointTeam(guess(episode_length=2))
    assert env.on_host and env.agents == ("agents",) and env.observation_sizes == (4,)
    (state, (x,)), key = env.reset(jax.random.key(0)), jax.random.key(1)
    for t in (1, 2, 3):
        after, state, (seen,) = env.step_or_reset(key, key, state, (jnp.array([0.5, -0.5]),))
        np.testing.assert_allclose(
            after.reward, [-np.abs(np.array([3, 1]) - 2 * np.asarray(x)[[0, 2]]).mean()], rtol=1e-5
        )
        assert bool(after.truncated) == (t == 2) and after.observation[0].shape == (4,)
        assert float(seen[1]) == pytest.approx(t % 2 / 10)
        x = seen


def test_cross_play():
    """Pairs that were trained together return what their run's sampled evaluation would, each in its own copies."""
    env = envs.from_pettingzoo(lambda: Guess(names=("adversary_0", "agent_0")))
    result = matd3_jax.train("algo.hidden=[8]", env=env, seeds=2, **SMALL)
    teams = [cross_play.team_of(result.training, env, result.state, team) for team in cross_play.TEAMS]
    pairs = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    used = env.pool.used
    returns = cross_play.play(env, teams, pairs, episodes=3, deterministic=True)
    np.testing.assert_allclose(returns[[0, 3]], result.evaluate(episodes=3).mean(axis=1), rtol=1e-5)
    # Nobody's reward depends on the other: who plays decides alone.
    np.testing.assert_allclose(returns[:, 1], returns[[0, 0, 2, 2], 1], rtol=1e-5)
    assert env.pool.used <= used + 2  # of the resets that several pairs shared


# ---- resuming --------------------------------------------------------------------------------------------------------


def trained(*words):
    return command.code(train.main, [*LINES, *words])


@pytest.fixture(scope="module")
def pickled(tmp_path_factory):
    """A run to the end, and the same run stopped at its half."""
    folder = tmp_path_factory.mktemp("pickled")
    words = ("env=pettingzoo", "env.id=host_cases", "env.pickle=true", "seeds=3", f"out={folder}", "eval_every=0")
    assert trained("name=whole", *words) == 0
    assert trained("name=half", "total_steps=130", *words) == 0
    return folder


def final(run):
    return (run / "metrics.csv").read_text().splitlines()[-3:]


def copied(pickled, name):
    shutil.copytree(pickled / "half", pickled / name)
    return pickled / name


def test_a_run_with_its_environments_pickled_is_resumed_to_the_bit(pickled, capfd):
    run = copied(pickled, "trusted")
    assert command.code(train.main, [f"resume={run}", "total_steps=240", "env.pickle=true"]) == 0
    assert "start anew" not in capfd.readouterr().out
    whole, resumed = (checkpoint.verify(path / "checkpoints") for path in (pickled / "whole", run))
    assert whole.name == resumed.name and final(pickled / "whole") == final(run)


@pytest.fixture
def loaded(monkeypatch):
    """How many environments each load brought; one when pickling is tried, before anything is trained."""
    found = []
    load = Pool.load
    monkeypatch.setattr(Pool, "load", lambda pool, dumped: found.append(len(dumped)) or load(pool, dumped))
    return found


def test_pickles_are_loaded_only_when_that_is_said_again(pickled, loaded):
    run = copied(pickled, "untrusted")
    with pytest.warns(
        RuntimeWarning, match="episodes of pettingzoo host_cases start anew.*give env.pickle=true once more"
    ):
        resumed = matd3_jax.resume(run, total_steps=240)
    assert loaded == [1] and final(run) != final(pickled / "whole")
    x, *_ = rows_of(resumed, 0)
    t = np.round(10 * x[:, 1]).astype(int).reshape(-1, 7, 2)
    fresh = [rollout for rollout in range(1, len(t)) if t[rollout, 0, 0] != (t[rollout - 1, -1, 0] + 1) % 10]
    assert len(fresh) == 1 and t[fresh[0], 0].tolist() == [0, 0]  # where it was resumed


def test_a_damaged_pickle_is_found_before_it_is_loaded(pickled, loaded, capfd):
    run = copied(pickled, "damaged")
    last = checkpoint.verify(run / "checkpoints")
    file = last / "host" / "2" / "environments.pickle"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    assert command.code(train.main, [f"resume={run}", "total_steps=240", "env.pickle=true"]) == 2
    assert "is damaged (host/2/environments.pickle)" in capfd.readouterr().err and loaded == [1]


def test_what_is_said_without_pickles(three, tmp_path):
    trainer = three.training.trainer
    (line,) = host_states.notes(tmp_path, trainer, unpickle=True)
    assert line.startswith("note: the episodes of Guess start anew: the checkpoint does not hold them")
    assert host_states.save(tmp_path, trainer, three.state, SINGLE_PROCESS.share(3)) == []


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("pettingzoo", {"id": "mpe2.simple_tag_v3"}),
        ("gymnasium", {"id": "Hopper-v5", "split": "3x1"}),
        ("gymnasium", {"id": "CartPole-v1"}),
    ],
    ids=["mpe2", "mujoco", "classic"],
)
def test_pickles_keep_where_environments_are(name, options):
    """Though they are EzPickles, which forget it: both go on alike, over the end of an episode, too."""
    env = envs.make(name, pickle=True, episode_length=6, **options)
    keys = jax.random.split(jax.random.key(0), 2)
    step = jax.jit(jax.vmap(env.step_or_reset))
    state, _ = jax.vmap(env.reset)(keys)
    actions = [tuple(jax.vmap(space.sample)(jax.random.split(jax.random.key(t), 2)) for space in env.action_spaces)
               for t in range(9)]  # fmt: skip
    for action in actions[:4]:
        _, state, _ = step(keys, keys, state, action)
    other = state._replace(number=env.load(env.dump(np.asarray(state.number))))
    assert not set(np.asarray(other.number)) & set(np.asarray(state.number))
    for action in actions[4:]:
        one, state, seen = step(keys, keys, state, action)
        two, other, seen_ = step(keys, keys, other, action)
        for a, b in zip(jax.tree.leaves((one[1:], seen)), jax.tree.leaves((two[1:], seen_)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_what_cannot_be_pickled_is_refused_before_training():
    class Local(Guess):
        def __getstate__(self):
            raise TypeError("not me")

    with pytest.raises(envs.OptionError, match="env.pickle=true: .*Local cannot be pickled .*not me"):
        envs.from_pettingzoo(Local, pickle=True)
    with pytest.raises(envs.OptionError, match="cannot be pickled .*lambda.*; leave it false"):
        kwargs = {"scenario": "Ant", "agent_conf": "2x4"}
        envs.make("pettingzoo", id="gymnasium_robotics.mamujoco_v1", kwargs=kwargs, pickle=True)


# ---- on the command line ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["env=pettingzoo"], "error: id=None: must name a module with a parallel_env"),
        (["env=pettingzoo", "env.id=no_such_module"], "error: env.id=no_such_module: there is no module"),
        (["env=gymnasium", "env.id=Ant-v5", "env.split=9x9"], "error: split='9x9': an action has 8 entries"),
        (["env=pettingzoo", "env.id=host_cases", "diagnostics.q_bias=true"], "error: diagnostics.q_bias=true puts"),
    ],
)
def test_bad_ids_are_one_line_and_leave_nothing(words, told, tmp_path, capfd):
    assert trained(*words, f"out={tmp_path}") == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith(told.replace("id=None", "env.id=None"))
    assert not list(tmp_path.iterdir())


def test_what_an_environment_raises_ends_in_one_line(tmp_path, capfd):
    words = ["env=pettingzoo", "env.id=host_cases", "env.kwargs.fail_at=5", f"out={tmp_path}", "name=r", "seeds=2"]
    assert trained(*words) == 2
    last = capfd.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("error: pettingzoo host_cases: step raised ZeroDivisionError: it was to fail")


def test_it_learns():
    """Two numbers to be said, by their rewards alone: an untrained pair loses some 20 an episode, this one less than
    half of that after so short a training (3.6 and 6.9 here)."""
    small = {"total_steps": 8000, "learning_starts": 500, "num_envs": 4, "rollout_length": 5, "batch_size": 64}
    small |= {"log_every": 1000, "eval_every": 4000, "replay_capacity": 8000}
    result = matd3_jax.train("algo.hidden=[32]", "algo.lr=0.003", "algo.gamma=0.1", env=guess(), seeds=2, **small)
    returns = result.metrics["eval_return_agents"]
    assert (returns[:, 0] < -12).all() and (returns[:, -1] > returns[:, 0] / 2).all(), returns


def test_the_loop_of_other_environments_is_as_it_was():
    """They reset whole batches beforehand: nothing in their program calls the host."""
    env = envs.make("simple_spread")
    assert not env.on_host
    text = str(jax.make_jaxpr(lambda k: rollout.start(env, k, 2))(jax.random.key(0)))
    assert "callback" not in text
