"""The claims of docs/paper.md and their figure, from made-up results."""

import pictures
import pytest
from study_cases import NOISE, fake_run

from experiments import claims_figure, page, target_smoothing
from experiments.all import STUDIES
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim, Difference
from matd3_jax.errors import UserError

MARKS = "\n".join(f"<!-- {name}: made by experiments.page -->\nold\n<!-- end -->" for name in ("claims", "ours"))


def test_every_claim_has_a_short_name():
    assert set(claims_figure.SHORT) == set(STUDIES) == set(claims_figure.TITLES)
    for name, one in STUDIES.items():
        assert len(claims_figure.SHORT[name]) == len(one.claims(Table({}))), name


def results(folder, scale, level, labels):
    lines = target_smoothing.settings(scale, StudyOptions())
    name = "target_smoothing" + "_small" * (scale == "small")
    for label in labels:
        returns = {"return_agents": (NOISE, (10 if label == labels[0] else level) + 0.1 * NOISE)}
        fake_run(folder / "runs" / name / label, [t for t in lines[label] if "seeds" not in t], returns)
    places = [f"runs={folder / 'runs' / name}", f"out={folder / 'results' / name}"]
    assert target_smoothing.main([f"scale={scale}", "train=false", *places]) == 0


def test_page(tmp_path, monkeypatch, capsys):
    """The paper's size where there is any, else the small runs; the text around stays."""
    labels = list(target_smoothing.settings("paper", StudyOptions()))
    results(tmp_path, "small", 20.0, labels)
    results(tmp_path, "paper", 9.0, labels[:2])
    written = pictures.written(monkeypatch)
    (tmp_path / "page.md").write_text(f"before\n{MARKS}\nafter\n")
    argv = [f"results={tmp_path / 'results'}", f"page={tmp_path / 'page.md'}", f"figure={tmp_path / 'claims.png'}"]
    assert page.main(argv) == 0
    text = (tmp_path / "page.md").read_text()
    assert text.startswith("before\n<!-- claims") and text.endswith("<!-- end -->\nafter\n") and "old" not in text
    rows = [line for line in text.splitlines() if "target policy smoothing" in line]
    assert [row.split(" | ")[4] for row in rows] == ["**same**", "**opposite**", "**opposite**"]
    assert "4 seeds (protocol: 10) x 0.05 million env steps" in rows[0]
    assert "](results/target_smoothing/table.md)" in rows[0] and "](results/target_smoothing_small/" in rows[1]
    total = sum(len(one.claims(Table({}))) for one in STUDIES.values())
    assert f"{total} claims: 1 *same*, 2 *opposite*, {total - 3} *not yet run*" in text and "No data yet." in text
    (axis,) = written[tmp_path / "claims.png"].axes
    assert [label.get_text() for label in axis.get_yticklabels()] == list(claims_figure.SHORT["target_smoothing"])
    assert page.main(argv) == 0
    assert (tmp_path / "page.md").read_text() == text


def test_a_page_without_marks_is_left_alone(tmp_path):
    (tmp_path / "page.md").write_text("nothing")
    argv = [f"results={tmp_path}", f"page={tmp_path / 'page.md'}", f"figure={tmp_path / 'claims.png'}"]
    with pytest.raises(UserError, match="the marks .* must be there once"):
        page.main(argv)
    assert [path.name for path in tmp_path.iterdir()] == ["page.md"]
    with pytest.raises(UserError, match="results=.*/nowhere: there is no such folder"):
        page.main([f"results={tmp_path / 'nowhere'}", *argv[1:]])
    assert (tmp_path / "page.md").read_text() == "nothing"
    with pytest.raises(UserError, match="No such file"):
        page.main([*argv[:1], f"page={tmp_path / 'other.md'}", argv[2]])


def test_figure(tmp_path, monkeypatch):
    """In units of the deviation over seeds; what lies beyond the axis is an arrow at its edge."""
    written = pictures.written(monkeypatch)
    claims = [
        ("ant", "clear", Claim("a", "q", Difference(4.0, 2.0, 6.0, 0.01, unit=2.0)), False),
        ("ant", "far", Claim("a", "q", Difference(-40.0, -60.0, -20.0, 0.01, unit=2.0)), True),
        ("ant", "nil", Claim("a", "q", Difference(0.0, -1.0, 1.0, 1.0, unit=2.0), "no difference", margin=2.0), False),
        ("ant", "not run", Claim("a", "q"), False),
    ]
    claims_figure.draw(claims, tmp_path / "claims.png")
    figure = written[tmp_path / "claims.png"]
    (axis,) = figure.axes
    points = {
        line.get_ydata()[0]: (line.get_xdata()[0], line.get_color()) for line in axis.lines if line.get_marker() == "o"
    }
    colors = claims_figure.VERDICTS
    assert points == {1: (2.0, colors["same"]), 3: (0.0, colors["same"])}
    arrows = [(line.get_xdata()[0], line.get_color()) for line in axis.lines if line.get_marker() == "<"]
    assert arrows == [(-3.0, colors["opposite"])]
    assert [(bar.get_x(), bar.get_width()) for bar in axis.patches] == [(-1.0, 2.0)]
    assert [text.get_text() for text in axis.texts] == ["difference", "Robots", "+4", "-40", "+0"]
    assert figure.legends[0].get_title().get_text() == "not yet run: 1 more"
