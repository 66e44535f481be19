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
    """Evaluations that end at `returns` by task and way, four seeds 2 apart."""
    parts = []
    for (task, way), last in returns.items():
        keys = study.key_values(recurrent.KEYS, recurrent.line(task, way))
        for seed in range(4):
            rows = {key: np.full(len(STEPS), value) for key, value in keys.items()}
            rows |= {"seed": np.full(len(STEPS), seed), "step": STEPS}
            parts.append(Table({**rows, evaluations.RETURN: np.array([-90.0, -70, -60, last + 2 * seed])}))
    return tidy.concatenate(parts)


def test_what_is_claimed(written, tmp_path):
    table = made_up({
        ("simple_speaker_listener", "perceptrons"): -50.0, ("simple_speaker_listener", "recurrent"): -30.0,
        ("simple_speaker_listener", "nothing hidden"): -20.0,
        ("half_cheetah", "perceptrons"): 900.0, ("half_cheetah", "recurrent"): 700.0,
    })  # fmt: skip
    claims = recurrent.claims(table)
    assert [claim.difference.estimate for claim in claims] == pytest.approx([20, -200])
    assert [claim.verdict for claim in claims] == ["same", "opposite"]
    assert all(claim.verdict == "not yet run" for claim in recurrent.claims(Table({})))
    recurrent.draw(table, tmp_path / "figure.png")
    drawn = [
        [text.get_text() for text in axis.get_legend().get_texts()] for axis in written[tmp_path / "figure.png"].axes
    ]
    assert drawn[0] == [f"{way} (4 seeds)" for way in recurrent.WAYS] and len(drawn[1]) == 2
    text = "\n".join(recurrent.details(table))
    assert text.count("recurrent") == 2 and text.count("nothing hidden") == 1


@pytest.mark.parametrize("scale", ["paper", "small"])
def test_settings_are_what_their_names_say(scale):
    found = {name: config.load(line) for name, line in recurrent.settings(scale, StudyOptions()).items()}
    ways = {name: (one.algo.actor, one.env.get("speaking_steps"), one.env.get("velocities"), one.n_step) for name, one
            in found.items()}  # fmt: skip
    assert ways == {
        "simple_speaker_listener-perceptrons": ("mlp", 2, None, 1),
        "simple_speaker_listener-recurrent": ("gru", 2, None, 1),
        "simple_speaker_listener-nothing_hidden": ("mlp", None, None, 1),
        "half_cheetah-perceptrons": ("mlp", None, False, 1),
        "half_cheetah-recurrent": ("gru", None, False, 1),
        "half_cheetah-nothing_hidden": ("mlp", None, True, 1),
    }
