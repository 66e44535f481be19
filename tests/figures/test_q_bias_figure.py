"""The picture of overestimation: values, estimates and their differences, for any number of seeds."""

import pictures
import pytest
from overestimation_cases import metrics_of

from matd3_jax.figures import q_bias
from matd3_jax.figures.style import AGENT


def lines_of(axis):
    return {label: line.tolist() for label, line in pictures.lines(axis).items()}


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 2])
def test_curves_of_any_number_of_seeds(seeds, tmp_path, monkeypatch):
    path, figures = tmp_path / "q_bias.png", pictures.written(monkeypatch)
    q_bias.draw(path, metrics_of(seeds), {"agents": ["a", "b"], "adversaries": ["c"]}, "title")
    *values, agents, adversaries = figures[path].axes
    # Evaluations at 10 and 30 env steps; a, b and their mean.
    for axis, estimate in zip(values, (3.5, 8), strict=True):
        assert lines_of(axis) == {
            "estimate of the critics": [[10, 30], [estimate, estimate + 2]],
            "true value of the policies": [[10, 30], [estimate + 1, estimate + 3]],
        }
    assert lines_of(agents) == {
        "a": [[10, 30], [4, 6]], "b": [[10, 30], [9, 11]], "mean of the 2 agents": [[10, 30], [6.5, 8.5]]
    }  # fmt: skip
    assert lines_of(adversaries) == {"c": [[10, 30], [11, 13]]}
    assert [axis.get_title() for axis in values] == ["agents", "adversaries"]
    words = "title; one seed" if seeds == 1 else "title; mean of 2 seeds, 95 % interval"
    assert figures[path].get_suptitle() == words
    assert {f"#{r:02X}{g:02X}{b:02X}" for r, g, b in AGENT[:2]} <= pictures.colors(path)
