"""Selection and exploration against the rules written down again, the lineage by hand, and what cannot be a
population. Nothing is trained here."""

import collections
import itertools
import types

import numpy as np
import pytest

from matd3_jax.cli import sweep
from matd3_jax.errors import UserError
from matd3_jax.runtime.multihost import Processes
from matd3_jax.sweep import population, runner
from matd3_jax.sweep.lineage import Lineage, Stage, lines
from matd3_jax.sweep.population import Rules
from matd3_jax.sweep.runner import Sweep
from matd3_jax.sweep.search_space import SearchSpace
from matd3_jax.training.copying import Copier

TINY = [
    "env=point_reach", "algo=iddpg", "algo.hidden=[4]", "batch_size=8", "num_envs=2", "learning_starts=100",
    "replay_capacity=200", "total_steps=600", "log_every=50", "eval_every=0",
]  # fmt: skip


def axis(text):
    return SearchSpace.parse([text]).axes[0]


# ---- selection -------------------------------------------------------------------------------------------------------


def test_the_worst_copy_one_of_the_best():
    """20 % of 10 are two, each copy drawn from the best two; every pair comes."""
    scores = np.array([3.0, -7, 12, 0, 5, -2, 8, 1, 11, 2])
    seen = collections.Counter()
    for seed in range(200):
        pairs = population.select(scores, np.zeros(10, bool), 0.2, np.random.default_rng(seed))
        assert [loser for loser, _ in pairs] == [1, 5]
        seen.update(pairs)
    assert set(seen) == set(itertools.product((1, 5), (2, 8))) and min(seen.values()) > 60


@pytest.mark.parametrize(
    "members, fraction, number", [(2, 0.5, 1), (3, 0.5, 1), (4, 0.2, 1), (10, 0.3, 3), (30, 0.1, 3), (8, 0.5, 4)]
)
def test_how_many_copy(members, fraction, number):
    scores = np.random.default_rng(1).normal(size=members)
    pairs = population.select(scores, np.zeros(members, bool), fraction, np.random.default_rng(0))
    order = sorted(range(members), key=lambda m: scores[m])
    assert [loser for loser, _ in pairs] == order[:number]
    assert {winner for _, winner in pairs} <= set(order[-number:])


def test_who_diverged_or_has_no_score_loses():
    nothing, rng = np.nan, np.random.default_rng(0)

    def chosen(scores, diverged, fraction=0.2):
        return population.select(np.array(scores), np.array(diverged, bool), fraction, rng)

    assert chosen([9.0, nothing, 3, 4, 5], [0, 0, 0, 0, 0]) == [(1, 0)]
    assert chosen([9.0, nothing, 3, 4, 5], [1, 0, 0, 0, 0]) == [(0, 4)]  # however good it was
    assert sorted(chosen([9.0, 8, 3, 4, 5], [1, 1, 1, 0, 0])) == [(0, 4), (1, 4), (2, 4)]  # all that diverged
    assert chosen([nothing] * 5, [0, 1, 0, 0, 0]) == [] == chosen([1.0] * 5, [1] * 5)
    assert chosen([1.0, nothing, nothing], [0, 0, 0], 0.5) == [(1, 0)]


def test_nobody_copies_one_that_is_no_better():
    """Before learning starts all members play alike, and a copy would only lose a setting."""
    nobody = np.zeros(4, bool)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert population.select(np.full(4, -3.0), nobody, 0.5, rng) == []
        assert population.select(np.array([2.0, 2, 1, 2]), nobody, 0.25, rng)[0][0] == 2
        two = population.select(np.array([2.0, 5, 2, 2]), nobody, 0.5, rng)
        assert len(two) == 2 and {parent for _, parent in two} == {1}
        assert population.select(np.array([2.0, 2, 2, np.nan]), np.array([0, 0, 0, 1], bool), 0.25, rng)[0][0] == 3


# ---- exploration -----------------------------------------------------------------------------------------------------


def test_numbers_are_multiplied_and_stay_in_their_interval():
    rate, rng = axis("algo.lr=interval(1e-4,1e-2)"), np.random.default_rng(0)
    moved = [float(rate.perturb("0.002", rng)) for _ in range(400)]
    assert set(moved) == {0.0016, 0.0024} and 150 < moved.count(0.0024) < 250
    assert {rate.perturb("0.009", rng) for _ in range(40)} == {"0.0072", "0.01"}
    assert {rate.perturb("0.00012", rng) for _ in range(40)} == {"0.0001", "0.000144"}
    noise = axis("algo.exploration_noise=interval(0,0.5)")
    assert {noise.perturb("0", rng) for _ in range(20)} == {"0.0"}  # nothing times anything
    odd = axis("a=interval(0.123456,0.765432)")
    reached = {float(odd.perturb(value, rng)) for value in ("0.13", "0.76") for _ in range(40)}
    assert reached == {0.123456, 0.156, 0.608, 0.765432}  # an end itself, not rounded beyond it


