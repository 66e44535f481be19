"""Episodes as films: the command's files and messages, the play behind them, MuJoCo's robots, and what cannot be."""

import dataclasses
import importlib
import stat
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageSequence

from matd3_jax import config
from matd3_jax.cli import render, train
from matd3_jax.envs import Box, Environment, TimeStep, make
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import UserError
from matd3_jax.evaluation import trajectory
from matd3_jax.training import checkpoint
from matd3_jax.training.session import TrainingSession
from matd3_jax.video import encode, frames

pytestmark = pytest.mark.slow

TINY = [
    "env=simple_push", "adversary=maddpg", "seeds=3", "seed=5", "algo.hidden=[8]", "adversary.hidden=[8]",
    "batch_size=16", "num_envs=2", "learning_starts=200", "replay_capacity=500", "total_steps=1000", "eval_every=0",
    "normalize_observations=true",
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    assert train.main([*TINY, f"out={out}", "name=push"]) == 0
    return out / "push"


@pytest.fixture(scope="module")
def trained(run):
    training = TrainingSession(config.read(run / "config.yaml"))
    return training, checkpoint.restore_actors(checkpoint.verify(run / "checkpoints"), training.trainer)


def frames_of(path: Path) -> list[np.ndarray]:
    with Image.open(path) as image:
        return [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(image)]


# ---- the command -----------------------------------------------------------------------------------------------------


def test_render_leaves_a_gif_of_the_whole_episode(run, capsys):
    """The start and 25 env steps; at 10 frames a second, over and over, the last frame longer; small."""
    assert render.main([f"run={run}"]) == 0
    path = run / "episode.gif"
    assert capsys.readouterr().out.startswith(
        f"{path}: 26 frames of episode 0 with seed 5, 25 env steps (truncated), return: adversaries "
    )
    with Image.open(path) as image:
        assert image.n_frames == 26 and max(image.size) == 400 and image.info["loop"] == 0
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert durations == [100] * 25 + [1100]
    assert path.stat().st_size < 300_000
    frames = frames_of(path)
    for a, b in zip(frames, frames[1:], strict=False):
        assert np.abs(a[:22] - b[:22]).max() > 100  # the caption counts
        assert np.abs(a[22:-22] - b[22:-22]).max() > 100  # and somebody moves
        np.testing.assert_array_equal(a[-22:], b[-22:])  # the legend stays


def test_options_choose_the_frames(run, tmp_path, capsys):
    """Every tenth of 23 steps and the last, at 5 frames a second and 200 pixels."""
    path = tmp_path / "short.gif"
    words = ["max_steps=23", "every=10", "fps=5", "size=200", "seed=7", "episode=3", "deterministic=false"]
    assert render.main([f"run={run}", f"out={path}", *words]) == 0
    assert "4 frames of episode 3 with seed 7, 23 env steps (stopped by max_steps)" in capsys.readouterr().out
    with Image.open(path) as image:
        assert image.n_frames == 4 and max(image.size) == 200 and image.info["duration"] == 200
    assert not (run / "short.gif").exists()


def test_long_episodes_are_thinned_out(run, tmp_path, monkeypatch, capsys):
    """25 steps with room for 9 pictures: every third, and the last."""
    monkeypatch.setattr(render, "PICTURES", 9)
    assert render.main([f"run={run}", f"out={tmp_path / 'a.gif'}", "size=100"]) == 0
    assert "10 frames of episode 0" in capsys.readouterr().out


BAD = {
    "no run": ([], "run=RUN_DIR"),
    "nowhere": (["run=nowhere"], "no run directory nowhere"),
    "unknown key": (["run={run}", "evry=3"], "every"),
    "no such seed": (["run={run}", "seed=4"], "seed=4: the seeds of .* are 5 to 7"),
    "no such checkpoint": (["run={run}", "checkpoint=7"], "no checkpoint of step 7"),
    "picture": (["run={run}", "out=a.png"], r"must end with .gif or .mp4"),
    "no folder": (["run={run}", "out={run}/no/a.gif"], "there is no directory"),
    "every": (["run={run}", "every=0"], "every=0"),
    "size": (["run={run}", "size=50"], "size=50: must be a whole number from 100 to 2000"),
    "fast": (["run={run}", "fps=80"], "at most 50"),
    "word": (["run={run}", "deterministic=1"], "deterministic=1: must be true or false"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_writes_nothing(case, run):
    arguments, wanted = BAD[case]
    before = {p: p.stat().st_mtime_ns for p in run.parent.rglob("*")}
    with pytest.raises(UserError, match=wanted) as error:
        render.main([a.format(run=run) for a in arguments])
    assert "\n" not in str(error.value)
    assert before == {p: p.stat().st_mtime_ns for p in run.parent.rglob("*")}


# ---- the play --------------------------------------------------------------------------------------------------------


def test_the_episode_is_one_of_the_evaluation(trained):
    """Episode 2 of the second seed has the return and the start that `evaluate` gives it."""
    training, state = trained
    found = training.evaluate(state, 3, deterministic=True)
    for number in (0, 2):
        played = trajectory.play(training, state, 1, number)
        for team, i in (("adversaries", 0), ("agents", 1)):
            assert played.returns[team][-1] == pytest.approx(found.episode_return[1, number, i], rel=1e-3)
        assert played.length == 25 and played.truncated and not played.terminated
    other = trajectory.play(training, state, 0, 0).states
    assert np.any(other.pos[-1] != trajectory.play(training, state, 1, 0).states.pos[-1])
    np.testing.assert_array_equal(other.pos[0], trajectory.play(training, state, 1, 0).states.pos[0])


def test_returns_and_states_belong_together(trained):
    """The return so far is the sum of the rewards of the states so far; noise changes what is played."""
    training, state = trained
    played = trajectory.play(training, state, 0, 0)
    rewards = np.stack([training.env.reward(jax.tree.map(lambda x, t=t: x[t], played.states)) for t in range(1, 26)])
    np.testing.assert_allclose(np.diff(played.returns["agents"]), rewards[:, 1], rtol=1e-4, atol=1e-5)
    assert played.captions()[0] == "step 0   return: adversaries 0.0, agents 0.0"
    last = f"step 25   return: adversaries {rewards[:, 0].sum():.1f}, agents {rewards[:, 1].sum():.1f}"
    assert played.captions()[-1] == last
    some = played.at(7)
    assert some.step.tolist() == [0, 7, 14, 21, 25]
    np.testing.assert_array_equal(some.states.pos, np.asarray(played.states.pos)[some.step])
    noisy = trajectory.play(training, state, 0, 0, deterministic=False).states.pos
    np.testing.assert_array_equal(noisy[0], played.states.pos[0])
    assert np.abs(noisy[-1] - played.states.pos[-1]).max() > 1e-3


@dataclasses.dataclass(frozen=True)
class Countdown(Environment):
    """Terminates with the seventh step; draws a red bar as long as the time that is left."""

    episode_length: int = 20
    agents = ("one", "two")
    observation_sizes = (1, 1)
    action_spaces = (Box(1, -1.0, 1.0),) * 2

    def reset(self, key):
        return jnp.int32(7), self.observe(jnp.int32(7))

    def observe(self, state):
        return (jnp.float32(state)[None],) * 2

    def step(self, key, state, action):
        left = state - 1
        return TimeStep(left, self.observe(left), jnp.ones(2), left == 0, jnp.bool_(False))

    def draw(self, state, size):
        image = np.full((size // 2, size, 3), 255, np.uint8)
        image[:, : int(state) * size // 7] = (255, 0, 0)
        return image


@pytest.fixture(scope="module")
def own():
    import matd3_jax

    return matd3_jax.train(
        env=Countdown(), total_steps=300, learning_starts=100, num_envs=2, rollout_length=10, batch_size=16,
        algo="matd3", eval_every=0,
    )  # fmt: skip


def test_an_environment_that_draws_itself_and_terminates(own):
    played = trajectory.play(own.training, own.state)
    assert played.length == 7 and played.terminated and not played.truncated
    assert played.returns["agents"].tolist() == [2.0 * t for t in range(8)]
    drawn = frames.frames(Countdown(), played.states, played.captions(), size=200)
    assert len(drawn) == 8 and all(frame.size == drawn[0].size for frame in drawn)
    red = [np.sum(np.asarray(frame)[30, :, 1] == 0) for frame in drawn]
    width = drawn[0].width
    assert red == [(7 - t) * width // 7 for t in range(8)]


def test_a_joined_team_looks_like_the_task_it_joins():
    env = make("simple_tag")
    joined = JointTeam(env, "adversaries")
    states = jax.tree.map(lambda leaf: leaf[None], joined.reset(jax.random.key(0))[0])
    (one,), (other,) = frames.frames(env, states, size=150), frames.frames(joined, states, size=150)
    np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


@pytest.mark.parametrize(
    ("draw", "wanted"),
    [
        (lambda self, state, size: np.zeros((size, size)), r"float64 \[\d+, \d+\]: must be uint8"),
        (lambda self, state, size: np.zeros((size, size + int(state), 3), np.uint8), "one size"),
        (None, "Countdown cannot be drawn"),
    ],
)
def test_what_cannot_be_drawn_is_said_in_one_line(draw, wanted, monkeypatch):
    monkeypatch.setattr(Countdown, "draw", draw)
    with pytest.raises(UserError, match=wanted):
        frames.frames(Countdown(), jnp.arange(2))


# ---- files -----------------------------------------------------------------------------------------------------------


def striped(number: int) -> list[Image.Image]:
    """Pictures with a column of red that moves to the right, on white."""
    found = []
    for k in range(number):
        pixels = np.full((31, 45, 3), 255, np.uint8)
        pixels[:, k] = (200, 30, 30)
        found.append(Image.fromarray(pixels))
    return found


def test_colors_survive_in_a_gif(tmp_path):
    """Little of a color on a large background, and 300 other colors in one frame."""
    frames = striped(9)
    ramp = np.full((31, 45, 3), 255, np.uint8)
    ramp[:20] = np.linspace(0, 255, 20 * 45).reshape(20, 45, 1)
    encode.write(tmp_path / "a.gif", [*frames, Image.fromarray(ramp)], fps=20)
    read = frames_of(tmp_path / "a.gif")
    assert len(read) == 10
    for k, pixels in enumerate(read[:9]):
        assert np.abs(pixels[:, k] - (200, 30, 30)).max() < 25 and pixels[:, k + 1 :].min() > 250


@pytest.fixture
def fake_ffmpeg(tmp_path, monkeypatch):
    """An ffmpeg on the PATH that leaves its arguments and input in files."""
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text(
        f"#!{sys.executable}\nimport sys\n"
        f"open({str(tmp_path / 'arguments')!r}, 'w').write(' '.join(sys.argv[1:]))\n"
        f"open({str(tmp_path / 'input')!r}, 'wb').write(sys.stdin.buffer.read())\n"
        "if 'broken' in sys.argv[-1]:\n    sys.exit('Unknown encoder')\n"
        "open(sys.argv[-1], 'wb').write(b'film')\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", str(program.parent))
    return tmp_path


@pytest.mark.skipif(sys.platform == "win32", reason="a script stands in for ffmpeg")
def test_mp4_goes_through_ffmpeg_frame_by_frame(fake_ffmpeg):
    encode.write(fake_ffmpeg / "a.mp4", striped(5), fps=12)
    pixels = np.frombuffer((fake_ffmpeg / "input").read_bytes(), np.uint8).reshape(5, 31, 45, 3)
    np.testing.assert_array_equal(pixels, [np.asarray(frame) for frame in striped(5)])
    arguments = (fake_ffmpeg / "arguments").read_text()
    assert "-s 45x31" in arguments and "-r 12" in arguments and arguments.endswith(".mp4")
    assert (fake_ffmpeg / "a.mp4").read_bytes() == b"film" and not list(fake_ffmpeg.glob(".*"))
    with pytest.raises(UserError, match="Unknown encoder"):
        encode.write(fake_ffmpeg / "broken.mp4", striped(1), fps=12)


def test_without_ffmpeg_one_line_says_what_to_do(run, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"ffmpeg.*install it, or choose a name that ends with .gif"):
        render.main([f"run={run}", f"out={tmp_path / 'a.mp4'}"])


@pytest.mark.skipif(importlib.import_module("shutil").which("ffmpeg") is None, reason="no ffmpeg on the PATH")
def test_a_real_mp4(tmp_path):
    encode.write(tmp_path / "a.mp4", striped(5), fps=12)
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"
