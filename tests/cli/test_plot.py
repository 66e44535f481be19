"""`plot`: run directories as the trainer leaves them, curves and bands against NumPy and SciPy on the raw rows."""

import dataclasses
import functools

import matplotlib.colors
import numpy as np
import pytest
import scipy.stats
from matplotlib.figure import Figure

from matd3_jax import config, lists
from matd3_jax.cli import plot
from matd3_jax.config.diff import label_differences
from matd3_jax.errors import UserError
from matd3_jax.figures import style
from matd3_jax.runs import curves
from matd3_jax.runs.directory import RunDirectory, together


@functools.cache
def load(*overrides):
    return config.load(overrides)


def make_run(path, *overrides, change=None, steps=(100, 200, 300, 400), values=None, evaluated=True):
    """A run directory without training: returns [seeds, rows] (random if not given) at `steps`, 25 steps an episode."""
    settings = dataclasses.replace(load(*overrides), **(change or {}))
    run = RunDirectory.create(path, settings, {})
    seeds = np.arange(settings.seed, settings.seed + settings.seeds)
    rng = np.random.default_rng([settings.seed, len(steps)])
    values = rng.normal(size=(len(seeds), len(steps))) if values is None else np.asarray(values, float)
    for k, (step, before) in enumerate(zip(steps, (0, *steps), strict=False)):
        row = {
            "step": np.full(len(seeds), step),
            "seed": seeds,
            "updates": np.full(len(seeds), max(0, step - 100)),
            "episodes": np.full(len(seeds), (step - before) // 25),
            "return_agents": values[:, k].astype(np.float32),
            "agent_0_critic_loss": np.full(len(seeds), np.nan if k == 0 else 1.5, np.float32),
        }
        run.append({**row, "eval_return_agents": 2 * row["return_agents"]} if evaluated else row)
    return values.astype(np.float32)


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Run the command in an empty directory; the figure that it writes."""
    figures = []
    written = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), written(self, *a, **k))[1])
    monkeypatch.chdir(tmp_path)

    def call(*argv):
        assert plot.main(argv) == 0
        return figures[-1]

    return call


def lines(axis):
    """Label to (x, y) of the lines with a label."""
    return {line.get_label(): line.get_data() for line in axis.lines if not line.get_label().startswith("_")}


def bands(axis):
    """(low, high) at each point, of each band."""
    for band in axis.collections:
        corners = band.get_paths()[0].vertices
        xs = np.unique(corners[:, 0])
        yield np.array([[corners[corners[:, 0] == x, 1].min(), corners[corners[:, 0] == x, 1].max()] for x in xs]).T


# ---- the command -----------------------------------------------------------------------------------------------------


def test_a_curve_for_each_setting(drawn, tmp_path, capsys):
    """Two runs with other seeds are one curve; mean and Student's interval over all five seeds, from the raw rows."""
    a = make_run(tmp_path / "a", "seeds=3")
    b = make_run(tmp_path / "b", "seeds=2", "seed=3", "name=b")
    c = make_run(tmp_path / "c", "algo=maddpg", "seeds=2", steps=(100, 200, 300))
    (axis,) = drawn("runs=a,c,b").axes
    found = lines(axis)
    assert list(found) == ["matd3 (5 seeds)", "maddpg (2 seeds)"]
    x, y = found["matd3 (5 seeds)"]
    both = np.concatenate([a, b]).astype(float)
    np.testing.assert_array_equal(x, [100, 200, 300, 400])
    np.testing.assert_allclose(y, both.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found["maddpg (2 seeds)"][1], c.mean(axis=0), rtol=1e-6)  # not done: as far as it is
    want = scipy.stats.ttest_1samp(both, 0).confidence_interval(0.95)
    np.testing.assert_allclose(next(bands(axis)), want, rtol=1e-5)
    assert axis.get_title() == "simple_spread" and axis.get_ylabel() == "training return"
    assert axis.get_xlabel() == "env steps of each seed"
    assert axis.get_legend().get_title().get_text() == "mean of the seeds, 95 % interval"
    out = capsys.readouterr().out
    assert f"matd3: return_agents {both.mean(axis=0)[-1]:.4g} (95 % interval: " in out and "at step 300" in out


@pytest.mark.parametrize("average", ("mean", "median", "iqm"))
def test_averages_and_bands(drawn, tmp_path, average):
    values = make_run(tmp_path / "a", "seeds=6").astype(float)
    by = {"mean": np.mean, "median": np.median, "iqm": lambda v, axis: scipy.stats.trim_mean(v, 0.25, axis)}[average]
    (axis,) = drawn("runs=[a]", f"average={average}", "interval=bootstrap", "each=true").axes
    np.testing.assert_allclose(lines(axis)["matd3"][1], by(values, axis=0), rtol=1e-5)
    assert sum(len(line.get_xdata()) == 4 for line in axis.lines) == 7  # six seeds and their average
    reference = scipy.stats.bootstrap((values,), by, axis=0, method="percentile", random_state=1, n_resamples=20_000)
    low, high = next(bands(axis))
    width = reference.confidence_interval.high - reference.confidence_interval.low
    np.testing.assert_allclose((low - reference.confidence_interval.low) / width, 0, atol=0.08)
    np.testing.assert_allclose((high - reference.confidence_interval.high) / width, 0, atol=0.08)
    if average == "mean":
        (axis,) = drawn("runs=a", "interval=sd").axes
        mean, sd = values.mean(axis=0), values.std(axis=0, ddof=1)
        np.testing.assert_allclose(next(bands(axis)), [mean - sd, mean + sd], rtol=1e-5)
        (axis,) = drawn("runs=a", "interval=none").axes
        assert axis.get_legend().get_title().get_text() == "mean of 6 seeds"


def test_several_columns_and_axes(drawn, tmp_path):
    values = make_run(tmp_path / "a", "seeds=2")
    figure = drawn("runs=a", "y=return_agents,eval_return_agents,agent_0_critic_loss", "x=episodes", "title=Some words")
    first, second, third, hidden = figure.axes
    assert [axis.get_ylabel() for axis in (first, second, third)] == [
        "training return",
        "evaluation return",
        "agent 0 critic loss",
    ]
    assert not hidden.get_visible() and len(figure.legends) == 1 and figure.get_suptitle() == "Some words"
    np.testing.assert_array_equal(lines(first)["matd3"][0], [4, 8, 12, 16])
    np.testing.assert_allclose(lines(second)["matd3"][1], 2 * values.mean(axis=0), rtol=1e-5)
    np.testing.assert_array_equal(lines(third)["matd3"][0], [8, 12, 16])  # nan before learning starts
    (axis,) = drawn("runs=a", "x=updates").axes
    np.testing.assert_array_equal(lines(axis)["matd3"][0], [0, 100, 200, 300])


def test_many_curves_can_be_distinguished(drawn, tmp_path):
    for k in range(12):
        algo = dataclasses.replace(load("seeds=2").algo, tau=(k + 1) / 100)
        make_run(tmp_path / "sweep" / f"run{k:02}", "seeds=2", change={"algo": algo})
    figure = drawn("runs=sweep/*", "out=curves.pdf")
    (axis,) = figure.axes
    assert list(lines(axis)) == [f"tau={(k + 1) / 100}" for k in range(12)]
    looks = {(line.get_color(), line.get_linestyle(), line._unscaled_dash_pattern) for line in axis.lines}
    assert len(looks) == 12 and len(figure.legends) == 1 and axis.get_legend() is None
    assert axis.get_title() == "simple_spread, matd3"
    # No grey twins and no faint ones: each color has contrast to white, and to its neighbors in the order of drawing.
    luminance = [matplotlib.colors.to_rgb(color) @ np.array([0.2126, 0.7152, 0.0722]) for color in style.SERIES]
    assert max(luminance) < 0.75
    assert len({(k % len(style.SERIES), k % len(style.STYLES)) for k in range(35)}) == 35


@pytest.mark.parametrize(("name", "begins"), [("a.png", b"\x89PNG"), ("a.pdf", b"%PDF"), ("a.svg", b"<?xml")])
def test_formats(drawn, tmp_path, name, begins):
    make_run(tmp_path / "a", "seeds=1", steps=(100,))  # one seed, one row: still something to see
    (axis,) = drawn("runs=a", f"out={name}").axes
    assert (tmp_path / name).read_bytes().startswith(begins)
    assert axis.get_legend().get_title().get_text() == "one seed" and axis.lines[-1].get_marker() == "o"
    if name == "a.svg":
        assert ">training return<" in (tmp_path / name).read_text()  # letters, not outlines


def test_labels_of_ones_own(drawn, tmp_path):
    make_run(tmp_path / "a", "seeds=2")
    make_run(tmp_path / "b", "seeds=2", "algo=maddpg")
    (axis,) = drawn("runs=a,b", "labels='ours, new',MADDPG (2017)").axes
    assert list(lines(axis)) == ["ours, new", "MADDPG (2017)"]


@pytest.fixture(scope="module")
def some_runs(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs")
    make_run(path / "a", "seeds=2")
    make_run(path / "first", "seeds=2", steps=(100,))
    make_run(path / "other", "seeds=2", "algo=maddpg", evaluated=False)
    RunDirectory.create(path / "new", load("seed=9"), {})
    return path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "runs=A,B is missing"),
        (["runs=nowhere"], "there is no run directory nowhere"),
        (["runs=."], "no config.yaml"),
        (["runs=x*"], r"runs=x\*: no run directory matches"),
        (["runs=new"], "new has no metrics yet"),
        (["runs=a,a"], "a and a have the same settings and both the seed 0"),
        (["runs=a", "y=return_agent"], "y=return_agent: a has no such column; did you mean 'return_agents'"),
        (["runs=a", "y=seed"], "y=seed"),
        (["runs=a,other", "y=eval_return_agents"], "y=eval_return_agents: other has no such column"),
        (["runs=first", "y=agent_0_critic_loss"], "y=agent_0_critic_loss of first: no values with seed 0"),
        (["runs=a", "y="], "say what to draw"),
        (["runs=a", "x=time"], "x=time: must be one of step, episodes, updates"),
        (["runs=a", "out=a.gif"], "out=a.gif: must end with one of .png, .pdf, .svg"),
        (["runs=a", "out=b/a.png"], "there is no directory b"),
        (["runs=a", "average=mode"], "average=mode: must be one of mean, median, iqm"),
        (["runs=a", "average=median", "interval=t"], "interval=t: must be one of bootstrap, none"),
        (["runs=a", "window=0"], "window=0: must be a whole number"),
        (["runs=a", "window=100", "y=eval_return_agents"], "from evaluations"),
        (["runs=a", "labels=b,c"], "labels=b,c: names 2, but there are 1: matd3"),
        (["runs=a", "labels='b"], "labels: .* quotation mark"),
        (["runs='a"], "runs: .* quotation mark"),
        (["runs=~no such user/a"], "there is no run directory ~no such user/a"),
        (["runs=a\0*"], r"runs='a\\x00\*': no file can have this name"),
        (["runs=a", "each=1"], "each=1: must be true or false"),
        (["runs=a", "color=red"], "there is no key 'color'"),
        (["runs=a", "y"], "cannot read 'y'"),
    ],
)
def test_errors_are_one_line(some_runs, monkeypatch, arguments, message):
    monkeypatch.chdir(some_runs)
    with pytest.raises(UserError, match=message) as caught:
        plot.main(arguments)
    assert "\n" not in str(caught.value)
    assert not list(some_runs.glob("*.png"))


