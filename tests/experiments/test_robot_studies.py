"""The studies of robots on made-up evaluations: which rows belong to which setting, and what is claimed of them."""

import numpy as np
import pytest

from experiments import (
    ablation,
    collecting,
    critics,
    evaluations,
    one_at_a_time,
    recipe,
    robots,
    squashing,
    study,
    tidy,
)
from experiments.study import StudyOptions
from experiments.tidy import Table
from matd3_jax import config

STEPS = np.array([0, 50_000, 100_000, 150_000, 200_000, 250_000, 300_000])
SEEDS = 4


def table_of(module, levels):
    """Evaluations of the settings of a study: each rises to its level (by label), seeds 10 apart."""
    parts = []
    for label, line in module.settings("paper", StudyOptions()).items():
        if label not in levels:
            continue
        keys = study.key_values(module.STUDY.keys, line)
        for seed in range(SEEDS):
            rows = {key: np.full(len(STEPS), value) for key, value in keys.items()}
            rows |= {"seed": np.full(len(STEPS), seed), "step": STEPS, "updates": STEPS // 4}
            returns = levels[label] * STEPS / STEPS[-1] + 10 * (seed - 1.5)
            parts.append(Table({**rows, evaluations.RETURN: returns, evaluations.VELOCITY: returns / 1000}))
    return tidy.concatenate(parts)


def words(claims):
    return [claim.verdict for claim in claims]


@pytest.mark.slow
@pytest.mark.parametrize("module", [squashing, robots, recipe, ablation, critics])
def test_tables_survive_their_file_and_every_setting_is_drawn(module, tmp_path):
    """Numbers and texts in a column (a noise, a range of noise) stay different settings after reading, too."""
    labels = list(module.settings("paper", StudyOptions()))
    table = table_of(module, {label: 1000.0 + 100 * k for k, label in enumerate(labels)})
    tidy.write(table, tmp_path / "curves.csv")
    again = tidy.read(tmp_path / "curves.csv")
    for t in (table, again):
        assert len(module.details(t)) == 2 + len(labels)
        module.STUDY.draw(t, tmp_path / "figure.png")
        for k, (label, line) in enumerate(module.settings("paper", StudyOptions()).items()):
            part = t.where(**study.key_values(module.STUDY.keys, line))
            assert len(part) == SEEDS * len(STEPS), label
            assert evaluations.curve(part)[1][:, -1].mean() == pytest.approx(1000 + 100 * k)
    assert words(module.claims(Table({}))) == ["not yet run"] * len(module.claims(Table({})))


def test_late_means_are_over_the_last_third():
    table = table_of(squashing, {"tanh-0.001": 300.0})
    # Evaluations at 250,000 and 300,000: 250 and 300, seeds 10 apart.
    np.testing.assert_allclose(evaluations.late(table), 275 + 10 * (np.arange(SEEDS) - 1.5))


def test_squashing():
    """If it is the slope, a sigmoid with twice the learning rate is a tanh; if not, the sigmoid stays where it was."""
    slope = {"tanh-0.0005": 900.0, "sigmoid-0.001": 900.0, "tanh-0.001": 1800.0, "sigmoid-0.002": 1800.0}
    assert words(squashing.claims(table_of(squashing, slope))) == ["same", "same", "same"]
    other = slope | {"sigmoid-0.002": 900.0}
    assert words(squashing.claims(table_of(squashing, other))) == ["same", "same", "opposite"]


def test_recipe():
    """Each change is held against the base alone."""
    base = {one_at_a_time.label(name): 1000.0 for name in recipe.CHANGES}
    names = [name for name in recipe.CHANGES if name != recipe.BASE]
    assert set(words(recipe.claims(table_of(recipe, base)))) == {"same"}
    worse = base | {one_at_a_time.label(names[2]): 400.0}
    found = words(recipe.claims(table_of(recipe, worse)))
    assert found[2] == "opposite" and set(found[:2] + found[3:]) == {"same"}


def test_critics():
    """Each kind is compared with the recipe's critics on the same robot."""
    levels = {label: 1000.0 for label in critics.settings("paper", StudyOptions())}
    levels |= {"half_cheetah-as_they_are": 2000.0, "half_cheetah-categorical": 2500.0, "ant-both": 700.0}
    found = words(critics.claims(table_of(critics, levels)))
    assert found == ["not shown", "not shown", "opposite", "opposite", "same", "opposite"]


def test_ablation():
    """The recipe is held against each setting without a part of it: worse without is a part that is needed."""
    levels = {one_at_a_time.label(name): 900.0 for name in ablation.CHANGES}
    levels |= {"the_whole_recipe": 1000.0, "n-step_1": 1000.0, "delay_1": 1100.0}
    found = words(ablation.claims(table_of(ablation, levels)))
    assert found == ["same", "not shown", "same", "same", "same", "opposite", "same"]
    lines = ablation.settings("paper", StudyOptions())
    configs = {name: config.load(line) for name, line in lines.items()}
    whole = configs.pop("the_whole_recipe").to_dict()
    # Each differs from the recipe in its own part, and a minibatch of another size in two numbers.
    changed = {name: set(collecting.differences(one.to_dict(), whole)) for name, one in configs.items()}
    changed = {name: {key for key in keys if not key.startswith("adversary.")} for name, keys in changed.items()}
    assert [len(keys) for keys in changed.values()] == [1, 1, 1, 1, 1, 1, 2]


def test_robots():
    found = robots.claims(table_of(robots, {"ant-4x2-matd3": 3000.0, "ant-4x2-maddpg": 2500.0}))
    assert words(found) == ["same", "not yet run", "same", *["not yet run"] * 6]
    levels = {"ant-4x2-matd3": 2000.0, "humanoid-9_8-matd3": 500.0, "humanoid-9_8-maddpg": 600.0}
    table = table_of(robots, levels)
    assert words(robots.claims(table)) == ["opposite", *["not yet run"] * 7, "opposite"]
    lines = robots.details(table)
    assert lines[2].startswith("| ant | 4x2 | MATD3 | 4 |") and lines[2].endswith(
        "| 2,700 at 1M, 3,800 at 2M, 5,700 at 10M |"
    )
    assert lines[3].startswith("| humanoid | 9\\|8 | MATD3 |")
