"""Cross-play: episodes against NumPy policies and against `Training.evaluate`, the command's files, bad input."""

import csv
import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers
from ledger import Ledger

from matd3_jax import checkpoint, config, crossplay, encounter, envs
from matd3_jax.errors import UserError
from matd3_jax.normalisation import Statistics
from matd3_jax.pairings import pairs_of
from matd3_jax.paths import paths
from matd3_jax.runs import RunDirectory
from matd3_jax.training import Training

pytestmark = pytest.mark.usefixtures("quick_jit")

STEPS, SEED = 5, 11
SMALL = [
    "env=simple_adversary", f"env.episode_length={STEPS}", "batch_size=8", "num_envs=2", "rollout_length=5",
    "learning_starts=20", "replay_capacity=100", "total_steps=100", "algo.hidden=[5]",
]  # fmt: skip
RUNS = {
    # Two networks of different sizes; all of one size; a joint team on both sides; statistics of both kinds.
    "mixed": ["algo=matd3", "adversary=maddpg", "adversary.hidden=[4,4]", "seeds=3"],
    "normal": ["algo=iltd3", "normalise_observations=true", "seeds=2", "seed=7"],
    "joint": ["algo=td3", "adversary=iddpg", "normalise_observations=true", "seeds=3"],
    "plain": ["algo=maddpg", "seeds=3", "seed=4"],
}


class Run(NamedTuple):
    training: Training
    state: object

    def team(self, name):
        base = self.training.env.env if hasattr(self.training.env, "env") else self.training.env
        return encounter.team_of(self.training, base, self.state, name)


def make(settings, env=None, number=0):
    """A run whose policies (biases too) and statistics are random: of which training they come does not matter."""
    training, rng = Training(config.load(settings), env), np.random.default_rng(number)
    trainer = training.trainer
    shapes = trainer.abstract_state()
    groups = jax.tree.map(lambda leaf: rng.normal(0, 0.5, leaf.shape).astype(leaf.dtype), shapes.groups)
    statistics = shapes.statistics
    if statistics is not None:
        mean, variance = rng.normal(size=(2, *statistics.mean.shape)).astype(np.float32)
        statistics = Statistics(mean, np.exp(variance))
    return Run(
        training,
        shapes._replace(
            groups=groups,
            env=jax.tree.map(lambda shape: np.zeros(shape.shape, shape.dtype), shapes.env),
            replay=jnp.zeros((trainer.rows, trainer.schedule.replay_capacity, training.spec.row_size)),
            key=trainer.fill(training.keys()),
            collects=jnp.int32(2),
            statistics=statistics,
        ),
    )


@pytest.fixture(scope="module")
def runs():
    return {name: make([*SMALL, *more], number=k) for k, (name, more) in enumerate(RUNS.items())}


ENV = envs.make("simple_adversary", episode_length=STEPS)
OWN = np.stack([np.arange(3)] * 2, axis=1)


def meet(runs, one, two, pairs, episodes=4, deterministic=True, seed=SEED, env=ENV):
    teams = [runs[one].team("agents"), runs[two].team("adversaries")]
    return encounter.play(env, teams, np.asarray(pairs), episodes, deterministic, seed)


# ---- what is played --------------------------------------------------------------------------------------------------


def by_numpy(run, seed, team, observation):
    """{agent: action} of a team for everybody's observations, in float64, written from what a run's settings say."""
    settings, spec = run.training.config, run.training.spec
    who = [i for i, t in enumerate(ENV.teams) if t == team]
    algorithm = settings.teams()[team]
    agents = [i for i, t in enumerate(spec.teams) if t == team]
    seen = [observation[i] for i in who]
    if algorithm.joint:
        seen = [np.concatenate(seen)]
    actions = []
    for agent, x in zip(agents, seen, strict=True):
        if settings.normalise_observations:
            start = sum(spec.observation_sizes[:agent])
            mean, variance = (np.float64(leaf)[seed, start : start + len(x)] for leaf in run.state.statistics)
            x = np.clip((x - mean) / np.sqrt(variance + 1e-8), -10, 10)
        g, k = spec.place(agent)
        logits, _ = reference.forward(layers(run.state.groups[g].actor, seed, k), x[None])
        actions += [reference.softmax(part[None])[0] for part in logits[0].reshape(-1, 5)]
    return dict(zip(who, actions, strict=True))