# ---- curves of tables ------------------------------------------------------------------------------------------------


def table(*seeds):
    """Columns of (steps, episodes, returns) for each seed."""
    parts = [(np.full(len(steps), i), *seed) for i, seed in enumerate(seeds) for steps in seed[:1]]
    seed, step, episodes, value = (np.concatenate(column).astype(float) for column in zip(*parts, strict=True))
    return {"seed": seed, "step": step, "updates": step, "episodes": episodes, "return_agents": value, "eval_x": value}


def test_window_is_the_mean_of_the_last_episodes():
    """Against a list of all episodes, each with its row's mean."""
    rng = np.random.default_rng(0)
    episodes, values = rng.integers(0, 7, size=40), rng.normal(size=40)
    episodes[0] = 5
    found = curves.of_table(table((np.arange(1, 41) * 10, episodes, values)), "return_agents", window=17)
    played = [np.repeat(values[: k + 1], episodes[: k + 1])[-17:].mean() for k in range(40)]
    np.testing.assert_allclose(found.values[0], np.array(played)[episodes > 0])
    np.testing.assert_array_equal(found.x, (np.arange(1, 41) * 10)[episodes > 0])


def test_other_chunk_lengths():
    """The seed with the fewest rows gives the points; the other has means over the same env steps, each counted."""
    rng = np.random.default_rng(1)
    fine, coarse = np.array([30, 50, 70, 90, 110, 130, 150]), np.array([40, 80, 120, 200])
    values = rng.normal(size=7)
    both = table((fine, np.ones(7), values), (coarse, np.ones(4), [1.0, 2, 3, 4]))
    found = curves.of_table(both, "return_agents")
    by_step = np.repeat(values, np.diff(fine, prepend=0))
    np.testing.assert_array_equal(found.x, [40, 80, 120])  # as far as both go
    np.testing.assert_allclose(found.values[0], [by_step[a:b].mean() for a, b in ((0, 40), (40, 80), (80, 120))])
    np.testing.assert_array_equal(found.values[1], [1, 2, 3])
    np.testing.assert_array_equal(found.ends, [150, 200])
    evaluations = curves.of_table(both, "eval_x")  # made at one moment: interpolated
    np.testing.assert_allclose(evaluations.values[0], np.interp([40, 80, 120], fine, values))


