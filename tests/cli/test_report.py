"""The report: one page that needs nothing else, with the numbers of the runs, whatever the runs are called."""

import base64
import dataclasses
import html.parser
import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from matd3_jax import config
from matd3_jax.cli import command, report, train
from matd3_jax.config import command_line
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory

VOID = {"meta", "img", "source", "br", "line"}
HOSTILE = "<script>alert(1)</script>&\"'</title><img src=x onerror=alert(2)>"


class Page(html.parser.HTMLParser):
    """A page as its elements: fails where one is not closed in its turn."""

    def __init__(self, text: str):
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.cells: list[list[list[tuple[str, dict[str, str | None]]]]] = []
        """[tables][rows][cells]: text and attributes."""
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.cells.append([])
        elif tag == "tr":
            self.cells[-1].append([])
        elif tag in ("td", "th"):
            self.cells[-1][-1].append(("", dict(attrs)))
        elif tag == "small":
            self.cells[-1][-1][-1][1].update(attrs)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if {"td", "th"} & set(self.open) and "small" not in self.open:
            text, attributes = self.cells[-1][-1][-1]
            self.cells[-1][-1][-1] = (text + data, attributes)

    def table(self, class_: str):
        number = [attributes.get("class") for tag, attributes in self.tags if tag == "table"].index(class_)
        return self.cells[number]


def check_alone(text: str) -> Page:
    """A page without scripts that loads nothing."""
    page = Page(text)
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object", "embed", "form", "base", "a:href"}
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") or name == "style" for name in attributes)
        for name in ("src", "srcset", "href", "data", "poster", "action"):
            if name in attributes:
                assert attributes[name].startswith("#" if tag == "a" else "data:"), attributes[name]
    policy = [attributes["content"] for tag, attributes in page.tags if attributes.get("http-equiv")]
    assert policy and policy[0].startswith("default-src 'none'")
    css = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    assert len(css) == 1 and "url(" not in css[0] and "@import" not in css[0]
    return page


