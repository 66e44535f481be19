"""The benchmark of other libraries' environments: its table, and one case measured for a moment."""

import json
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from benchmarks import interop, interop_cases
from benchmarks.interop_cases import CASES, Case
from matd3_jax import config, envs


def test_the_settings_of_all_cases_can_be_read():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    for case in CASES:
        settings = config.load(case.settings)
        assert settings.env["name"] in envs.names()


broken = Case("broken", ("env=pettingzoo", "env.id=no_such_module"), CASES[0].own, ())


def test_a_case_has_a_process_of_its_own(monkeypatch, capsys):
    monkeypatch.setattr(interop, "CASES", (broken,))
    assert interop.main(["seeds=1"]) == 0
    assert "failed: OptionError: env.id=no_such_module" in capsys.readouterr().out


def test_a_case_is_measured_in_turns(tmp_path, capsys, monkeypatch):
    sides = []

    def rate(block, seconds):
        done = block()
        sides.append("own" if done == interop.STEPS else "ours")
        assert sides[-1] == "own" or done == 2 * 3 * interop.STEPS  # seeds x environments x env steps
        return {"own": 10.0, "ours": 30.0}[sides[-1]] * len(sides)

    guess = interop_cases.settings("pettingzoo", "host_cases")
    case = Case("guess", guess, lambda steps: interop_cases.parallel("host_cases", steps), ("numpy",))
    monkeypatch.setattr(interop, "CASES", (case, broken))
    monkeypatch.setattr(interop, "STEPS", 25)
    monkeypatch.setattr(interop, "rate", rate)
    monkeypatch.setattr(interop, "process_for_each", lambda: ThreadPoolExecutor(1))  # sees what is changed here
    out = tmp_path / "report.json"
    assert interop.main(["turns=3", "num_envs=3", "seeds=2", f"out={out}"]) == 0
    assert sides == ["ours", "own", "own", "ours", "ours", "own"]
    first, second = json.loads(out.read_text())["cases"]
    assert first["ours"] == [30.0, 120.0, 150.0] and first["own"] == [20.0, 30.0, 60.0]
    assert first["ratio"] == {"median": 2.5, "lowest": 1.5, "highest": 4.0}
    assert first["packages"] == {"numpy": np.__version__} and len(jax.devices()) == 2
    assert "no module no_such_module" in second["error"]
    table = capsys.readouterr().out
    assert "2.50 (1.50 to 4.00)" in table and "broken" in table and "failed: OptionError" in table