@pytest.mark.parametrize(("one", "two"), [("mixed", "normal"), ("joint", "mixed"), ("normal", "joint")])
def test_episodes_by_hand(one, two, runs):
    """Seeds of different places, step after step with NumPy policies: the same mean returns of every agent."""
    episodes, (k, m) = 4, (1, 0)
    got = meet(runs, one, two, [[k, m]], episodes)
    state_key, step_key = jax.random.split(jax.random.fold_in(jax.random.key(SEED), 2**31 - 1))
    step = jax.jit(ENV.step)
    total = np.zeros(3)
    for key in jax.random.split(state_key, episodes):
        state, observation = ENV.reset(key)
        for t in range(STEPS):
            seen = [np.asarray(o, np.float64) for o in observation]
            chosen = by_numpy(runs[one], k, "agents", seen) | by_numpy(runs[two], m, "adversaries", seen)
            after = step(jax.random.key(t), state, tuple(jnp.float32(chosen[i]) for i in range(3)))
            state, observation = after.state, after.observation
            total += np.asarray(after.reward)
    # float32: five rewards of order 1, small networks.
    np.testing.assert_allclose(got[0], total / episodes, rtol=1e-4, atol=1e-5)
    assert np.abs(got[0] - meet(runs, one, two, [[0, 1]], episodes)[0]).max() > 1e-3, "seeds have their own policies"


@pytest.mark.parametrize("name", RUNS)
def test_own_pairs_are_evaluations(name, runs):
    """Trained together, deterministic: the numbers of `evaluate`, team by team, which has never heard of teams."""
    training, state = runs[name]
    seeds = training.config.seeds
    played = meet(runs, name, name, OWN[:seeds], episodes=6)
    found = training.evaluate(state, 6, True, SEED).episode_return.mean(axis=1)
    for team in encounter.TEAMS:
        weights = np.array(ENV.return_weights) * (np.array(ENV.teams) == team)
        np.testing.assert_allclose(played @ weights, found @ training.team_weights(team), rtol=1e-5, atol=1e-5)


class Twin(Ledger):
    """Everybody sees the same kind of thing: one group of all agents, teams in turns; episodes end at 3 or 5 steps."""

    @property
    def observation_sizes(self):
        return (3,) * len(self.teams)

    def observe(self, state):
        return tuple(o[:3] for o in super().observe(state))


TWIN = Twin(teams=("agents", "adversaries", "agents"))
TWIN_SETTINGS = [*SMALL[2:], "seeds=2", "normalise_observations=true"]


def test_a_group_across_teams():
    """Agents of both teams in one stack of networks: each team takes its own out, with its own statistics."""
    run = make(TWIN_SETTINGS, TWIN)
    assert len(run.training.spec.groups) == 1
    played = meet({"twin": run}, "twin", "twin", OWN[:2], episodes=8, env=TWIN)
    found = run.training.evaluate(run.state, 8, True, SEED)
    np.testing.assert_allclose(played, found.episode_return.mean(axis=1), rtol=1e-5)
    assert len(np.unique(found.length)) == 2


def test_hard_choices_and_boxes():
    """A joint team of hard choices, and of boxes: own pairs are evaluations."""
    for actions in ("discrete", "continuous"):
        run = make([*SMALL, "algo=td3", "seeds=2", f"env.actions={actions}"])
        env = dataclasses.replace(ENV, actions=actions)
        teams = [encounter.team_of(run.training, env, run.state, team) for team in encounter.TEAMS]
        played = encounter.play(env, teams, OWN[:2], 4, True, SEED)
        found = run.training.evaluate(run.state, 4, True, SEED).episode_return.mean(axis=1)
        np.testing.assert_allclose(played[:, 0], found[:, 0], rtol=1e-5, atol=1e-5)
        # The joined agent's reward is the mean of its members'.
        np.testing.assert_allclose(played[:, 1:].mean(axis=1), found[:, 1], rtol=1e-5, atol=1e-5)