def test_episodes_of_different_lengths():
    """Over episodes the seeds' rows stand at other places; a curve that is the same function of them stays it."""
    one, other = np.array([2, 3, 1, 4]), np.array([1, 1, 2, 5])
    both = table(*(([10, 20, 30, 40], e, 3.0 * np.cumsum(e)) for e in (one, other)))
    found = curves.of_table({**both, "eval_x": both["return_agents"]}, "eval_x", "episodes")
    np.testing.assert_array_equal(found.x, [2, 5, 6])  # up to 9, as far as both go, both have three rows: the first's
    np.testing.assert_allclose(found.values, 3 * np.array([[2, 5, 6], [2, 5, 6.0]]))


def test_missing_values():
    """A row without an ended episode is filled in; a seed that has only nan in the end ends the curve of all."""
    nan, steps = np.nan, np.array([10, 20, 30, 40, 50])
    both = table((steps, [1, 0, 1, 1, 1], [1.0, nan, 3, 4, 5]), (steps, [1] * 5, [2.0, 3, 4, nan, nan]))
    found = curves.of_table(both, "return_agents")
    np.testing.assert_array_equal(found.x, [10, 30])
    np.testing.assert_allclose(found.values, [[1, 3], [2, 3.5]])
    np.testing.assert_array_equal(found.ends, [50, 30])
    with pytest.raises(ValueError, match="no values with seed 1"):
        curves.of_table(table((steps, [1] * 5, steps), (steps, [1] * 5, [nan] * 5)), "return_agents")
    with pytest.raises(ValueError, match="end at 20, before those of another begin"):
        curves.of_table(table((steps[:2], [1] * 2, [1.0, 2]), (steps[2:], [1] * 3, [1.0, 2, 3])), "return_agents")


