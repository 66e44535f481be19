"""The comparison of populations with random search: ratios by hand, its intervals, files, resuming, options."""

import itertools
import math

import numpy as np
import pictures
import pytest

from experiments import populations, populations_data
from experiments.populations import PBT, PopulationOptions
from experiments.populations_data import RANDOM, Data
from matd3_jax.cli import sweep
from matd3_jax.errors import UserError

written = pytest.fixture(pictures.written)

STEPS = np.arange(0, 2001, 100)
TINY = [
    "learning_starts=200", "algo.hidden=[4]", "batch_size=8", "eval_episodes=1", "num_envs=2", "replay_capacity=400",
    "members=2", "populations=1", "steps=600", "only=simple_spread", "algo.policy_delay=1",
]  # fmt: skip


def made_up(quicker=2.0):
    """Returns that grow with env steps, PBT's `quicker`; the second member of three is the best, the last is lost."""
    found = Data({}, {}, {})
    for method, speed in ((RANDOM, 1.0), (PBT, quicker)):
        key = ("simple_spread", method)
        found.steps[key] = STEPS
        grown = np.minimum(speed * STEPS, 1800.0)
        values = grown * np.array([0.5, 1.0, 0.2])[:, None] + np.arange(7)[:, None, None]
        values[:, 2, 5] = np.nan
        found.values[key] = values
        found.facts[populations_data.label(*key)] = ["made=up"]
    return found


def test_the_best_member_is_that_of_the_late_means():
    """The mean over the last tenth, 200 steps: the evaluation and the one before it."""
    data = made_up()
    curve = populations_data.best(STEPS, data.values["simple_spread", RANDOM])
    assert curve.shape == (7, len(STEPS))
    np.testing.assert_allclose(curve[3, 1:10] - 3, [50 + 100 * k for k in range(9)])
    lost = np.full((1, 1, 3), np.nan)
    assert (populations_data.best(STEPS[:3], lost) == -np.inf).all()


def test_ratios_of_env_steps():
    """Random search has its last value, 1800, when it is at 1900; twice as quick one is there at 1000."""
    assert populations_data.ratios(made_up(), "simple_spread", PBT).tolist() == [1000 / 1900] * 7
    assert populations_data.ratios(made_up(0.5), "simple_spread", PBT).tolist() == [math.inf] * 7
    slow = made_up()
    slow.values["simple_spread", PBT][2] -= 1e4
    assert np.isinf(populations_data.ratios(slow, "simple_spread", PBT)).tolist() == [k == 2 for k in range(7)]