def test_order_and_pieces(runs, monkeypatch):
    """Seeds x seeds: each row is what that pair plays alone, also where the pairs are cut into pieces."""
    pairs = pairs_of(3, 2, matched=False)
    together = meet(runs, "mixed", "normal", pairs)
    for pair, row in zip(pairs, together, strict=True):
        np.testing.assert_allclose(meet(runs, "mixed", "normal", [pair])[0], row, rtol=1e-5, atol=1e-5)
    monkeypatch.setattr(encounter, "SIDE_BY_SIDE", {"cpu": 4})
    np.testing.assert_allclose(meet(runs, "mixed", "normal", pairs), together, rtol=1e-5, atol=1e-5)
    assert len(np.unique(together.round(4), axis=0)) == 6


def test_sampled_noise():
    """As in training, each team by itself: returns like those of sampled evaluations, and of policies without
    preferences nobody's noise goes with anybody's."""
    run = make(TWIN_SETTINGS, TWIN)
    one, two = (meet({"twin": run}, "twin", "twin", OWN[:2], 3000, False, s, TWIN) for s in (0, 1))
    found = run.training.evaluate(run.state, 3000, False, 0).episode_return
    error = found.std(axis=1) / np.sqrt(3000)
    still = run.training.evaluate(run.state, 3000, True, 0).episode_return.mean(axis=1)
    # Start states are shared with the evaluation of the same seed, but not the noise.
    assert (np.abs(one - found.mean(axis=1)) < 4 * error).all() and not np.allclose(one, found.mean(axis=1), rtol=1e-6)
    assert not np.allclose(one, two, rtol=1e-6)
    assert (np.abs(still - found.mean(axis=1)) > 4 * error).any()
    groups = jax.tree.map(np.zeros_like, run.state.groups)
    run = run._replace(state=run.state._replace(groups=groups))
    length = 4.0  # of an episode of 3 or 5 steps, on average: alone it moves the three returns together
    returns = np.array([meet({"twin": run}, "twin", "twin", [[0, 0]], 1, False, s, TWIN)[0] for s in range(150)])
    short = returns[:, 1] < 10 * length  # the second agent gets ten more a step
    for kind in (short, ~short):
        r = np.corrcoef(returns[kind].T)[np.triu_indices(3, 1)]
        assert kind.sum() > 50 and np.abs(r).max() < 0.45


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory, runs):
    """A folder with the run directories of `runs`, and with others that will not do."""
    folder = tmp_path_factory.mktemp("runs")
    for name, (training, state) in runs.items():
        directory = RunDirectory.create(folder / name, training.config, {})
        checkpoint.save(directory.checkpoints, 40, training.trainer, state, 1)
    empty = Training(config.load(SMALL))
    RunDirectory.create(folder / "empty", empty.config, {})
    other = dataclasses.replace(empty.config, env={**empty.config.env, "num_good": 3})
    RunDirectory.create(folder / "other", other, {})
    for name in ("push", "spread"):
        RunDirectory.create(folder / name, config.load([*SMALL[1:], f"env=simple_{name}"]), {})
    return folder


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_command(saved, runs, tmp_path, monkeypatch, capsys):
    """Three runs, seeds x seeds: every pair in the table with its numbers; the means are those of the pairs."""
    monkeypatch.chdir(tmp_path)
    where = f"runs={saved}/mixed,{saved}/[jn]o*"
    assert crossplay.main([where, "episodes=4", f"seed={SEED}", "deterministic=true"]) == 0
    (out,) = (tmp_path / "crossplay").iterdir()
    assert out.name.startswith("simple_adversary-")
    assert {p.name for p in out.iterdir()} == {"pairs.csv", "means.csv", "heat_map.png", "crossplay.json"}
    assert (out / "heat_map.png").read_bytes()[:4] == b"\x89PNG"
    found = json.loads((out / "crossplay.json").read_text())
    assert found["env"]["name"] == "simple_adversary" and found["pairing"] == "all" and found["seed"] == SEED
    assert found["runs"]["joint"]["algorithms"] == {"agents": "td3", "adversaries": "iddpg"}
    assert found["runs"]["normal"]["seeds"] == [7, 8] and found["runs"]["normal"]["checkpoint"] == 40

    pairs = table(out / "pairs.csv")
    first = {"mixed": 0, "joint": 0, "normal": 7}
    seeds = {"mixed": 3, "joint": 3, "normal": 2}
    who = [
        (a, str(first[a] + k), b, str(first[b] + m), "own" if (a, k) == (b, m) else "cross")
        for a in first for b in first for k in range(seeds[a]) for m in range(seeds[b])
    ]  # fmt: skip
    assert [tuple(row.values())[:5] for row in pairs] == who and {row["episodes"] for row in pairs} == {"4"}
    returns = {tuple(r.values())[:4]: (float(r["return_agents"]), float(r["return_adversaries"])) for r in pairs}
    played = meet(runs, "joint", "mixed", [[2, 1]])[0]
    np.testing.assert_allclose(returns["joint", "2", "mixed", "1"], (played[1] + played[2], played[0]), rtol=1e-5)

    means = {tuple(row.values())[:3]: row for row in table(out / "means.csv")}
    cell = [v for (a, _, b, _), v in returns.items() if (a, b) == ("normal", "joint")]
    assert means["normal", "joint", "cross"]["pairs"] == "6"
    assert float(means["normal", "joint", "cross"]["return_agents"]) == pytest.approx(np.mean(cell, axis=0)[0])
    own = [returns["mixed", str(k), "mixed", str(k)] for k in range(3)]
    assert float(means["all", "mixed", "own"]["return_adversaries"]) == pytest.approx(np.mean(own, axis=0)[1])
    half = 4.303 * np.std(own, axis=0, ddof=1)[0] / np.sqrt(3)  # Student's t of 2 degrees of freedom, from a table
    assert float(means["mixed", "mixed", "own"]["return_agents_half_width"]) == pytest.approx(half, rel=1e-3)
    assert means["normal", "normal", "cross"]["return_agents_half_width"] == "nan"

    printed = capsys.readouterr().out
    for words in (
        "against normal",
        "own pairs",
        "cross pairs",
        "return of adversaries",
        f"{np.mean(cell, axis=0)[0]:.2f} ±",
    ):
        assert words in printed
    # Nothing is overwritten.
    before = {p: p.read_bytes() for p in out.iterdir()}
    with pytest.raises(UserError, match="something is there already"):
        crossplay.main([where, f"out={out}"])
    assert before == {p: p.read_bytes() for p in out.iterdir()}


