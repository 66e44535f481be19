"""Runs on W&B, offline, and in MLflow, in a directory: what they have against what the run directory has."""

import importlib.util
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import wandb_file
from checkpoint_arrays import leaves

from matd3_jax import config
from matd3_jax.cli import train
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.tracking.messages import FINISHED
from matd3_jax.training.outputs import Outputs

TINY = [
    "env=point_reach", "seeds=2", "seed=5", "algo.hidden=[8]", "batch_size=16", "num_envs=2", "learning_starts=100",
    "replay_capacity=500", "total_steps=600", "log_every=100", "eval_every=200", "eval_episodes=2",
    "checkpoint_every=200", "keep_checkpoints=9", "algo.policy_delay=1",
]  # fmt: skip
TRACKED = ["logger=[wandb,mlflow]", "wandb.mode=offline", "video_every=300"]
COUNTERS = ("step", "seed")
FIRST, LAST = 50, 650
"""Env steps of the run's first and last rows."""


def missing(*packages: str) -> list[str]:
    return [name for name in packages if importlib.util.find_spec(name) is None]


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing("wandb", "mlflow")), reason="needs the packages wandb and mlflow"),
]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run with trackers and films, and one without; the first resumed from its middle, and lengthened."""
    out = tmp_path_factory.mktemp("runs")
    assert train.main([*TINY, f"out={out}", "name=plain"]) == 0
    uri = f"mlflow.tracking_uri='{out / 'tracks'}'"
    assert train.main([*TINY, *TRACKED, f"out={out}", uri, "name=tracked"]) == 0
    return out


@pytest.fixture(scope="module")
def resumed(trained) -> Path:
    """From a checkpoint in the middle: rows that the trackers know come again."""
    assert train.main([f"resume={trained / 'tracked'}", "checkpoint=450", "total_steps=1000"]) == 0
    return trained / "tracked"


@pytest.fixture
def client(trained, monkeypatch):
    import mlflow

    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    return mlflow.MlflowClient(tracking_uri=(trained / "tracks").as_uri())


def test_trackers_and_films_change_nothing(trained):
    """To the bit; before the run is resumed."""
    assert (trained / "tracked" / "metrics.csv").read_bytes() == (trained / "plain" / "metrics.csv").read_bytes()
    one, other = leaves(trained / "tracked"), leaves(trained / "plain")
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)
    assert not (trained / "plain" / "wandb.json").exists() and not (trained / "plain" / "videos").exists()


def expected(run: Path, seed: int) -> dict[int, dict[str, float]]:
    """{env step: {column: number}} of the metrics table."""
    table = RunDirectory(run).read_metrics()
    found = {}
    for row in np.flatnonzero(table["seed"] == seed):
        values = {name: float(column[row]) for name, column in table.items() if name not in COUNTERS}
        found[int(table["step"][row])] = {name: value for name, value in values.items() if not np.isnan(value)}
    return found


def begun(run: Path) -> list[wandb_file.OfflineRun]:
    """What W&B was told by the command that started the run, not by one that resumed it."""
    return [one for one in wandb_file.runs(run) if one.rows and one.rows[0]["_step"] == FIRST]


def same(found: dict[int, dict[str, float]], wanted: dict[int, dict[str, float]]) -> None:
    assert list(found) == list(wanted)
    for step, values in wanted.items():
        assert found[step] == pytest.approx(values, rel=1e-8)  # the table has nine digits


def test_wandb_has_every_number_of_every_seed(trained):
    run, settings = RunDirectory.open(trained / "tracked")
    first = begun(run.path)
    assert sorted(one.name for one in first) == ["tracked-seed_5", "tracked-seed_6"]
    for one in first:
        seed = one.config["seed"]
        assert one.name == f"tracked-seed_{seed}" and one.group == "tracked" and one.project == "matd3_jax"
        assert one.config["algo"] == settings.to_dict()["algo"] and one.exit_code == 0
        known = json.loads((run.path / "wandb.json").read_text())
        assert known["runs"][f"seed_{seed}"] == one.id
        found = {}
        for row in one.rows:
            numbers = {k: v for k, v in row.items() if isinstance(v, int | float) and not k.startswith("_")}
            numbers = {k: v for k, v in numbers.items() if "." not in k}
            found.setdefault(row["_step"], {}).update(numbers)
        wanted = expected(trained / "plain", seed)
        same(found, wanted)
        last = [values["return_agents"] for step, values in wanted.items() if step > 0.9 * LAST]
        assert one.summary["last_tenth/agents/mean"] == pytest.approx(np.mean(last))
        assert one.summary["seconds"] > 0


def test_films_and_figures_are_attached(trained, client):
    run = trained / "tracked"
    first = next(one for one in begun(run) if one.name == "tracked-seed_5")
    films = [row["_step"] for row in first.rows if any(key.startswith("video") for key in row)]
    assert films == [350, LAST]
    media = list((run / "wandb").glob(f"*{first.id}/files/media/videos/*.gif"))
    made = {path.read_bytes() for path in (run / "videos").glob("*.gif")}
    assert {path.read_bytes() for path in media} <= made and len(media) == 2
    assert list((run / "wandb").glob(f"*{first.id}/files/media/images/learning_curve*.png"))
    runs = json.loads((run / "mlflow.json").read_text())["runs"]
    whole = {file.path for file in client.list_artifacts(runs["all"])}
    assert {"config.yaml", "machine.json", "learning_curve.png"} <= whole
    assert {"videos/350.gif", f"videos/{LAST}.gif"} <= {f.path for f in client.list_artifacts(runs["seed_5"], "videos")}


def test_mlflow_has_every_number_of_every_seed_once_and_goes_on(resumed, client):
    """After the resume: the first run's rows, and those that came then."""
    runs = json.loads((resumed / "mlflow.json").read_text())["runs"]
    parent = client.get_run(runs["all"])
    assert parent.info.run_name == "tracked" and parent.info.status == "FINISHED"
    assert parent.data.params["algo.critic_lr"] == "0.01" and parent.data.params["logger_seeds"] == "runs"
    experiment = client.get_experiment_by_name("matd3_jax").experiment_id
    assert len(client.search_runs([experiment])) == 3
    for seed in (5, 6):
        child = client.get_run(runs[f"seed_{seed}"])
        assert child.data.tags["mlflow.parentRunId"] == runs["all"] and child.data.params["seed"] == str(seed)
        found: dict[int, dict[str, float]] = {}
        for name in child.data.metrics:
            if not name.startswith("summary/"):
                for one in client.get_metric_history(child.info.run_id, name):
                    assert name not in found.setdefault(one.step, {})
                    found[one.step][name] = one.value
        wanted = expected(resumed, seed)
        assert max(wanted) >= 1000 and min(wanted) == FIRST
        same(dict(sorted(found.items())), wanted)
    table = RunDirectory(resumed).read_metrics()
    means = {one.step: one.value for one in client.get_metric_history(runs["all"], "return_agents/mean")}
    steps = np.unique(table["step"])
    assert means == pytest.approx({s: table["return_agents"][table["step"] == s].mean() for s in steps}, rel=1e-8)


