"""The study of agents that learn one after another on made-up evaluations."""

import numpy as np
import pictures
import pytest

from experiments import collecting, evaluations, robots, sequential, study, tidy
from experiments.study import StudyOptions
from experiments.tidy import Table
from matd3_jax import config

written = pytest.fixture(pictures.written)

STEPS = np.array([0, 100_000, 200_000, 300_000])
SEEDS = 3


def made_up(keys, line, last):
    """Evaluations of one setting that end at `last`, seeds 2 apart."""
    parts = []
    for seed in range(SEEDS):
        rows = {key: np.full(len(STEPS), value) for key, value in study.key_values(keys, line).items()}
        rows |= {"seed": np.full(len(STEPS), seed), "step": STEPS, "updates": STEPS // 8}
        parts.append(Table({**rows, evaluations.RETURN: np.array([0.0, 100, 200, last + 2 * seed])}))
    return tidy.concatenate(parts)


def test_what_is_claimed(written, tmp_path):
    lines = [sequential.line("paper", name) for name in sequential.ORDERS]
    both = [made_up(sequential.KEYS, line, last) for line, last in zip(lines, (500.0, 900.0), strict=True)]
    table = tidy.concatenate(both)
    (claim,) = sequential.claims(table)
    assert claim.difference.estimate == pytest.approx(400) and claim.verdict == "same"
    assert sequential.claims(Table({}))[0].verdict == "not yet run"
    sequential.draw(table, tmp_path / "figure.png")
    names = [text.get_text() for text in written[tmp_path / "figure.png"].axes[0].get_legend().get_texts()]
    assert names == ["simultaneous (3 seeds)", "random order (3 seeds)"]
    assert "| random order | 902" in "\n".join(sequential.details(table))


def test_settings_differ_in_the_order_alone():
    for scale in sequential.SCALES:
        one, other = (config.load(line) for line in sequential.settings(scale, StudyOptions()).values())
        assert (one.update_order, other.update_order) == ("simultaneous", "random_sequential")
        assert collecting.differences(one.to_dict(), other.to_dict()).keys() == {"update_order"}


def test_the_simultaneous_updates_are_those_of_the_robots_study(tmp_path):
    """`robots` trains two algorithms on many robots: one of its settings is taken over, the others are not."""
    data = collecting.Data(robots.STUDY.keys, {}, {})
    for k, (label, line) in enumerate(robots.settings("paper", StudyOptions()).items()):
        settings = config.load(line)
        facts = {"settings": settings.to_dict(), "machine": {}, "summary": {}, "command": label}
        data.offer(label, made_up(robots.STUDY.keys, line, 1000.0 * k), facts)
    (tmp_path / "robots").mkdir()
    collecting.write(data, tmp_path / "robots" / "curves.csv", tmp_path / "robots" / "runs.json")
    plan = study.Plan.of(sequential.STUDY, [f"out={tmp_path / 'sequential'}", f"runs={tmp_path / 'runs'}"])
    assert plan.adopted and list(plan.data.facts) == ["simultaneous"]
    assert plan.data.facts["simultaneous"]["command"] == "ant-4x2-matd3"
    place = list(robots.settings("paper", StudyOptions())).index("ant-4x2-matd3")
    assert plan.data.table[evaluations.RETURN].max() == 1000 * place + 2 * (SEEDS - 1)
    assert list(plan.missing) == ["random_order"]