def test_matched_and_sampled(saved, tmp_path, capsys):
    """Seed with seed by their places; sampled unless said otherwise."""
    arguments = [f"runs=[{saved}/mixed,{saved}/plain]", "pairing=matched", "episodes=4", f"seed={SEED}"]
    for name, more in (("sampled", []), ("deterministic", ["deterministic=true"])):
        assert crossplay.main([*arguments, *more, f"out={tmp_path / name}"]) == 0
        assert f"4 {name} episodes" in capsys.readouterr().out
    sampled, still = (table(tmp_path / name / "pairs.csv") for name in ("sampled", "deterministic"))
    assert [tuple(row.values())[:5] for row in sampled] == [
        (a, str(k + 4 * (a == "plain")), b, str(k + 4 * (b == "plain")), "own" if a == b else "cross")
        for a in ("mixed", "plain") for b in ("mixed", "plain") for k in range(3)
    ]  # fmt: skip
    assert all(one["return_agents"] != two["return_agents"] for one, two in zip(sampled, still, strict=True))


def test_one_run(saved, tmp_path):
    assert crossplay.main([f"runs={saved}/normal", "episodes=2", f"out={tmp_path}/new"]) == 0
    assert [row["pair"] for row in table(tmp_path / "new" / "pairs.csv")] == ["own", "cross", "cross", "own"]


