"""Several studies' parts by processes of their own."""

import json

import numpy as np
import pytest
from study_cases import NOISE, fake_run

from experiments import parallel, target_smoothing, tidy
from experiments.study import StudyOptions
from matd3_jax.errors import UserError


@pytest.fixture
def one_study(monkeypatch):
    monkeypatch.setattr(parallel, "PARTS", {"target_smoothing": ("sigma0", "sigma0.*")})


def trained(folder, label, final):
    line = target_smoothing.settings("paper", StudyOptions())[label]
    overrides = [text for text in line if not text.startswith("seeds=")]
    fake_run(folder / "runs" / label, overrides, {"return_agents": (-500 + NOISE, final + NOISE)})


@pytest.mark.slow
def test_parts_come_together(tmp_path, one_study, capsys):
    """Each process finds its own runs finished; the results have the rows of both."""
    levels = {"sigma0": -400.0, "sigma0.1": -410.0, "sigma0.2": -420.0, "sigma0.4": -430.0}
    for label, final in levels.items():
        trained(tmp_path / "runs" / f"target_smoothing-{int(label != 'sigma0')}", label, final)
    argv = [f"runs={tmp_path}", f"out={tmp_path / 'results'}", "processes=2", "seeds=4"]
    assert parallel.main(argv) == 0
    out = tmp_path / "results" / "target_smoothing"
    table = tidy.read(out / "data.csv")
    for label, final in levels.items():
        found = tidy.final(table.where(target_noise=float(label.removeprefix("sigma"))), "return_agents")
        np.testing.assert_allclose(sorted(found), sorted(final + NOISE), rtol=1e-6)
    assert set(json.loads((out / "runs.json").read_text())) == set(levels)
    assert (out / "table.md").exists() and (out / "figure.png").exists()
    assert "target_smoothing-1: finished" in capsys.readouterr().out


@pytest.mark.slow
def test_a_part_that_fails_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(parallel, "PARTS", {"target_smoothing": ("nothing",)})
    assert parallel.main([f"runs={tmp_path}", f"out={tmp_path / 'results'}"]) == 1
    said = capsys.readouterr().out
    assert "target_smoothing-0: exit code 2, error: only=nothing: matches none of" in said
    assert not (tmp_path / "results").exists()


def test_time_that_is_over_ends_all(tmp_path, one_study, capsys):
    assert parallel.main([f"runs={tmp_path}", f"out={tmp_path / 'results'}", "minutes=0.00001", "seeds=4"]) == 1
    assert "not finished: target_smoothing-0, target_smoothing-1" in capsys.readouterr().out


def test_mistakes_show_before_anything_starts(tmp_path, one_study):
    for wrong in ("skip=smoothing", "scale=large", "processes=0", "estimat=true", "algo.lrr=0.1"):
        with pytest.raises(UserError):
            parallel.main([f"runs={tmp_path / 'runs'}", wrong])
    assert not list(tmp_path.iterdir())


def test_patterns_cover_every_setting():
    """Each setting of a study is trained by one part."""
    import fnmatch

    for name, patterns in parallel.PARTS.items():
        one = parallel.STUDIES[name]
        for label in one.settings("paper", one.options()):
            assert sum(fnmatch.fnmatch(label, pattern) for pattern in patterns) == 1, (name, label)