@pytest.mark.parametrize("n", [1, 5, 6, 7, 10, 23])
def test_the_interval_of_a_median_is_the_sign_tests(n):
    """By counting: with k of n below the true median the interval holds it from the lower place to the upper one."""
    values = np.random.default_rng(n).permutation(n).astype(float)

    def coverage(outside):
        return sum(math.comb(n, k) for k in range(outside + 1, n - outside)) / 2**n

    fitting = [outside for outside in range(n // 2 + 1) if outside < n - 1 - outside and coverage(outside) >= 0.95]
    middle, low, high = populations_data.median_interval(values)
    assert middle == (n - 1) / 2
    if not fitting:
        assert n < 6 and np.isnan([low, high]).all()
    else:
        assert (low, high) == (fitting[-1], n - 1 - fitting[-1])


def test_what_is_claimed_and_told(tmp_path, written, capsys):
    data = made_up()
    data.write(tmp_path)
    again = Data.read(tmp_path)
    for key, values in data.values.items():
        np.testing.assert_allclose(again.values[key], values)
        np.testing.assert_array_equal(again.steps[key], STEPS)
    assert again.facts == data.facts
    populations.report(again, tmp_path)
    said = capsys.readouterr().out
    assert "ratio 0.5263; 7 of 7 populations reach it" in said
    assert "| simple_spread | PBT | 3 | 7 | 2,000 | 1,803 | 0.5263 (0.5263 to 0.5263) |" in said
    first, second, *others = populations.claims(again)
    assert first.verdict == "same" and second.difference.estimate == 0
    assert len(others) == 4 and all(claim.verdict == "not yet run" for claim in others)
    assert populations.claims(made_up(0.5))[0].verdict == "opposite"
    few = made_up()
    few.values = {key: values[:5] for key, values in few.values.items()}
    assert populations.claims(few)[0].verdict == "not shown"
    (axis,) = written[tmp_path / "figure.png"].axes
    assert set(pictures.lines(axis)) == {"random search (7 populations)", "PBT (7 populations)"}
    assert Data.read(tmp_path / "none").values == {}
    (tmp_path / "data.csv").write_text("task,method\n1,2\n")
    with pytest.raises(UserError, match="cannot read"):
        Data.read(tmp_path)


def test_methods_differ_in_nothing_else():
    for scale, task in itertools.product(populations.SCALES, populations.TASKS):
        options = PopulationOptions(scale=scale, replays=True)
        lines = [populations.arguments(task, method, options) for method in populations.methods(task, options)]
        plain = [[text for text in line if not text.startswith("pbt")] for line in lines]
        assert plain[0] == plain[1] == plain[2] == lines[0] and len(lines[2]) > len(lines[1]) > len(lines[0])
        later = [[f"pbt_start={populations.START[task]}"]] if task in populations.START else []
        assert [[text for text in line if text not in lines[1]] for line in lines[3:]] == later
        of = sweep.catalog.SWEEP.parse(lines[1])
        chosen, settings = sweep.read(of.settings, of.samples, of.sample_seed)
        values = dict(zip(settings, chosen, strict=True))
        rules = sweep.population_rules(of, populations_data.METRIC, values, settings)
        size = populations.SCALES[scale][task]
        assert (len(settings), next(iter(settings.values())).seeds) == size[:2] and size.populations >= 6
        assert rules.every == size.steps // 20 == next(iter(settings.values())).eval_every


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["only=simple_tag"], "matches none of"),
        (["algo.tau=0.1"], "cannot take algo.tau= here"),
        (["seeds=3"], "cannot take seeds= here"),
        (["membrs=4"], "no key 'membrs'; did you mean 'members'"),
        (["algo.lrr=4"], "no key 'algo.lrr'"),
        (["train=false"], "nothing to report"),
    ],
)
def test_bad_input_gets_one_line(arguments, words, tmp_path):
    with pytest.raises(UserError, match=words):
        populations.main([f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}", *arguments])
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_call_that_was_stopped_is_resumed(tmp_path, monkeypatch, capsys):
    """After the first of two sweeps; what is finished is not trained again, other settings are refused, and the
    report is that of the data that are kept."""
    given = [*TINY, f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"]
    train, calls = sweep.main, []

    def stopping(argv):
        calls.append(argv)
        return train(argv) if len(calls) != 2 else train([*argv, "train=false"]) or 143

    def reporting(data, out):
        reported.append(data)
        report(data, out)

    report, reported = populations.report, []
    monkeypatch.setattr(populations, "report", reporting)
    monkeypatch.setattr(sweep, "main", stopping)
    assert populations.main(given) == 143 and not (tmp_path / "out" / "table.md").exists()
    facts = tmp_path / "runs" / "simple_spread-pbt" / "sweep.json"
    facts.write_text(facts.read_text().replace(" train=false", ""))
    with pytest.raises(UserError, match="begun with other settings"):
        populations.main([text.replace("600", "700") for text in given])
    calls.clear()
    assert populations.main(given) == 0
    assert calls == [[f"resume={tmp_path / 'runs' / 'simple_spread-pbt'}"]]
    assert populations.main(given) == 0 and len(calls) == 1
    data = Data.read(tmp_path / "out")
    assert {values.shape[:2] for values in data.values.values()} == {(1, 2)}
    for key, values in data.values.items():
        np.testing.assert_array_equal(reported[0].values[key], values)
    assert "| simple_spread | PBT | 2 | 1 |" in (tmp_path / "out" / "table.md").read_text()
