"""Settings that need more memory than there is are refused before anything is computed or written."""

import re
import shutil

import pytest

from matd3_jax import config
from matd3_jax.cli import evaluate, render, train
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

SMALL = [
    "env=point_reach", "seeds=2", "total_steps=2000", "learning_starts=400", "num_envs=4", "rollout_length=5",
    "batch_size=32", "replay_capacity=2000", "algo.hidden=[8]",
]  # fmt: skip
FREE = 16_000_000_000

TOO_MUCH = {
    "wide networks": (["algo.hidden=[100000,100000]"], "networks and optimizers: a smaller algo.hidden"),
    "many critics": (["algo.num_critics=10000000"], "networks and optimizers: a much smaller algo.num_critics"),
    "many environments": (["num_envs=20000000", "replay_capacity=100000000"], "environments and a rollout: "),
    "large minibatches": (
        ["batch_size=1000000", "algo.hidden=[4096,4096]", "replay_capacity=1000000", "total_steps=1000000"],
        "an update: batch_size at most ",
    ),
    "long evaluations": (["eval_episodes=1000000000"], "an evaluation: eval_episodes at most "),
    "a long replay": (["replay_capacity=1000000000", "total_steps=1000000000"], "replay_capacity at most "),
}


@pytest.fixture
def sixteen(monkeypatch):
    """16 GB are free."""
    monkeypatch.setattr(devices, "free_memory", lambda sharing=1: FREE)


@pytest.fixture
def no_start(monkeypatch):
    """What is not refused fails at once, instead of taking the machine's memory."""

    def init(trainer, keys):
        raise AssertionError("it was not refused")

    monkeypatch.setattr(TrainLoop, "init", init)


@pytest.mark.parametrize("case", TOO_MUCH)
def test_training_that_cannot_fit_is_refused(case, sixteen, no_start, tmp_path):
    more, wanted = TOO_MUCH[case]
    with pytest.raises(UserError, match=r"GB are needed, but only 16.00 GB are free; .* GB for ") as error:
        train.main([*SMALL, *more, f"out={tmp_path / 'runs'}"])
    assert wanted in str(error.value) and str(error.value).endswith(", or fewer seeds")
    assert not list(tmp_path.iterdir())
    # What is said to fit does.
    found = re.search(r"(\w+) at most ([\d,]+)", str(error.value))
    if found:
        key, most = found[1], int(found[2].replace(",", ""))
        step = 20 if key in ("replay_capacity", "num_envs") else 2
        fits = [*SMALL, *more, f"{key}={most // step * step}"]
        TrainingSession(config.load(fits)).check_memory(recorded=True)


def test_from_python_too(sixteen, no_start):
    with pytest.raises(UserError, match="eval_episodes at most"):
        TrainingSession(config.load([*SMALL, "eval_episodes=1000000000"])).start()


@pytest.mark.slow
def test_evaluations_and_films_that_cannot_fit_are_refused(sixteen, tmp_path, monkeypatch):
    """Before the checkpoint is read: none is there."""
    directory = tmp_path / "run"
    monkeypatch.setattr(devices, "free_memory", lambda sharing=1: 10**12)
    session = TrainingSession(config.load([*SMALL, "env.episode_length=1000000000"]))
    Recorder().start(config.load(SMALL), directory)
    config.write(session.config, directory / "config.yaml")
    shutil.rmtree(directory / "checkpoints")
    monkeypatch.setattr(devices, "free_memory", lambda sharing=1: FREE)
    before = sorted(directory.rglob("*"))
    with pytest.raises(UserError, match="2 x 1,000,000,000 episodes side by side: episodes at most "):
        evaluate.main([f"run={directory}", "episodes=1000000000"])
    with pytest.raises(UserError, match="its env steps: max_steps at most "):
        render.main([f"run={directory}"])
    assert sorted(directory.rglob("*")) == before