def test_wandb_goes_on_with_the_same_runs(resumed):
    ids = json.loads((resumed / "wandb.json").read_text())["runs"]
    later = [one for one in wandb_file.runs(resumed) if one.rows[0]["_step"] > 450]
    assert {one.id for one in later} == set(ids.values())
    for one in later:
        assert one.rows[-1]["_step"] == RunDirectory(resumed).read_metrics()["step"].max() >= 1000


@pytest.mark.parametrize("seeds", ["runs", "bands"])
def test_runs_of_a_sweep_are_runs_of_their_own(seeds, tmp_path, client, trained):
    """Two runs side by side, without training; seed 1 of the second has diverged."""
    runs, members = [], []
    for name, rate in (("lr_0.1", 0.1), ("lr_0.01", 0.01)):
        settings = config.load(
            ["env=point_reach", "seeds=2", f"algo.lr={rate}", "logger=[wandb,mlflow]", f"logger_seeds={seeds}",
             f"name={name}", "wandb.mode=offline", "wandb.project=mine", f"mlflow.experiment={seeds}",
             f"mlflow.tracking_uri='{trained / 'tracks'}'"]
        )  # fmt: skip
        runs.append(RunDirectory.create(tmp_path / "runs" / name, settings, {}))
        members.append(settings)
    told: list[str] = []
    out = Outputs(runs, members, [slice(0, 2), slice(2, 4)], told.append, print, {3: None}, "grid")
    number, zero = np.array([0, 1, 0, 1]), np.zeros(4)
    for step in (100, 200):
        row = {"step": number * 0 + step, "seed": number, "updates": zero, "episodes": zero}
        row["return_agents"] = 1.0 * step + number
        row["return_agents"][2:] *= -1
        out.log(row)
    for run in runs:
        run.append({name: column[:2] for name, column in row.items()})
    out.finish(
        1, {"total_steps": 200, "seconds": 3.0, "diverged": {"1": 150}, "last_tenth": {"agents": (-200.0, None)}}
    )
    out.how = FINISHED
    out.close()
    assert told == []
    for k, sign in ((0, 1), (1, -1)):
        there = {one.name: one for one in wandb_file.runs(runs[k].path)}
        own = f"grid/{runs[k].path.name}"
        assert all(one.project == "mine" for one in there.values())
        if seeds == "runs":
            assert set(there) == {f"{own}-seed_0", f"{own}-seed_1"} and {one.group for one in there.values()} == {own}
            for seed in (0, 1):
                rows = there[f"{own}-seed_{seed}"].rows
                assert [row["return_agents"] for row in rows] == [sign * (100 + seed), sign * (200 + seed)]
        else:
            assert set(there) == {own} and there[own].group == "grid"
            last = there[own].rows[-1]
            assert (last["return_agents/seed_0"], last["return_agents/seed_1"]) == (sign * 200, sign * 201)
            assert last["return_agents/mean"] == (200.5 if k == 0 else -200)  # without the seed that diverged
    summaries = [one for one in wandb_file.runs(runs[1].path) if "seconds" in one.summary]
    assert len(summaries) == (2 if seeds == "runs" else 1)
    if seeds == "runs":
        (lost,) = [one for one in summaries if one.config["seed"] == 1]
        assert lost.summary["diverged_at"] == 150
    experiment = client.get_experiment_by_name(seeds).experiment_id
    tracked = client.search_runs([experiment])
    assert len(tracked) == (6 if seeds == "runs" else 2) and {one.data.tags["sweep"] for one in tracked} == {"grid"}


def test_without_a_network_or_a_login_a_run_is_trained_all_the_same(tmp_path, monkeypatch):
    """W&B as it is: no key, and a server that does not answer; MLflow with a server that does not answer."""
    import matd3_jax

    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    small = [text for text in TINY if not text.startswith(("env", "log_every"))]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        uri = "mlflow.tracking_uri=http://127.0.0.1:9"
        more = ["logger=[wandb,mlflow]", uri, "log_every=100"]
        result = matd3_jax.train(*small, *more, env="point_reach", run_dir=tmp_path / "run")
    told = sorted(str(one.message) for one in caught if "goes on without" in str(one.message))
    assert len(told) == 2 and "MLflow" in told[0] and "Weights & Biases" in told[1]
    assert result.metrics["step"][0, -1] == LAST and RunDirectory(tmp_path / "run").summary() is not None