BAD = {
    "no runs": ([], "runs=A,B,C"),
    "no such run": (["runs={0}/mixed,{0}/nowhere"], "no run directory .*nowhere"),
    "no run": (["runs={0}/mixed/checkpoints"], "no config.yaml"),
    "nothing matches": (["runs={0}/x*"], "no run directory matches"),
    "an empty name": (["runs={0}/mixed,"], "commas"),
    "an empty list": (["runs=[]"], "commas"),
    "twice": (["runs={0}/mixed,{0}/../{1}/mixed"], "twice"),
    "no checkpoint": (["runs={0}/mixed,{0}/empty"], "empty/checkpoints holds no checkpoint"),
    "no such checkpoint": (["runs={0}/mixed", "checkpoint=7"], "no checkpoint of step 7"),
    "another option": (["runs={0}/mixed,{0}/other"], "env.num_good=2 in .*mixed, 3 in .*other"),
    "another environment": (["runs={0}/mixed,{0}/push"], "env.name=simple_adversary in .*, simple_push in"),
    "nobody against": (["runs={0}/spread"], "simple_spread has no adversaries"),
    "different numbers": (["runs={0}/mixed,{0}/normal", "pairing=matched"], "equally many seeds: .*3, .*2"),
    "unknown key": (["runs={0}/mixed", "episods=3"], "episodes"),
    "episodes": (["runs={0}/mixed", "episodes=0"], "episodes=0"),
    "seed": (["runs={0}/mixed", "seed=-1"], "seed=-1"),
    "pairing": (["runs={0}/mixed", "pairing=both"], "pairing='both': must be one of all, matched"),
    "deterministic": (["runs={0}/mixed", "deterministic=maybe"], "deterministic='maybe'"),
    "checkpoint": (["runs={0}/mixed", "checkpoint=last"], "checkpoint='last'"),
    "out": (["runs={0}/mixed", "out={0}/mixed/config.yaml"], "out=.*cannot make"),
    "malformed": (["runs={0}/mixed", "episodes=[1"], "cannot read"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_writes_nothing(case, saved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = {p: p.stat().st_mtime_ns for p in saved.rglob("*")}
    arguments, wanted = BAD[case]
    with pytest.raises(UserError, match=wanted) as error:
        crossplay.main([a.format(saved, saved.name) for a in arguments])
    assert "\n" not in str(error.value)
    assert before == {p: p.stat().st_mtime_ns for p in saved.rglob("*")} and not list(tmp_path.iterdir())


def test_paths(tmp_path, monkeypatch):
    """Names as they are, whatever Hydra would make of them; several runs=; wildcards match run directories only."""
    monkeypatch.chdir(tmp_path)
    for name in ("b-1", "b-2", "b-3"):
        (tmp_path / name).mkdir()
    for name in ("b-1", "b-3"):
        (tmp_path / name / "config.yaml").touch()
    assert paths(["runs=1e3,lr=0.1,007", "seed=3"]) == ([Path("1e3"), Path("lr=0.1"), Path("007")], ["seed=3"])
    assert paths(["runs=a", "runs=[b, 'c d']"]) == ([Path("a"), Path("b"), Path("c d")], [])
    assert paths(["runs=b-*"]) == ([Path("b-1"), Path("b-3")], [])
    assert paths(["runs=b-[3],x"])[0] == [Path("b-3"), Path("x")]
    assert paths(["checkpoint=3"]) == ([], ["checkpoint=3"])
