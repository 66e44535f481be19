"""The experiments' commands: from run directories to reports, reuse of data, training, errors."""

import csv
import dataclasses
import json
import shlex
import shutil

import numpy as np
import pictures
import pytest
from study_cases import NOISE, fake_run, verdicts

from experiments import all as everything
from experiments import (
    ant,
    collecting,
    competitive,
    cooperative,
    cooperative_navigation,
    grid_search,
    machine_time,
    policy_delay,
    study,
    target_smoothing,
    tidy,
)
from experiments.policy_delay import DelayOptions
from experiments.study import StudyOptions
from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.sweep import runner


@pytest.mark.slow
def test_competitive_from_run_directories(tmp_path, monkeypatch):
    """The team of Predator-Prey is `adversaries`, which adversary= trains; elsewhere it is `agents`."""
    for env, algo, adversary in [
        (env, algo, adversary)
        for env in ("simple_tag", "simple_push", "simple_crypto")
        for algo in ("matd3", "maddpg")
        for adversary in ("matd3", "maddpg")
    ]:
        team = adversary if env == "simple_tag" else algo
        ours = {"matd3": 10.0, "maddpg": 4.0}[team] + NOISE
        columns = {"return_agents": (NOISE, ours), "return_adversaries": (NOISE, 0 * NOISE - 50)}
        if env == "simple_tag":
            columns = {"return_adversaries": (NOISE, ours), "return_agents": (NOISE, 0 * NOISE - 50)}
        line = competitive.settings("paper", StudyOptions())[f"{env}-{algo}-vs-{adversary}"]
        overrides = [*line[:3], "log_every=7000"]
        if algo == adversary == "matd3":  # the same without a word
            overrides = overrides[:2] + overrides[3:]
        fake_run(tmp_path / "runs" / f"{env}-{algo}-vs-{adversary}", [*overrides, "eval_every=0"], columns)
    out, figures = tmp_path / "out", pictures.written(monkeypatch)
    argv = ["train=false", f"runs={tmp_path / 'runs'}", f"out={out}", "only=nothing"]
    claims = {claim.paper.split(":")[0]: claim for claim in study.run(competitive.STUDY, argv)}
    assert [claim.verdict for claim in claims.values()] == ["same", "not yet run", "same", "opposite"]
    assert claims["Predator-Prey"].difference.estimate == pytest.approx(6)
    table = tidy.read(out / "data.csv")
    assert {(row.where(env="simple_tag").values("algo")[0]) for row in [table]} == {"maddpg"}
    scaled = competitive.normalized(table, "simple_tag")
    # Worst trial 3, best 11; the team is MATD3 in the first two pairings whatever the prey is.
    np.testing.assert_allclose(scaled["matd3", "maddpg"], (10 + NOISE - 3) / 8)
    np.testing.assert_allclose(scaled["maddpg", "matd3"], (4 + NOISE - 3) / 8)
    text = (out / "table.md").read_text()
    assert "Departs from the paper's protocol: seeds 4 (20)" in text
    assert "Not yet run: simple_adversary-matd3-vs-matd3" in text
    assert "| Predator-Prey | MATD3 | MADDPG | 4 | 50,000 |" in text
    axes = figures[out / "figure.png"].axes
    assert [axis.get_title() for axis in axes] == ["Covert Communication", "Keep-away", "Predator-Prey"]
    matd3, maddpg = "#0072B2", "#E69F00"
    for axis in axes:
        # Both pairings of a MATD3 team, then those of MADDPG: normalized 7 / 8 and 1 / 8, with a dot for each seed.
        place, height, color = zip(*pictures.bars(axis), strict=True)
        np.testing.assert_allclose(place, range(4))
        np.testing.assert_allclose(height, [7 / 8, 7 / 8, 1 / 8, 1 / 8])
        assert color == (matd3, matd3, maddpg, maddpg)
        dots = [line.get_ydata() for line in axis.lines if line.get_marker() == "."]
        np.testing.assert_allclose(dots, [(mean + NOISE - 3) / 8 for mean in (10, 10, 4, 4)])
        assert [label.get_text() for label in axis.get_xticklabels()] == ["vs\nMATD3", "vs\nMADDPG"] * 2
        assert [(text.get_text(), text.get_color()) for text in axis.texts] == [
            ("MATD3 team", matd3), ("MADDPG team", maddpg)]  # fmt: skip
        assert axis.get_xlabel() == "4 seeds"
    assert axes[0].get_ylabel() == "team's final return, normalized"
    assert {matd3, maddpg} <= pictures.colors(out / "figure.png")
    # The same again from the data alone, and the numbers are in the table.
    shutil.rmtree(tmp_path / "runs")
    assert [c.difference for c in study.run(competitive.STUDY, argv)] == [c.difference for c in claims.values()]
    facts = json.loads((out / "runs.json").read_text())
    assert facts["simple_push-matd3-vs-maddpg"]["settings"]["adversary"]["name"] == "maddpg"
    assert str(tmp_path) not in (out / "runs.json").read_text()


