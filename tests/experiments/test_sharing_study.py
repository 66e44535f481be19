"""The study of networks in common on made-up evaluations, and its benchmark on made-up measurements."""

import json

import numpy as np
import pictures
import pytest

from benchmarks import fresh, growth
from benchmarks import sharing as benchmark
from experiments import evaluations, sharing, study, tidy
from experiments.study import StudyOptions
from experiments.tidy import Table
from matd3_jax import config

written = pytest.fixture(pictures.written)

STEPS = np.array([0, 100_000, 200_000, 300_000])
SEEDS = 4


def made_up(returns):
    """Evaluations that end at `returns` by name, seeds 2 apart."""
    parts = []
    for name, last in returns.items():
        keys = study.key_values(sharing.KEYS, sharing.line(name))
        for seed in range(SEEDS):
            rows = {key: np.full(len(STEPS), value) for key, value in keys.items()}
            rows |= {"seed": np.full(len(STEPS), seed), "step": STEPS}
            parts.append(Table({**rows, evaluations.RETURN: np.array([-900.0, -700, -600, last + 2 * seed])}))
    return tidy.concatenate(parts)


def test_what_is_claimed(written, tmp_path):
    table = made_up({"apart": -500.0, "kind": -497.0, "team critic": -600.0, "both": -510.0})
    claims = sharing.claims(table)
    assert [claim.difference.estimate for claim in claims] == pytest.approx([3, -100, -10])
    assert [claim.verdict for claim in claims] == ["same", "opposite", "same"]
    assert all(claim.verdict == "not yet run" for claim in sharing.claims(Table({})))
    sharing.draw(table, tmp_path / "figure.png")
    names = [text.get_text() for text in written[tmp_path / "figure.png"].axes[0].get_legend().get_texts()]
    assert names == [f"{name} (4 seeds)" for name in sharing.MODES]
    assert "| both | -507" in "\n".join(sharing.details(table))


def test_settings_are_what_their_names_say():
    for settings in (sharing.settings("paper", StudyOptions()), sharing.settings("small", StudyOptions())):
        found = {label: config.load(line).algo for label, line in settings.items()}
        ways = {label: (one.share_parameters, one.critic) for label, one in found.items()}
        assert ways == {"apart": ("none", "central"), "kind": ("kind", "central"), "team_critic": ("none", "shared"),
                        "both": ("kind", "shared")}  # fmt: skip


def test_the_benchmark_takes_turns(monkeypatch, tmp_path, capsys):
    """Four ways after each other, then again; medians, and what was measured of each."""
    asked = []

    def run(module, arguments):
        asked.append(arguments)
        turn = (len(asked) - 1) // 4
        ways = sum(argument in ("algo.share_parameters=kind", "algo.critic=shared") for argument in arguments)
        rate = (1 + ways) * (100.0, 900.0, 110.0)[turn]
        memory = {"xla": 5_000_000}
        return {"env_steps_per_second": rate, "updates_of_a_cycle": 2, "cycle_seconds": 400 / rate, "memory": memory,
                "compile_seconds": 3.0, "machine": "made up"}  # fmt: skip

    monkeypatch.setattr(fresh, "run", run)
    out = tmp_path / "report.json"
    assert benchmark.main(["agents=[4]", "turns=3", f"out={out}", "algo.hidden=[8]"]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["mode"] for row in rows] == list(benchmark.MODES)
    assert [row["env_steps_per_second"] for row in rows] == [110, 220, 220, 330]
    assert [row["slowest"] for row in rows] == [100, 200, 200, 300]
    assert rows[0]["updates_per_second"] == pytest.approx(2 * 2 * 110 / 400)
    state = [row["state_bytes"] for row in rows]
    assert state[0] > 2 * state[1] and state[0] > 2 * state[2] and min(state) == state[3]
    assert " 3.00 " in capsys.readouterr().out
    assert {"env.num_agents=4", "repeats=1", "algo.hidden=[8]"} <= set(asked[0])
    point = {"seeds": 2, "agents": 4, "replay": 10_000, "batch": 1024}
    assert all(set(growth.settings(point)) <= set(arguments) for arguments in asked)