def test_whole_numbers_move_by_one_at_least():
    size, rng = axis("a=int(interval(1,40))"), np.random.default_rng(0)
    for value, found in {"3": {"2", "4"}, "1": {"1", "2"}, "40": {"32", "40"}, "20": {"16", "24"}}.items():
        assert {size.perturb(value, rng) for _ in range(40)} == found


def test_in_a_list_the_neighbors_are_tried():
    rng = np.random.default_rng(0)
    rate = axis("algo.lr=0.01,0.001,0.003")
    for value, found in {"0.003": {"0.001", "0.01"}, "0.01": {"0.003", "0.01"}, "0.001": {"0.001", "0.003"}}.items():
        assert {rate.perturb(value, rng) for _ in range(40)} == found
    ranges = axis("algo.exploration_noise=[0.1,0.2],[0,0.4],[0,1]")  # no numbers: as they are listed
    assert {ranges.perturb("[0,0.4]", rng) for _ in range(40)} == {"[0.1,0.2]", "[0,1]"}


def test_resampled_values_are_anywhere_in_the_search_space():
    axes, rng = SearchSpace.parse(["algo.lr=interval(1e-4,1e-2)", "algo.tau=0.01,0.02,0.05"]).axes, None
    rng = np.random.default_rng(0)
    drawn = [population.explored(axes, ("0.0001", "0.01"), "resample", rng) for _ in range(300)]
    rates = np.log10([float(rate) for rate, _ in drawn])
    assert abs(np.median(rates) + 3) < 0.2 and rates.min() < -3.8 and rates.max() > -2.2
    assert min(collections.Counter(tau for _, tau in drawn).values()) > 70
    near = {population.explored(axes, ("0.001", "0.02"), "perturb", rng) for _ in range(100)}
    assert near == set(itertools.product(("0.0008", "0.0012"), ("0.01", "0.05")))  # each key by itself


# ---- along training --------------------------------------------------------------------------------------------------


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """(makes the two populations of three members of a batch that does not train, what was copied, the rates that were
    set, who has diverged)."""
    copied, rates, diverged = [], [], {}
    monkeypatch.setattr(Copier, "copy", lambda self, state, *more: copied.append(more) or state)

    def change(each):
        rates.append([config.algo.critic_lr for config in each])

    training = types.SimpleNamespace(
        members=[types.SimpleNamespace(name=name) for name in "abc"], trainer=None, total_steps=1000,
        config=types.SimpleNamespace(seed_numbers=range(5, 7)), change_hyper=change,
        env=types.SimpleNamespace(on_host=False),
    )  # fmt: skip
    settings = {name: {"algo.lr": value} for name, value in zip("abc", ("0.1", "0.2", "0.4"), strict=True)}
    overrides = (*TINY, "algo.lr=interval(0.01,1)")
    rules = Rules(100, 0.2, "perturb", False, 3, overrides, "return_agents", settings)
    return lambda: population.Population(rules, training, diverged, tmp_path / "pbt.csv"), copied, rates, diverged


def row(step, *returns):
    return {"step": np.full(6, step), "return_agents": np.array(returns)}


def test_who_ended_no_episode_keeps_the_last_score_also_after_a_resume(stub, tmp_path):
    make, copied, rates, _ = stub
    nothing, own = np.nan, make()
    own.begin(row(40, 1, nothing, 2, 5, 3, 6))  # settings first: a a b b c c
    assert own("state", row(90, nothing, 4, nothing, nothing, nothing, nothing), 40) == "state" and not copied
    again = make()
    again.restore(own.write(tmp_path).parent)
    for one in (own, again):
        copied.clear()
        one("state", row(140, nothing, nothing, 0.5, 5, nothing, nothing), 90)
        assert [sources for sources, *_ in copied] == [{2: 4, 1: 5}]  # b copies c, a copies c
        np.testing.assert_array_equal(one.scores, [[1, 6], [3, 5], [3, 6]])
        np.testing.assert_array_equal(one.lineage.scores[1], [[1, 4], [0.5, 5], [3, 6]])
    assert own.lineage.table() == again.lineage.table() and rates[1] == rates[2]
    np.testing.assert_allclose(rates[0], [0.1, 0.1, 0.2, 0.2, 0.4, 0.4])  # at the resume
    for place, rate in enumerate(rates[1]):
        assert rate in ((0.32, 0.48) if place in (1, 2) else (rates[0][place],))
    own("state", row(1000, 1, 2, 3, 4, 5, 6), 990)  # nothing would follow
    assert len(copied) == 1 and len(rates) == 3