def made(folder: Path, name: str, *more: str, offset: float = 0.0, seeds: int = 4, adversaries: bool = True) -> Path:
    """A finished run with made-up numbers: returns rise to 100 x the seed's number plus `offset`."""
    settings = config.load(
        ["env=simple_tag", f"seeds={seeds}", "total_steps=20000", "batch_size=64", "learning_starts=1000", *more]
    )
    settings = dataclasses.replace(settings, name=name)
    machine = {"versions": {"jax": "1.2.3<b>"}, "devices": ["cpu:0 cpu"], "processor": HOSTILE, "cores": 2}
    run = RunDirectory.create(folder / name, settings, machine)
    rng = np.random.default_rng(len(name))
    number = np.arange(seeds) + settings.seed
    for step in range(1000, 21000, 1000):
        noise = rng.normal(size=seeds)
        row = {
            "step": np.full(seeds, step), "seed": number, "updates": np.full(seeds, step // 100),
            "episodes": np.full(seeds, 40), "return_adversaries": -number * 1.0 - noise,
            "return_agents": number * step / 200 + offset + noise,
            "eval_return_agents": number * 10 + offset if step % 5000 == 0 else np.full(seeds, np.nan),
            "eval_return_adversaries": number * 1.0 if step % 5000 == 0 else np.full(seeds, np.nan),
        }  # fmt: skip
        run.append(row)
    run.write_summary({"total_steps": 20000, "seconds": 3725.0, "env_steps_per_second": 12345.0, "diverged": {}})
    return run.path


def made_report(out: Path, *runs: Path, **more: str) -> str:
    words = [f"runs={','.join(shlex.quote(str(run)) if ',' in str(run) else str(run) for run in runs)}"]
    assert report.main([*words, f"out={out}", "films=found", *(f"{k}={v}" for k, v in more.items())]) == 0
    return out.read_text(encoding="utf-8")


def test_numbers_are_those_of_the_metrics(tmp_path):
    """Means, Student's intervals and Welch's tests, computed here from metrics.csv with SciPy."""
    runs = [made(tmp_path, "one"), made(tmp_path, "two", "algo.lr=0.001", offset=300.0, seeds=6)]
    page = check_alone(made_report(tmp_path / "r.html", *runs))
    finals: dict[str, list[np.ndarray]] = {}
    for run in runs:
        table = RunDirectory(run).read_metrics()
        late = (table["step"] > 18000, table["step"] == 20000)
        for name in ("return_adversaries", "return_agents", "eval_return_adversaries", "eval_return_agents"):
            there = late[name.startswith("eval")]
            values = [table[name][there & (table["seed"] == seed)].mean() for seed in np.unique(table["seed"])]
            finals.setdefault(name, []).append(np.array(values))
    heads, *rows = page.table("returns")
    named = {"adversaries, training": "return_adversaries", "agents, training": "return_agents",
             "adversaries, evaluation": "eval_return_adversaries",
             "agents, evaluation": "eval_return_agents"}  # fmt: skip
    columns = [named[text] for text, _ in heads[3:]]
    assert set(columns) == set(finals)
    assert [row[0][0] for row in rows] == ["lr=0.01", "lr=0.001"]
    for k, row in enumerate(rows):
        for name, (shown, attributes) in zip(columns, row[3:], strict=True):
            values = finals[name][k]
            low, high = scipy.stats.t.interval(0.95, len(values) - 1, values.mean(), scipy.stats.sem(values))
            got = [float(attributes[key]) for key in ("data-value", "data-low", "data-high")]
            np.testing.assert_allclose(got, [values.mean(), low, high], rtol=1e-7)
            assert float(shown.replace(",", "")) == pytest.approx(values.mean(), rel=1e-3)
    _, *pairs = page.table("pairs")
    assert len(pairs) == 4
    for (who, _), (what, _), (_, difference), _, (_, p) in pairs:
        a, b = finals[named[what]]
        assert who == "lr=0.01 minus lr=0.001"
        assert float(difference["data-value"]) == pytest.approx(a.mean() - b.mean())
        assert float(p["data-value"]) == pytest.approx(scipy.stats.ttest_ind(a, b, equal_var=False).pvalue)
    _, *differing = page.table("differing")
    assert {row[0][0]: [cell[0] for cell in row[1:]] for row in differing}["algo.actor_lr"] == ["0.01", "0.001"]
    _, *listed = page.table("runs")
    assert [(row[2][0], row[3][0], row[4][0], row[5][0]) for row in listed] == [
        ("0 to 3", "finished", "1:02:05", "12,345"),
        ("0 to 5", "finished", "1:02:05", "12,345"),
    ]


def test_runs_that_differ_in_their_seeds_are_one_setting_and_pictures_are_inside(tmp_path):
    runs = [made(tmp_path, "one"), made(tmp_path, "more", "seed=4", seeds=2)]
    page = check_alone(made_report(tmp_path / "r.html", *runs, title="Title"))
    _, row = page.table("returns")
    assert row[1][0] == "6" and "pairs" not in [attributes.get("class") for _, attributes in page.tags]
    pictures = [attributes["src"] for tag, attributes in page.tags if tag == "img"]
    assert len(pictures) == 4 == sum(tag == "source" for tag, _ in page.tags)  # each for light and dark
    for uri in pictures:
        kind, _, data = uri.partition(";base64,")
        assert kind == "data:image/png" and base64.b64decode(data, validate=True)[:4] == b"\x89PNG"
    assert "Title" in page.texts


def test_hostile_names_and_settings_stay_text(tmp_path):
    """Of a directory, a setting, machine, versions, a summary; with numbers that are none."""
    name = HOSTILE.replace("/", "|")
    runs = [made(tmp_path, name, "env.rules=mpe2"), made(tmp_path, "other", "algo.tau=0.5")]
    text = (runs[0] / "config.yaml").read_text().replace("rules: mpe2", f"rules: {json.dumps(HOSTILE)}")
    (runs[0] / "config.yaml").write_text(text)
    hostile = {"total_steps": HOSTILE, "seconds": HOSTILE, "env_steps_per_second": [HOSTILE], "evaluation_share": 1e999,
               "diverged": {HOSTILE: 3, "1": HOSTILE, "0": 7}}  # fmt: skip
    (runs[0] / "summary.json").write_text(json.dumps(hostile))
    (runs[0] / "machine.json").write_text(json.dumps({"versions": {HOSTILE: HOSTILE}, "devices": [HOSTILE]}))
    (runs[1] / "machine.json").write_text("[3")
    words = f'runs="{runs[0]}",{runs[1]}' if '"' not in str(runs[0]) else f"runs='{tmp_path}/*'"
    assert (
        report.main([words.replace("'", ""), f"out={tmp_path / 'r.html'}", "films=none", f"title={HOSTILE}\x00\x1b"])
        == 0
    )
    page = check_alone((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert sum(HOSTILE in text for text in page.texts) >= 4
    assert any(name in text for text in page.texts)
    assert any("seed 0 at env step 7" in text for text in page.texts)


def test_seeds_that_diverged_are_named_and_left_out(tmp_path):
    run = made(tmp_path, "one")
    lines = (run / "metrics.csv").read_text().splitlines()
    bad = next(k for k, line in enumerate(lines) if line.startswith("9000,2,"))
    cells = lines[bad].split(",")
    cells[lines[0].split(",").index("return_agents")] = "nan"
    lines[bad] = ",".join(cells)
    (run / "metrics.csv").write_text("\n".join(lines) + "\n")
    page = check_alone(made_report(tmp_path / "r.html", run))
    assert any("seed 2 at env step 9,000 (return_agents is nan)" in text for text in page.texts)
    table = RunDirectory(run).read_metrics()
    kept = [table["return_agents"][(table["step"] > 18000) & (table["seed"] == s)].mean() for s in (0, 1, 3)]
    heads, row = page.table("returns")
    place = [text for text, _ in heads].index("agents, training")
    assert float(row[place][1]["data-value"]) == pytest.approx(np.mean(kept)) and row[1][0] == "3 of 4"


def test_an_unfinished_run_is_shown_as_far_as_it_is(tmp_path):
    run = made(tmp_path, "one", seeds=1)
    (run / "summary.json").unlink()
    lines = (run / "metrics.csv").read_text().splitlines()
    (run / "metrics.csv").write_text("\n".join(lines[:5]) + "\n")
    page = check_alone(made_report(tmp_path / "r.html", run))
    _, row = page.table("runs")
    assert row[3][0] == "at 4,000 of 20,000"
    _, returns = page.table("returns")
    assert "data-low" not in returns[3][1]  # one seed has no interval


def test_many_settings_are_compared_with_the_best(tmp_path):
    runs = [made(tmp_path, f"r{k}", f"algo.tau=0.0{k + 1}", offset=50.0 * (k == 3), seeds=2) for k in range(8)]
    page = check_alone(made_report(tmp_path / "r.html", *runs))
    _, *pairs = page.table("pairs")
    of_agents = [row for row in pairs if row[1][0] == "agents, training"]
    assert len(of_agents) == 7 and all(row[0][0].startswith("tau=0.04 minus ") for row in of_agents)


@pytest.mark.slow
def test_films_are_inside_found_or_made(tmp_path):
    """The last that was made while training; without any one of the last checkpoint."""
    tiny = ["env=point_reach", "seeds=2", "algo.hidden=[8]", "batch_size=16", "num_envs=2", "learning_starts=100",
            "replay_capacity=500", "total_steps=300", "log_every=100", "eval_every=0", f"out={tmp_path}"]  # fmt: skip
    assert train.main([*tiny, "name=a"]) == 0
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    text = (tmp_path / "b" / "config.yaml").read_text()
    (tmp_path / "b" / "config.yaml").write_text(text.replace("seed: 0", "seed: 7"))
    lines = (tmp_path / "b" / "metrics.csv").read_text().replace(",1,", ",8,", 1).splitlines()
    lines = [lines[0], *(re.sub(r"^(\d+),(\d)", lambda m: f"{m[1]},{7 + int(m[2]) % 7}", line) for line in lines[1:])]
    (tmp_path / "b" / "metrics.csv").write_text("\n".join(lines) + "\n")
    videos = tmp_path / "b" / "videos"
    videos.mkdir()
    for name in ("90.gif", "300.gif", "x.gif"):
        (videos / name).write_bytes(f"GIF89a {name}".encode())
    assert report.main([f"runs={tmp_path}/a,{tmp_path}/b", f"out={tmp_path / 'r.html'}"]) == 0
    page = check_alone((tmp_path / "r.html").read_text())
    uris = [attributes["src"] for tag, attributes in page.tags if tag == "img"]
    films = [base64.b64decode(uri.split(",")[1]) for uri in uris if uri.startswith("data:image/gif")]
    assert len(films) == 2 and films[0][:6] == b"GIF89a" and len(films[0]) > 1000 and films[1] == b"GIF89a 300.gif"
    assert not (tmp_path / "a" / "videos").exists()
    (videos / "400.gif").write_bytes(b"x" * (report.LARGEST_FILM + 1))
    page = check_alone(made_report(tmp_path / "r.html", tmp_path / "b"))
    assert any("400.gif has 10 MB, too many" in text for text in page.texts)


@pytest.mark.parametrize(
    "words",
    [
        ["env=simple_tag", "algo=matd3", "adversary=maddpg", "adversary.lr=0.02", "seeds=2", "algo.hidden=[32,16]"],
        ["env=ant", "recipe=paper", "env.physics=mjx", "n_step=3", "algo.exploration_noise=[0.1,0.4]"],
        ["env=half_cheetah", "logger=[csv,wandb]", "wandb.project='a b, c'", "wandb.mode=offline", "name=x y"],
        [
            "env=simple_spread",
            "logger=mlflow",
            "mlflow.tracking_uri='it\\'s/here'",
            "eval_every=null",
            "checkpoint_minutes=2.5",
        ],
    ],
)
def test_the_command_gives_the_settings_again(words):
    settings = config.load(words)
    again = config.load(command_line.overrides(settings))
    assert dataclasses.replace(again, name=settings.name, out=settings.out) == settings


def test_an_environment_of_ones_own_has_no_command():
    assert command_line.overrides(dataclasses.replace(config.load(), env={"name": "Meet"})) is None


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["runs=nowhere"], "there is no run directory nowhere"),
        (["runs={run}", "out={run}/r.png"], "must end with .html"),
        (["runs={run},{run}"], "names a run twice"),
        (["runs={run}", "films=some"], "must be one of auto, found, none"),
        (["runs={run}", "out={run}/no/r.html"], "no directory"),
        ([], "runs=A,B is missing"),
    ],
)
def test_mistakes_are_one_line(words, wanted, tmp_path, capsys):
    run = made(tmp_path, "one", seeds=1)
    before = sorted(tmp_path.rglob("*"))
    assert command.code(report.main, [word.format(run=run) for word in words]) == 2
    said = capsys.readouterr().err
    assert wanted in said and said.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_file_that_is_there_is_replaced_whole(tmp_path, monkeypatch):
    run = made(tmp_path, "one", seeds=1)
    (tmp_path / "r.html").write_text("before")
    monkeypatch.setattr(report.page, "write", lambda *given: (_ for _ in ()).throw(UserError("no")))
    with pytest.raises(UserError):
        made_report(tmp_path / "r.html", run)
    assert (tmp_path / "r.html").read_text() == "before"