def test_seeds_that_end_early_are_reported(drawn, tmp_path, capsys):
    values = np.arange(20.0).reshape(2, 10)
    values[1, 2:] = np.nan
    make_run(tmp_path / "a", "seeds=2", steps=range(100, 1100, 100), values=values)
    (axis,) = drawn("runs=a").axes
    np.testing.assert_allclose(lines(axis)["matd3"][1], values[:, :2].mean(axis=0))
    assert "the values with seed 1 end; others reach 1,000" in capsys.readouterr().out


def test_seeds_that_diverged_are_reported(drawn, tmp_path, capsys):
    """Even where what they play has a finite return."""
    make_run(tmp_path / "a", "seeds=2", steps=range(100, 1100, 100), values=np.arange(20.0).reshape(2, 10))
    metrics = tmp_path / "a" / "metrics.csv"
    header, *rows = metrics.read_text().splitlines()
    names = header.split(",")
    for k, row in enumerate(rows):
        cells = row.split(",")
        if cells[1] == "1" and int(cells[0]) >= 400:
            cells[names.index("agent_0_critic_loss")] = "inf"
        rows[k] = ",".join(cells)
    metrics.write_text("\n".join([header, *rows]) + "\n")
    (axis,) = drawn("runs=a").axes
    np.testing.assert_array_equal(lines(axis)["matd3"][0], [100, 200, 300])
    out = capsys.readouterr().out
    assert "the values with seed 1 end; others reach 1,000" in out and "seed 1 diverged at 400: values from" in out


# ---- tables of several runs ------------------------------------------------------------------------------------------