def test_who_diverged_takes_replay_and_environments_too_and_is_forgiven(stub):
    make, copied, _, diverged = stub
    own = make()
    own.begin(row(40, 1, 2, 3, 4, 5, 6))
    diverged |= {4: None}
    own("state", row(100, 1, 2, 3, 4, np.nan, 6), 40)
    assert copied == [({4: 2, 1: 5}, [4], [4])] and diverged == {}
    assert np.isnan(own.lineage.scores[1][2, 0]) and own.lineage.copied() == {"c": {5: 100}, "a": {6: 100}}
    damaged = make()
    with pytest.raises(UserError, match="cannot read the population in"):
        damaged.restore(own.path.parent / "none")


# ---- lineage ---------------------------------------------------------------------------------------------------------


def made_up() -> Lineage:
    """a, b, c, two populations; in the first c copies a at 200, then a copies c at 300."""
    found = Lineage(("lr", "noise"), ("a", "b", "c"), (4, 5))
    own = np.array([[0, 0], [1, 1], [2, 2]])
    values = [[("1", "[0,1]")] * 2, [("2", "[0,1]")] * 2, [("3", "[0,2]")] * 2]
    found.add(100, own, values, np.array([[1.0, 2], [3, 4], [5, np.nan]]))
    first, second = own.copy(), own.copy()
    first[2, 0], second[0, 0] = 0, 2
    values = [*values[:2], [("0.8", "[0,1]"), values[2][1]]]
    found.add(200, first, values, np.array([[9.0, 2], [3, 4], [-5.5, 1e-9]]))
    values = [[("0.96", "[0,2]"), values[0][1]], *values[1:]]
    found.add(300, second, values, np.zeros((3, 2)))
    return found


def test_a_schedule_leads_through_all_copies():
    lineage = made_up()
    start = Stage(100, "a", ("1", "[0,1]"))
    through = [start, Stage(200, "c", ("0.8", "[0,1]")), Stage(300, "a", ("0.96", "[0,2]"))]
    assert lineage.schedule(0, 0) == through and lineage.schedule(2, 0) == through[:2]
    assert lineage.schedule(1, 0) == [Stage(100, "b", ("2", "[0,1]"))]
    assert lineage.schedule(2, 1) == [Stage(100, "c", ("3", "[0,2]"))]
    assert lineage.copied() == {"c": {4: 200}, "a": {4: 300}}
    assert lines(through[:2], lineage.keys)[1] == "from env step 200: lr=0.8, noise=[0,1] (c)"


def test_the_table_is_read_as_it_was_written(tmp_path):
    lineage = made_up()
    lineage.write(tmp_path / "pbt.csv")
    again = Lineage.read(tmp_path / "pbt.csv")
    assert (again.keys, again.settings, again.seeds, again.steps) == (
        lineage.keys,
        lineage.settings,
        (4, 5),
        [100, 200, 300],
    )
    assert again.values == lineage.values
    np.testing.assert_array_equal(again.parents, lineage.parents)
    np.testing.assert_array_equal(again.scores, lineage.scores)
    rows = (tmp_path / "pbt.csv").read_text().splitlines()
    assert rows[0] == "step,seed,setting,parent,lr,noise,score" and rows[11] == '200,4,c,a,0.8,"[0,1]",-5.5'
    for wrong in (rows[:-1], rows[1:], rows[:1], [rows[0], *rows[2:]], [*rows[:2], "x", *rows[3:]]):
        (tmp_path / "pbt.csv").write_text("\n".join(wrong))
        with pytest.raises(UserError, match="cannot read the lineage"):
            Lineage.read(tmp_path / "pbt.csv")
    with pytest.raises(UserError, match="cannot read the lineage"):
        Lineage.read(tmp_path / "none.csv")


