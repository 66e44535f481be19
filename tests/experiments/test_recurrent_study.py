"""The study of recurrent networks on made-up evaluations."""

import numpy as np
import pictures
import pytest

from experiments import evaluations, recurrent, study, tidy
from experiments.study import StudyOptions
from experiments.tidy import Table
from matd3_jax import config

written = pytest.fixture(pictures.written)

STEPS = np.array([0, 100_000, 200_000, 300_000])


def made_up(returns):
    """Evaluations that end at `returns` by way, four seeds 2 apart."""
    parts = []
    for way, last in returns.items():
        keys = study.key_values(recurrent.KEYS, recurrent.line(way))
        for seed in range(4):
            rows = {key: np.full(len(STEPS), value) for key, value in keys.items()}
            rows |= {"seed": np.full(len(STEPS), seed), "step": STEPS}
            parts.append(Table({**rows, evaluations.RETURN: np.array([-90.0, -70, -60, last + 2 * seed])}))
    return tidy.concatenate(parts)


def test_what_is_claimed(written, tmp_path):
    table = made_up({"perceptrons": -50.0, "recurrent": -30.0, "nothing hidden": -20.0})
    (claim,) = recurrent.claims(table)
    assert claim.difference.estimate == pytest.approx(20) and claim.verdict == "same"
    assert all(claim.verdict == "not yet run" for claim in recurrent.claims(Table({})))
    recurrent.draw(table, tmp_path / "figure.png")
    (axis,) = written[tmp_path / "figure.png"].axes
    assert [text.get_text() for text in axis.get_legend().get_texts()] == [f"{way} (4 seeds)" for way in recurrent.WAYS]
    assert "| recurrent | -27" in "\n".join(recurrent.details(table))


@pytest.mark.parametrize("scale", ["paper", "small"])
def test_settings_are_what_their_names_say(scale):
    found = {name: config.load(line) for name, line in recurrent.settings(scale, StudyOptions()).items()}
    ways = {name: (one.algo.actor, one.env["speaking_steps"]) for name, one in found.items()}
    assert ways == {"perceptrons": ("mlp", 2), "recurrent": ("gru", 2), "nothing_hidden": ("mlp", 25)}
