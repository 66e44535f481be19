"""What a sweep tries: grids in order, draws of the right distribution, and one line for whatever is malformed."""

import itertools

import numpy as np
import pytest
import scipy.stats

from matd3_jax.errors import UserError
from matd3_jax.sweep import search_space
from matd3_jax.sweep.search_space import SearchSpace


def test_grid_is_every_combination_last_key_fastest():
    overrides = ["env=simple_spread", "algo.lr=0.01,0.003", "algo.policy_delay=range(1,4)", "algo=choice(matd3,maddpg)"]
    space = SearchSpace.parse(overrides)
    assert space.fixed == ("env=simple_spread",)
    expected = list(itertools.product(("0.01", "0.003"), ("1", "2", "3"), ("matd3", "maddpg")))
    assert [tuple(setting.values()) for setting in space.grid()] == expected
    assert list(space.grid()[0]) == ["algo.lr", "algo.policy_delay", "algo"]


def test_lists_of_lists_and_files_by_pattern():
    space = SearchSpace.parse(["algo.hidden=[64,64],[128,128]", "algo=glob(ma*)"])
    assert space.axes[0].values == ("[64,64]", "[128,128]")
    assert space.axes[1].values == ("maddpg", "matd3")


def test_intervals_are_drawn_on_a_log_scale():
    """Kolmogorov-Smirnov against the uniform distribution of logarithms, which uniform draws would fail by far."""
    settings = SearchSpace.parse(["algo.lr=interval(1e-4,1e-2)"]).sample(1000, seed=0)
    drawn = np.array([float(setting["algo.lr"]) for setting in settings])
    assert drawn.min() >= 1e-4 and drawn.max() <= 1e-2
    logs = (np.log10(drawn) + 4) / 2
    assert scipy.stats.kstest(logs, "uniform").pvalue > 1e-3
    assert scipy.stats.kstest((drawn - 1e-4) / (1e-2 - 1e-4), "uniform").pvalue < 1e-20


def test_uniform_where_asked_for_or_zero_is_inside():
    for text in ("a=tag(uniform,interval(1,3))", "a=interval(-1,1)"):
        drawn = np.array([float(s["a"]) for s in SearchSpace.parse([text]).sample(1000, seed=1)])
        low, high = (1, 3) if "tag" in text else (-1, 1)
        assert scipy.stats.kstest((drawn - low) / (high - low), "uniform").pvalue > 1e-3


def test_whole_numbers_reach_both_ends():
    drawn = {int(s["a"]) for s in SearchSpace.parse(["a=int(interval(2,5))", "b=interval(0,1)"]).sample(200, seed=0)}
    assert drawn == {2, 3, 4, 5}


def test_draws_from_lists_are_different_combinations():
    space = SearchSpace.parse(["a=1,2,3", "b=1,2,3,4"])
    settings = space.sample(11, seed=3)
    assert len({tuple(s.values()) for s in settings}) == 11
    assert settings == space.sample(11, seed=3)
    assert settings != space.sample(11, seed=4)


def test_names_are_short_different_and_fit_a_command_line():
    space = SearchSpace.parse(["algo.lr=0.01,0.003", "adversary.lr=0.01", "algo.hidden=[64,64],[8]"])
    names = search_space.names(space.axes, space.grid())
    assert names[0] == "lr_0.01-hidden_64x64" and len(set(names)) == 4
    both = SearchSpace.parse(["algo.lr=1,2", "adversary.lr=1,2"])
    assert search_space.names(both.axes, both.grid())[1] == "algo.lr_1-adversary.lr_2"
    assert not any(set(name) & set("=,[]{}() ") for name in names)


@pytest.mark.parametrize(
    "overrides, samples, words",
    [
        (["algo.lr=range(4,1)"], None, "empty"),
        (["algo.lr=range(0,1,0)"], None, "cannot read"),
        (["algo.lr=choice()"], None, "cannot read"),
        (["algo.lr=0.1,"], None, "cannot read"),
        (["algo.lr=0.1,0.1"], None, "twice"),
        (["algo.lr=1,2", "algo.lr=3,4"], None, "swept twice"),
        (["algo.lr=interval(1,1)"], 3, "low < high"),
        (["algo.lr=interval(3,1)"], 3, "low < high"),
        (["algo.lr=interval(0.1,1)"], None, "samples="),
        (["algo.lr=tag(log,interval(-1,1))"], 3, "low > 0"),
        (["algo.lr=tag(cubic,interval(1,2))"], 3, "log or uniform"),
        (["algo=glob(zz*)"], None, "empty"),
        (["seeds=glob(*)"], None, "files"),
        (["algo.lr=1,2"], 5, "only 2 combinations"),
        (["algo.lr=1"], 5, "there are none"),
        (["algo.hidden=int(interval(1,3))"], 9, "only about 3"),
    ],
)
def test_what_is_empty_or_malformed_gets_one_line(overrides, samples, words):
    with pytest.raises(UserError, match=words) as error:
        space = SearchSpace.parse(overrides)
        space.grid() if samples is None else space.sample(samples, 0)
    assert "\n" not in str(error.value)
