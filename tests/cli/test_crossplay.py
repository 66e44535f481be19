"""The command `crossplay`: the files it leaves, and bad input that leaves none."""

import csv
import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pictures
import pytest
from cross_cases import SEED, SMALL, meet, runs

from matd3_jax import config
from matd3_jax.cli import crossplay
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play
from matd3_jax.evaluation.cross_play import TEAMS
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.paths import paths
from matd3_jax.runtime import devices
from matd3_jax.training import checkpoint
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with the run directories of `runs`, and with others that will not do."""
    folder = tmp_path_factory.mktemp("runs")
    for name, (training, state) in runs().items():
        directory = RunDirectory.create(folder / name, training.config, {})
        checkpoint.save(directory.checkpoints, 40, training.trainer, state, 1)
    empty = TrainingSession(config.load(SMALL))
    RunDirectory.create(folder / "empty", empty.config, {})
    other = dataclasses.replace(empty.config, env={**empty.config.env, "num_good": 3})
    RunDirectory.create(folder / "other", other, {})
    for name in ("push", "spread"):
        RunDirectory.create(folder / name, config.load([*SMALL[1:], f"env=simple_{name}"]), {})
    return folder


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_command(saved, tmp_path, monkeypatch, capsys):
    """Three runs, seeds x seeds: every pair in the table with its numbers; the means are those of the pairs."""
    monkeypatch.chdir(tmp_path)
    drawn = pictures.written(monkeypatch)
    where = f"runs={saved}/mixed,{saved}/[jn]o*"
    assert crossplay.main([where, "episodes=4", f"seed={SEED}", "deterministic=true"]) == 0
    (out,) = (tmp_path / "crossplay").iterdir()
    assert out.name.startswith("simple_adversary-")
    assert {p.name for p in out.iterdir()} == {"pairs.csv", "means.csv", "heat_map.png", "crossplay.json"}
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
    played = meet(runs(), "joint", "mixed", [[2, 1]])[0]
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
    for axis, team in zip(drawn[Path("crossplay") / out.name / "heat_map.png"].axes, TEAMS, strict=False):
        cells = [[float(means[a, b, "cross"][f"return_{team}"]) for b in first] for a in first]
        np.testing.assert_allclose(axis.images[0].get_array(), cells)

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


def test_a_seed_that_diverged_does_not_play(saved, tmp_path, capsys, monkeypatch):
    """The means are those of the other pairs; where none is left, one line says so."""
    folder = tmp_path / "runs"
    training, state = runs()["plain"]
    for name, lost in (("partly", [1]), ("wholly", [0, 1, 2])):
        groups = jax.tree.map(lambda leaf, lost=lost: np.array(leaf), state.groups)
        groups[0].actor["bias_0"][lost] = np.nan
        directory = RunDirectory.create(folder / name, training.config, {})
        checkpoint.save(directory.checkpoints, 40, training.trainer, state._replace(groups=groups), 1)
    assert crossplay.main([f"runs={folder / 'partly'},{saved / 'mixed'}", "episodes=2", f"out={tmp_path / 'x'}"]) == 0
    assert "partly: 2 of 3 seeds, seed 5 diverged at 40, left out" in capsys.readouterr().out
    pairs = table(tmp_path / "x" / "pairs.csv")
    assert len(pairs) == (2 + 3) ** 2 and not any(row["return_agents"] == "nan" for row in pairs)
    of_partly = {row[f"{team}_seed"] for row in pairs for team in TEAMS if row[team] == "partly"}
    assert of_partly == {"4", "6"}
    kept = json.loads((tmp_path / "x" / "crossplay.json").read_text())["runs"]
    assert kept["partly"]["diverged"] == {"5": 40} and kept["mixed"]["diverged"] == {}
    with pytest.raises(UserError, match="wholly: all seeds diverged"):
        crossplay.main([f"runs={folder / 'wholly'}", f"out={tmp_path / 'y'}"])
    monkeypatch.setattr(devices, "free_memory", lambda sharing=1: 10_000_000)
    with pytest.raises(UserError, match="episodes side by side: episodes at most"):
        crossplay.main([f"runs={saved / 'mixed'}", "episodes=1000000", f"out={tmp_path / 'y'}"])
    assert not (tmp_path / "y").exists()


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
    "pairing": (["runs={0}/mixed", "pairing=both"], "pairing=both: must be one of all, matched"),
    "deterministic": (["runs={0}/mixed", "deterministic=maybe"], "deterministic=maybe"),
    "checkpoint": (["runs={0}/mixed", "checkpoint=newest"], "checkpoint=newest"),
    "out": (["runs={0}/mixed", "out={0}/mixed/config.yaml"], "out=.*cannot make"),
    "malformed": (["runs={0}/mixed", "episodes=[1"], r"episodes=\[1: must be a whole number"),
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


def test_what_fails_while_playing_leaves_no_directory(saved, tmp_path, monkeypatch):
    def fail(*_):
        raise MemoryError

    monkeypatch.setattr(cross_play, "play", fail)
    with pytest.raises(MemoryError):
        crossplay.main([f"runs={saved}/normal", "episodes=2", f"out={tmp_path}/new/place"])
    assert not list(tmp_path.iterdir())


def test_paths(tmp_path, monkeypatch):
    """Names as they are, whatever Hydra would make of them; several runs=; wildcards match run directories only."""
    monkeypatch.chdir(tmp_path)
    for name in ("b-1", "b-2", "b-3"):
        (tmp_path / name).mkdir()
    for name in ("b-1", "b-3"):
        (tmp_path / name / "config.yaml").touch()
    assert paths(["1e3,lr=0.1,007"]) == (Path("1e3"), Path("lr=0.1"), Path("007"))
    assert paths(["a", "[b, 'c, d', it's]"]) == (Path("a"), Path("b"), Path("c, d"), Path("it's"))
    assert paths(["b-*"]) == (Path("b-1"), Path("b-3"))
    assert paths(["b-[3],x"]) == (Path("b-3"), Path("x"))
