"""Films while a run trains: when, of what, and what keeps them from being made."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import matd3_jax
from matd3_jax import config
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.sweep import runner
from matd3_jax.training.film import PICTURES, SIZE, Filmer
from matd3_jax.video import frames, mujoco_renderer, opengl

SMALL = dict(
    seeds=2, total_steps=600, learning_starts=100, num_envs=2, rollout_length=25, batch_size=16, replay_capacity=500,
    log_every=100, eval_every=0,
)  # fmt: skip


class Noted:
    """A logger that keeps what it is handed, and fails with its first row."""

    def __init__(self):
        self.rows, self.files, self.found, self.closed = [], [], None, 0

    def log(self, row):
        self.rows.append(int(row["step"][0]))
        if len(self.rows) == 1:
            raise ValueError("the first row")

    def attach(self, step, path, seed):
        self.files.append((step, path.name, seed))

    def summarize(self, found):
        self.found = found

    def close(self):
        self.closed += 1


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> tuple[Path, Noted, list[str]]:
    path, noted = tmp_path_factory.mktemp("films") / "run", Noted()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        small = {**SMALL, "seed": 3}
        matd3_jax.train("algo.hidden=[8]", env="point_reach", run_dir=path, video_every=250, loggers=[noted], **small)
    return path, noted, [str(one.message) for one in caught if "goes on" in str(one.message)]


@pytest.mark.slow
def test_a_film_at_each_interval_that_passes_a_multiple(filmed):
    path, _, _ = filmed
    assert sorted(int(found.stem) for found in (path / "videos").iterdir()) == [250, 550]
    with Image.open(path / "videos" / "250.gif") as film:
        assert film.n_frames <= PICTURES + 2 and max(film.size) == SIZE


def test_a_logger_gets_rows_films_figures_and_the_summary_though_it_failed(filmed):
    path, noted, told = filmed
    assert noted.rows == [50, 150, 250, 350, 450, 550, 650] and noted.closed == 1
    assert noted.files == [(250, "250.gif", 3), (550, "550.gif", 3), (650, "learning_curve.png", None)]
    assert noted.found is not None and noted.found["total_steps"] == 650
    assert told == ["warning: Noted fails, the run goes on: ValueError: the first row"]


def test_a_callback_ends_the_run(tmp_path):
    """Unlike a logger: this is how a program stops one."""

    def stop(row):
        raise KeyError("enough")

    noted = Noted()
    with pytest.raises(KeyError, match="enough"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matd3_jax.train("algo.hidden=[8]", env="point_reach", loggers=[noted], callback=stop, **SMALL)
    with pytest.raises(KeyError, match="enough"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matd3_jax.train(
            "algo.hidden=[8]", env="point_reach", run_dir=tmp_path / "run", loggers=[noted], callback=stop, **SMALL
        )
    assert noted.closed == 1  # the one of the run with a directory; the other had not begun


def test_without_a_directory_there_are_no_films_and_no_trackers():
    for more in ({"video_every": 100}, {"logger": ["csv", "tensorboard"]}):
        with pytest.raises(UserError, match="needs a run directory"):
            matd3_jax.train(env="point_reach", **{**SMALL, **more})


class Parts:
    """Of a training session, what a film needs, with the networks of seed 0 not finite."""

    env = PointReach()

    def finite(self, state):
        return np.array([False, True, True])


def test_the_first_sound_seed_plays(tmp_path, monkeypatch):
    settings = config.load(["env=point_reach", "seeds=3", "video_every=10"])
    got, run = [], RunDirectory(tmp_path)
    filmer = Filmer(Parts(), [run], [settings], [slice(0, 3)], got.append, lambda *given: got.append(given))
    monkeypatch.setattr(filmer, "_film", lambda run, state, seed, step: tmp_path / f"{step}.gif")
    for before, step in ((0, 5), (5, 10), (10, 19), (19, 40)):
        filmer(None, before, step)
    assert got == [(0, 10, tmp_path / "10.gif", 1), (0, 40, tmp_path / "40.gif", 1)]


def test_without_opengl_one_warning(tmp_path, monkeypatch):
    """A robot cannot be drawn: the run goes on, and is not asked again."""

    def none():
        raise UserError("MuJoCo finds no OpenGL")

    monkeypatch.setattr(opengl, "context_class", none)
    monkeypatch.setattr(frames, "drawing_of", lambda env: mujoco_renderer.RobotDrawing(env))
    settings = config.load(["env=point_reach", "seeds=3", "video_every=10"])
    told = []
    filmer = Filmer(Parts(), [RunDirectory(tmp_path)], [settings], [slice(0, 3)], told.append, lambda *given: None)
    for step in (10, 20, 30):
        filmer(None, step - 10, step)
    assert told == ["warning: no films are made any more: MuJoCo finds no OpenGL"]
    assert not (tmp_path / "videos").exists()


@pytest.mark.slow
def test_runs_of_a_sweep_are_filmed_each_by_its_own_setting(tmp_path):
    given = [f"{key}={value}" for key, value in {**SMALL, "seeds": 1}.items()]
    settings = {
        name: config.load(["env=point_reach", "algo.hidden=[8]", f"algo.lr={rate}", f"video_every={every}", *given])
        for name, rate, every in (("a", 0.01, 0), ("b", 0.02, 600))
    }
    runs = runner.train(settings, tmp_path / "sweep")
    assert not (runs["a"][0] / "videos").exists()
    assert [path.name for path in (runs["b"][0] / "videos").iterdir()] == ["650.gif"]