def test_together(tmp_path):
    b = make_run(tmp_path / "b", "seeds=2", "seed=3", "log_every=100", "total_steps=2e6", evaluated=False)
    a = make_run(tmp_path / "a", "seeds=3", steps=(100, 200))
    joined = together([tmp_path / "b", tmp_path / "a"])
    assert "eval_return_agents" not in joined
    np.testing.assert_array_equal(joined["step"], np.repeat([100, 200, 300, 400], [5, 5, 2, 2]))
    np.testing.assert_array_equal(joined["seed"], [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 3, 4, 3, 4])
    for seed, want in enumerate([*a, *b]):
        np.testing.assert_array_equal(joined["return_agents"][joined["seed"] == seed].astype(np.float32), want)
    make_run(tmp_path / "c", "seeds=2", "seed=5", "algo.tau=0.02")
    with pytest.raises(UserError, match=r"c is no run with other seeds of .*a: algo.tau=0.02, not 0.01"):
        together([tmp_path / "a", tmp_path / "c"])
    make_run(tmp_path / "d", "seeds=2", "seed=2")
    with pytest.raises(UserError, match="a and .*d have the same settings and both the seed 2"):
        together([tmp_path / "a", tmp_path / "d"])


def test_a_table_that_is_being_written(tmp_path):
    """Whatever was cut off at the end of the file, only whole intervals are read, with whole numbers."""
    want = make_run(tmp_path / "a", "seeds=3")
    run, _ = RunDirectory.open(tmp_path / "a")
    text = run.metrics.read_bytes()
    for end in range(text.index(b"\r\n400,") + 2, len(text) - 1):
        run.metrics.write_bytes(text[:end])
        table = run.read_metrics()
        assert table["step"].tolist() == [100] * 3 + [200] * 3 + [300] * 3
        np.testing.assert_array_equal(table["return_agents"].reshape(3, 3).astype(np.float32), want[:, :3].T)


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("A,B", ["A", "B"]),
        ("[A, B]", ["A", "B"]),
        ("a b=0.10,'c, d',e's", ["a b=0.10", "c, d", "e's"]),
        ("it's, that's,\"'f\"", ["it's", "that's", "'f"]),
        ("'a,b", None),
        ("'a'b", None),
        ("'[a]'", ["[a]"]),
        ("a,,'',b,", ["a", "b"]),
        ("", []),
    ],
)
def test_words(text, want):
    if want is None:
        with pytest.raises(UserError, match="quotation"):
            lists.words(text)
    else:
        assert lists.words(text) == want


# ---- labels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("runs", "want"),
    [
        ([""], ["matd3"]),
        (["algo.lr=0.003", "algo.lr=0.001", ""], ["lr=0.003", "lr=0.001", "lr=0.01"]),
        # What the name of an algorithm or of an environment brings along goes without saying; other values do not.
        (["algo=matd3", "algo=maddpg", "algo=iltd3"], ["matd3", "maddpg", "iltd3"]),
        (["env=ant recipe=paper", "env=simple_tag"], ["ant", "simple_tag"]),
        (["", "algo=maddpg algo.lr=0.003"], ["matd3, lr=0.01", "maddpg, lr=0.003"]),
        (["", "algo=maddpg algo.policy_delay=3"], ["matd3, policy_delay=2", "maddpg, policy_delay=3"]),
        (["env=simple_spread env.num_agents=5", "env=simple_tag"], ["simple_spread, num_agents=5", "simple_tag"]),
        (
            ["env=simple_tag", "env=simple_tag adversary=maddpg", "env=simple_tag algo=maddpg adversary=matd3"],
            ["matd3", "matd3 vs maddpg", "maddpg vs matd3"],
        ),
        (["env=simple_tag algo.tau=0.02", "env=simple_tag"], ["tau=0.02", "tau=0.01"]),
        (
            ["env=simple_tag adversary.tau=0.02", "env=simple_tag"],
            ["tau=0.02", "tau=0.01"],
        ),
        (
            ["env=simple_tag algo.tau=0.03 adversary.tau=0.02", "env=simple_tag"],
            ["algo.tau=0.03, adversary.tau=0.02", "algo.tau=0.01, adversary.tau=0.01"],
        ),
        (
            ["algo.actor_lr=0.02", "algo.hidden=[32,32] shared_minibatch=true"],
            [
                "actor_lr=0.02, hidden=[64,64], shared_minibatch=false",
                "actor_lr=0.01, hidden=[32,32], shared_minibatch=true",
            ],
        ),
        (["seeds=3", "seeds=3 seed=3"], ["matd3, seeds 0 to 2", "matd3, seeds 3 to 5"]),
        (
            ["", "total_steps=2e6", "algo=maddpg"],
            ["matd3, total_steps=1500000", "matd3, total_steps=2000000", "maddpg"],
        ),
        (["", "", "algo.tau=0.5"], ["tau=0.01 (1)", "tau=0.01 (2)", "tau=0.5"]),
    ],
)
def test_labels(runs, want):
    assert label_differences([load(*run.split()) for run in runs]) == want