def test_selections_begin_at_the_start():
    """Every 100 env steps in intervals of 40; a sweep from before there was a start has none."""
    facts = {"every": 100, "fraction": 0.2, "explore": "perturb", "replay": False, "seed": 0, "overrides": []}
    for given, wanted in (({}, [120, 200, 320, 400]), ({"start": 200}, [200, 320, 400]), ({"start": 201}, [320, 400])):
        rules = Rules.of({"pbt": {**facts, **given}, "metric": "return_agents", "settings": {}})
        assert [step for step in range(40, 441, 40) if rules.due(step - 40, step)] == wanted
        assert Rules.of({"pbt": rules.facts, "metric": "return_agents", "settings": {}}) == rules


# ---- what will not do ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["algo.lr=0.1,0.2", "pbt_every=100"], "pbt_every= goes with pbt=true"),
        (["algo.lr=0.1,0.2", "pbt_replay=false"], "pbt_replay= goes with pbt=true"),
        (["pbt=true"], "a population has several members"),
        (["algo.lr=0.1,0.2", "pbt=maybe"], "pbt=maybe"),
        (["algo.lr=0.1,0.2", "pbt=true", "pbt_every=551"], "nobody would ever copy: .* the last but one ends at 550"),
        (["algo.lr=0.1,0.2", "pbt=true", "log_every=600"], "nobody would ever copy"),
        (
            ["algo.lr=0.1,0.2", "pbt=true", "pbt_every=100", "pbt_start=501"],
            "pbt_every=100 pbt_start=501: nobody would",
        ),
        (["algo.lr=0.1,0.2", "pbt=true", "pbt_start=-1"], "pbt_start=-1"),
        (["algo.lr=0.1,0.2", "pbt_start=100"], "pbt_start= goes with pbt=true"),
        (["algo.lr=0.1,0.2", "pbt=true", "pbt_fraction=0.6"], "pbt_fraction=0.6"),
        (["algo.lr=0.1,0.2", "pbt=true", "pbt_explore=mutate"], "pbt_explore=mutate"),
        (["algo.policy_delay=1,2", "pbt=true"], "algo.policy_delay=2 is not trained in one program"),
        (["algo.target_noise=0,0.1", "pbt=true"], "not in whether there is any target noise"),
        (["algo.lr=0.1,0.2", "seed=0,4", "pbt=true"], "seed=4 is not trained in one program"),
        (["algo.tau=interval(0.5,2)", "samples=2", "sample_seed=2", "pbt=true"], "members may come to algo.tau=2.0"),
        (["algo.lr=0.1,0.2", "pbt=true", "on_divergence=stop"], "on_divergence=stop: a sweep"),
        (["algo=hybrid", "algo.lr=0.1,0.2", "pbt=true"], "hybrid runs by two"),
        (["algo.lr=0.1,0.2", "pbt=true", "metric=eval_return_agents"], "no such column"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(arguments, words, tmp_path):
    with pytest.raises(UserError, match=words) as error:
        sweep.main([*TINY, f"out={tmp_path}", "name=bad", *arguments])
    assert "\n" not in str(error.value) and not (tmp_path / "bad").exists()


def test_all_members_fit_at_once_or_none_is_trained(tmp_path, monkeypatch):
    """Room for three seeds of four; and the replay of the seed that is being copied counts."""
    budgets = []

    def fitting(config, budget):
        budgets.append(budget)
        return 3

    monkeypatch.setattr(runner, "fitting_seeds", fitting)
    with pytest.raises(UserError, match="their 4 seeds do not fit into"):
        sweep.main([*TINY, f"out={tmp_path}", "name=bad", "algo.lr=0.1,0.2", "seeds=2", "pbt=true", "memory=5"])
    assert not (tmp_path / "bad").exists()
    row = 2 + 2 + 1 + 2 + 1  # as point_reach's are, two agents' parts together
    assert 0 < 5e9 - budgets[0] == runner.replay_bytes(population.load(SearchSpace.parse(TINY), []))
    assert 5e9 - budgets[0] >= 4 * 200 * row


def test_several_processes_are_refused(tmp_path):
    rules = Rules(10, 0.2, "perturb", False, 0, (), "return_agents", {})
    with pytest.raises(UserError, match="within one process, and these are 2"):
        Sweep(tmp_path, Processes(0, 2), rules)
    assert Rules.of({"metric": "return_agents", "settings": {}}) is None
    assert Rules.of({"metric": "return_agents", "settings": {}, "pbt": rules.facts}) == rules