@pytest.fixture
def trained(monkeypatch):
    """Nothing is trained: what would have been is remembered."""
    asked = []
    monkeypatch.setattr(runner, "train", lambda settings, folder: asked.append(dict(settings)) or {})
    return asked


def test_finished_data_are_used_and_only_what_is_missing_is_trained(tmp_path, trained):
    runs, out = tmp_path / "runs", tmp_path / "out"
    for label, line in target_smoothing.settings("small", StudyOptions()).items():
        if label != "sigma0.4":
            fake_run(runs / label, [t for t in line if "seeds" not in t], {"return_agents": (NOISE, 10 + NOISE)})
    argv = ["scale=small", f"runs={runs}", f"out={out}"]
    assert target_smoothing.main([*argv, "train=false"]) == 0
    shutil.rmtree(runs)
    assert target_smoothing.main([*argv, "seeds=4"]) == 0
    assert [list(settings) for settings in trained] == [["sigma0.4"]]
    assert target_smoothing.main([*argv, "seeds=3", "only=sigma0.1"]) == 0
    assert not trained[1:]  # three of four seeds: enough
    target_smoothing.main([*argv, "seeds=5", "only=sigma0.1"])
    target_smoothing.main([*argv, "seeds=4", "only=sigma0.2", "total_steps=200000"])
    assert [list(settings) for settings in trained[1:]] == [["sigma0.1-seeds_4_to_4"], ["sigma0.2"]]
    fifth = trained[1]["sigma0.1-seeds_4_to_4"]
    assert (fifth.seed, fifth.seeds) == (4, 1)
    assert trained[2]["sigma0.2"].total_steps == 200_000 and trained[2]["sigma0.2"].algo.target_noise == 0.2
    # Nothing came of it, and nothing was lost: four seeds of three settings, two rows each.
    with (out / "data.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 24


def test_some_seeds_at_once_are_kept_when_the_next_ones_are_stopped(tmp_path, monkeypatch):
    """Two of five seeds at a time, of two settings in turns; a stop in the second round costs that round alone."""
    argv = ["only=simple_spread-*", "seeds=5", "at_once=2", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"]
    rounds = []

    def train(settings, folder):
        rounds.append({name: (one.seed, one.seeds) for name, one in settings.items()})
        if len(rounds) == 2:
            raise runner.Stopped(130)
        for name, one in settings.items():
            line = cooperative.settings("paper", StudyOptions())[name.split("-seeds")[0]]
            returns = {"return_agents": (np.zeros(one.seeds), 10.0 * (one.seed + np.arange(one.seeds)))}
            fake_run(folder / "runs" / name, [t for t in line if "seeds" not in t], returns, first=one.seed)
        return {name: [folder / "runs" / name] for name in settings}

    monkeypatch.setattr(runner, "train", train)
    assert cooperative.main(argv) == 130
    assert cooperative.main(argv) == 0
    names = [f"simple_spread-{algo}" for algo in ("matd3", "maddpg")]
    first, stopped, second, third = rounds
    assert first == {f"{name}-seeds_0_to_1": (0, 2) for name in names}
    assert stopped == second == {f"{name}-seeds_2_to_3": (2, 2) for name in names}
    assert third == {f"{name}-seeds_4_to_4": (4, 1) for name in names}
    table = tidy.read(tmp_path / "out" / "data.csv").where(algo="maddpg")
    np.testing.assert_allclose(tidy.final(table, "return_agents"), [0, 10, 20, 30, 40])
    facts = json.loads((tmp_path / "out" / "runs.json").read_text())["simple_spread-maddpg"]
    assert [part["seeds"] for part in facts["parts"]] == [[0, 1], [2, 3], [4]]
    assert (facts["settings"]["seed"], facts["settings"]["seeds"]) == (0, 5)


def test_unfinished_runs_are_drawn_but_claim_nothing(tmp_path):
    runs, out = tmp_path / "runs", tmp_path / "out"
    for label, line in cooperative.settings("paper", StudyOptions()).items():
        returns = {"return_agents": (NOISE, 10 + NOISE)}
        fake_run(runs / label, [t for t in line if "seeds" not in t], returns, finished=label != "simple_spread-matd3")
    claims = study.run(cooperative.STUDY, ["train=false", f"runs={runs}", f"out={out}"])
    assert verdicts(claims) == ["not yet run"] * 3 + ["not shown"]
    assert "Not finished: simple_spread-matd3." in (out / "table.md").read_text()
    assert len(tidy.read(out / "data.csv").where(env="simple_spread", algo="matd3")) == 8


def test_seeds_of_several_directories_are_one_setting(tmp_path):
    line = [t for t in cooperative.settings("paper", StudyOptions())["simple_spread-matd3"] if "seeds" not in t]
    fake_run(tmp_path / "part0", line, {"return_agents": (NOISE, NOISE)})
    fake_run(tmp_path / "part1", [*line, "seed=4"], {"return_agents": (NOISE, NOISE)})
    path = tmp_path / "part1" / "metrics.csv"
    head, *rows = path.read_text().splitlines()
    moved = [",".join([row.split(",")[0], str(int(row.split(",")[1]) + 4), *row.split(",")[2:]]) for row in rows]
    path.write_text("\n".join([head, *moved]) + "\n")
    wanted = config.load([*line, "seeds=8"])
    paths = collecting.find(tmp_path, "simple_spread-matd3", wanted)
    how = {"keep": ("return_*",), "points": 120, "evaluations": False}
    rows, facts = collecting.gather({"algo": "algo.name"}, paths, "command", **how)
    data = collecting.Data({"algo": "algo.name"}, {}, {})
    assert data.offer("a", rows, facts) and data.has("a", wanted)
    assert facts["settings"]["seeds"] == 8 and len(facts["summary"]["parts"]) == 2
    # Fewer seeds, or unfinished ones, do not take their place.
    assert not data.offer("a", *collecting.gather({"algo": "algo.name"}, paths[:1], "command", **how))
    (paths[0] / "summary.json").unlink()
    assert not data.offer("a", *collecting.gather({"algo": "algo.name"}, paths, "command", **how))


def test_what_another_study_has_trained_is_taken_over(tmp_path):
    """Rows of the same settings and of wanted seeds alone, selected by the columns of their own study, whose hours
    count once."""
    runs, out = tmp_path / "runs", tmp_path / "results" / "target_smoothing"
    for k, (label, line) in enumerate(policy_delay.settings("paper", DelayOptions()).items()):
        returns = {"return_agents": (NOISE, 10 * k + NOISE), "return_adversaries": (NOISE, NOISE)}
        fake_run(runs / label, [t for t in line if "seeds" not in t], returns)
    beside = tmp_path / "results" / "policy_delay"
    assert policy_delay.main(["train=false", f"runs={runs}", f"out={beside}"]) == 0
    assert target_smoothing.main(["train=false", "seeds=3", f"runs={tmp_path / 'none'}", f"out={out}"]) == 0
    there = collecting.read(beside / "data.csv", beside / "runs.json", policy_delay.STUDY.keys)
    data = collecting.read(out / "data.csv", out / "runs.json", target_smoothing.STUDY.keys)
    assert list(data.facts) == ["sigma0"] and data.seeds("sigma0") == {0, 1, 2} and "policy_delay" not in data.table
    wanted = there.rows["simple_spread-d2"].by_seed("return_agents")[:3]
    np.testing.assert_array_equal(data.table.where(target_noise=0).by_seed("return_agents"), wanted)
    assert not np.isin(wanted, there.rows["simple_spread-d1"]["return_agents"]).all()
    (part,) = data.facts["sigma0"]["parts"]
    assert part["seeds"] == [0, 1, 2] and "experiments.policy_delay" in part["command"]
    hours = [machine_time.hours(facts) for facts in ([there.facts], [there.facts, data.facts], [data.facts])]
    assert hours[0] == hours[1] > hours[2] > 0


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("runs.json", '{"simple_spread-matd3"', "Expecting ':' delimiter"),
        ("runs.json", "[1]", "no attribute 'items'"),
        ("runs.json", '{"simple_spread-matd3": {}}', "settings"),
        ("data.csv", "env,algo\n<<<<<<< HEAD\nsimple_spread,matd3\n", "line 2 of data.csv has 1 cells, not 2"),
        ("data.csv", "", "not enough values"),
        ("data.csv", "env,algo,seed\nsimple_spread,td3,0\n", "has no rows: remove both"),
    ],
)
def test_data_that_cannot_be_read_are_named_in_one_line(tmp_path, name, text, words):
    line = cooperative.settings("paper", StudyOptions())["simple_spread-matd3"]
    places = [f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"]
    fake_run(tmp_path / "runs" / "simple_spread-matd3", line[:2], {"return_agents": (NOISE, NOISE)})
    assert cooperative.main(["train=false", *places]) == 0
    (tmp_path / "out" / name).write_text(text)
    with pytest.raises(UserError, match=words) as found:
        cooperative.main(["train=false", *places])
    assert "remove both" in str(found.value) and "\n" not in str(found.value)


def test_all_makes_one_summary(tmp_path, monkeypatch):
    monkeypatch.setattr(everything, "STUDIES", {s.STUDY.name: s.STUDY for s in (cooperative, target_smoothing, ant)})
    for label, line in target_smoothing.settings("paper", StudyOptions()).items():
        returns = {"return_agents": (0 * NOISE, 10 + 0.1 * NOISE)}
        fake_run(tmp_path / "runs" / "target_smoothing" / label, [t for t in line if "seeds" not in t], returns)
    argv = ["train=false", "skip=[ant]", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"]
    assert everything.main(argv) == 0
    text = (tmp_path / "out" / "summary.md").read_text()
    assert text.count("**not yet run**") == 4 and text.count("**same**") == 3
    assert "](target_smoothing/table.md)" in text and "Robots" not in text
    with pytest.raises(UserError, match="no experiment 'aunt'"):
        everything.main(["skip=aunt"])
    with pytest.raises(UserError, match="no key 'estimat'"):
        everything.main(["estimat=true", f"out={tmp_path / 'other'}"])
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["scale=large"], "scale=large: must be one of paper, small"),
        (["train=maybe"], "train=maybe: must be true or false"),
        (["seeds=0"], "seeds=0: must be a whole number of at least 1"),
        (["only=x*"], "only=x\\*: matches none of simple_spread-matd3, simple_spread-maddpg"),
        (["algo=td3"], "cannot take algo= here: the study itself varies it"),
        (["name=mine"], "cannot take name= here"),
        (["learning_rate=0.1"], "there is no key 'learning_rate'"),
        (["at_ones=2"], "there is no key 'at_ones'; did you mean 'at_once'"),
        (["sedes=2"], r"there is no key 'sedes'; did you mean 'seeds' or 'seed'\?"),  # a setting and an option: once
        (["train=false"], "there is no run to report"),
    ],
)
def test_bad_input_is_one_line(tmp_path, argv, line):
    with pytest.raises(UserError, match=line):
        cooperative.main([*argv, f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"])
    assert not (tmp_path / "runs").exists() and not (tmp_path / "out").exists()


@pytest.mark.parametrize("key", ["runs", "out"])
def test_directories_are_checked_before_anything_is_trained(tmp_path, trained, key):
    (tmp_path / "file").touch()
    places = {"runs": tmp_path / "runs", "out": tmp_path / "out", key: tmp_path / "file"}
    with pytest.raises(UserError, match=f"{key}=.*/file: cannot make this directory"):
        cooperative.main(["scale=small", *(f"{name}={path}" for name, path in places.items())])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_comparison_that_cannot_be_trained_leaves_no_directory(tmp_path):
    with pytest.raises(UserError, match="no key 'sedes'"):
        cooperative_navigation.main(["sedes=3", f"out={tmp_path / 'out'}"])
    assert not list(tmp_path.iterdir())


def test_all_options_are_checked_before_the_first_experiment(tmp_path, trained):
    """A mistake in what all of them share is found before the first of them begins."""
    with pytest.raises(UserError, match="scale=smal: must be one of paper, small"):
        everything.main(["scale=smal", f"out={tmp_path / 'out'}", f"runs={tmp_path / 'runs'}"])
    assert not list(tmp_path.iterdir())


def test_recorded_commands_can_be_pasted(tmp_path):
    """But for where files lay; a pattern is quoted for the shell."""
    runs, out = tmp_path / "runs", tmp_path / "out"
    for label, line in cooperative.settings("paper", StudyOptions()).items():
        fake_run(runs / label, [t for t in line if "seeds" not in t], {"return_agents": (NOISE, 10 + NOISE)})
    assert cooperative.main(["train=false", "only=*maddpg* of 'mine'", f"runs={runs}", f"out={out}"]) == 0
    (typed,) = {fact["command"] for fact in json.loads((out / "runs.json").read_text()).values()}
    assert shlex.split(typed) == ["python", "-m", "experiments.cooperative", "only=*maddpg* of 'mine'"]


@pytest.mark.parametrize("module", [ant, cooperative, grid_search])
def test_help_lists_every_option(module, capsys):
    assert module.main(["--help"]) == 0
    printed = capsys.readouterr().out
    names = [field.name for field in dataclasses.fields(module.STUDY.options) if "bounds" in field.metadata]
    assert all(f"\n  {name}=" in printed for name in names) and str(module.__doc__).splitlines()[-1] in printed


def test_runs_with_other_settings_are_refused(tmp_path):
    line = [t for t in cooperative.settings("paper", StudyOptions())["simple_spread-matd3"] if "seeds" not in t]
    fake_run(tmp_path / "runs" / "simple_spread-matd3", [*line, "algo.lr=0.003"], {"return_agents": (NOISE, NOISE)})
    with pytest.raises(UserError, match="other settings .*algo.actor_lr 0.003 there, 0.01 here.*remove it, or choose"):
        cooperative.main([f"runs={tmp_path}", f"out={tmp_path / 'out'}"])
    with pytest.raises(UserError, match="task=ant scale=small"):
        grid_search.main(["task=ant", "scale=small"])


@pytest.mark.slow
def test_training_from_the_command(tmp_path):
    """A study trains a setting, reports it, and the next time uses it as it is."""
    argv = ["scale=small", "only=simple_spread-maddpg", "seeds=2", "total_steps=1000", "algo.hidden=[8]",
            "log_every=200", "batch_size=16", "learning_starts=200", "replay_capacity=1000"]  # fmt: skip
    argv += [f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"]
    assert cooperative.main(argv) == 0
    table = tidy.read(tmp_path / "out" / "data.csv")
    assert table.values("seed") == [0, 1] and table.values("algo") == ["maddpg"]
    metrics = RunDirectory(tmp_path / "runs" / "runs" / "simple_spread-maddpg").read_metrics()
    episodes = table.by_seed("episodes").sum(axis=1)
    assert episodes.tolist() == [44, 44]  # of 25 steps; whole intervals: 1,100 env steps
    # The last fifth: eight episodes, the last row (200 env steps) alone.
    last = metrics["return_agents"][metrics["step"] == metrics["step"].max()]
    np.testing.assert_allclose(tidy.final(table, "return_agents"), last, rtol=1e-4)
    shutil.rmtree(tmp_path / "runs")
    assert cooperative.main(argv) == 0
    assert not (tmp_path / "runs").exists()
