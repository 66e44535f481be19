"""What the benchmarks make of their measurements, on made-up numbers; their counts compared with counts by hand."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pictures
import pytest

from benchmarks import compile_times, fresh, growth, growth_figure, guard, loop, recording
from benchmarks.loop import copies_in
from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.figures.style import SERIES
from matd3_jax.training.session import TrainingSession


def point(value, seconds, megabytes=10.0):
    memory = {"xla": megabytes * 1e6, "replay": 5e6, "temporaries": 1e6, "process": 1e9}
    return {"value": value, "cycle_seconds": seconds, "fastest": 0.9 * seconds, "slowest": 1.2 * seconds,
            "product_flops_of_a_cycle": 1e9 * seconds, "memory": memory}  # fmt: skip


def test_exponents_and_figure(tmp_path, monkeypatch):
    """A square law, one that turns from flat to cubic, and points that could not be measured."""
    axes = {
        "seeds": [point(n, 0.1 * n**2, 3 * n) for n in (1, 2, 4, 8)],
        "agents": [point(3, 1.0), point(6, 1.0), point(12, 1.0), point(24, 8.0), {"value": 48, "error": "too large"}],
        "batch": [point(128, 1.0), {"value": 8192, "error": "too large"}],
    }
    found = growth.exponents(axes)
    assert found["seeds"]["time"] == {"all": 2.0, "upper": 2.0} and found["seeds"]["memory"]["all"] == 1.0
    # Through (0, 0), (1, 0), (2, 0), (3, 3) in powers of two the least-squares slope is (1.5 x 3) / 5 = 0.9.
    assert found["agents"]["time"] == {"all": 0.9, "upper": 3.0} and found["agents"]["process"]["all"] == 0.0
    assert "batch" not in found
    figures, path = pictures.written(monkeypatch), tmp_path / "growth.png"
    growth_figure.draw(path, axes)
    columns = np.reshape(figures[path].axes, (2, 3)).T
    assert [below.get_xlabel() for _, below in columns] == ["seeds", "agents", "minibatch"]
    for (above, below), points in zip(columns, axes.values(), strict=True):
        x, seconds, megabytes = np.array(
            [(p["value"], p["cycle_seconds"], p["memory"]["xla"] / 1e6) for p in points if "error" not in p]
        ).T
        time, memory = pictures.lines(above), pictures.lines(below)
        np.testing.assert_allclose(time["measured"], [x, 1000 * seconds])
        np.testing.assert_allclose(time["as the products"], [x, 1000 * seconds])  # what `point` says of them
        (band,) = pictures.bands(above)
        np.testing.assert_allclose(band, [x, 900 * seconds, 1200 * seconds])
        wanted = {"process at most": 1000, "the interval's, by XLA": megabytes, "of it the replay": 5}
        powers = {"quadratic": 2, "cubic": 3} if below.get_xlabel() == "agents" else {"linear": 1}
        assert memory.keys() == {*wanted, *powers} and time.keys() == {"measured", "as the products", *powers}
        for name, line in wanted.items():
            np.testing.assert_allclose(memory[name], np.broadcast_arrays(x, line))
        for name, order in powers.items():
            np.testing.assert_allclose(time[name], [x, 1000 * seconds[0] * (x / x[0]) ** order])
            np.testing.assert_allclose(memory[name], [x, megabytes[0] * (x / x[0]) ** order])
        assert above.get_xscale() == above.get_yscale() == below.get_yscale() == "log"
        # A power may leave the picture, what was measured may not.
        for axis, values in ((above, 1000 * seconds), (below, megabytes)):
            assert axis.get_ylim()[0] < values.min() and values.max() < axis.get_ylim()[1]
    assert [axis.get_ylabel() for axis in columns[0]] == ["ms an iteration, all seeds", "MB"]
    assert {SERIES[0], SERIES[1], SERIES[4]} <= pictures.colors(path)
    legend = [text.get_text() for text in columns[-1][0].get_legend().get_texts()]
    assert legend == ["as the products", "measured", "linear", "quadratic", "cubic"]


def test_points_of_the_growth_study_are_possible():
    """Every point is a run whose replay is as large as wanted and full when learning starts."""
    for axis, values in growth.AXES.items():
        for value in (values[0], values[-1]):
            wanted = {"seeds": 2, **growth.BASE, axis: value}
            found = config.load(growth.settings(wanted))
            assert (found.seeds, found.batch_size, found.env["num_agents"]) == (
                wanted["seeds"], wanted["batch"], wanted["agents"])  # fmt: skip
            assert found.replay_capacity == found.learning_starts == wanted["replay"] <= found.total_steps
    with pytest.raises(UserError, match="agents=3,x: must be a list, each a whole number of at least 1"):
        growth.main(["agents=3,x"])


def test_counted_products():
    """Of an iteration of MATD3 on simple_spread, product by product, for two seeds on two devices."""
    agents, batch, hidden = 3, 256, 8
    settings = [f"batch_size={batch}", f"algo.hidden=[{hidden},{hidden}]", "seeds=2", "total_steps=30000"]
    trainer = TrainingSession(config.load(settings)).trainer
    o, a = 18, 5
    x = agents * (o + a)

    def network(inputs, outputs):  # multiplications of one row
        return inputs * hidden + hidden * hidden + hidden * outputs

    actor, critic = network(o, a), network(x, 1)
    hidden_back = network(x, 1) - x * hidden  # gradients of activations; none is taken of the first layer's inputs
    critics = 2 * (critic + critic + critic + hidden_back)  # target, loss, kernels' and activations' gradients
    # One critic's value of the new action (a columns on top of what is replayed), gradients back to the action alone.
    through_critic = critic + a * hidden + hidden_back + a * hidden
    own_actor = actor + actor + (actor - o * hidden)
    update = batch * agents * (agents * actor + critics)
    moving = batch * agents * (through_critic + own_actor)
    rollout = 200 * agents * actor
    wanted = 2 * 2 * (2 * update + moving + rollout)  # a multiplication and an addition; two seeds
    shape = (trainer.sharding.padded_seeds, trainer.schedule.replay_capacity, trainer.layout.row_size)
    state = trainer.abstract_state()._replace(replay=jax.ShapeDtypeStruct(shape, jnp.float32))
    traced = trainer.interval(3).jitted.trace(state, trainer.hyper)
    assert loop.product_flops(traced.jaxpr.jaxpr) / 3 == pytest.approx(wanted, rel=1e-3)


def test_guard_fails_on_gross_regressions_only():
    recorded = json.loads(guard.RECORDED.read_text())["cpu"]["ratios"]
    assert guard.failures(recorded, recorded) == []
    for key, fine, gross in (
        ("loop_over_floor", 1.5 * recorded["loop_over_floor"], 2.1 * recorded["loop_over_floor"]),
        ("rollout_share", recorded["rollout_share"] + 0.05, 2 * recorded["rollout_share"] + 0.06),
        ("memory_over_replay", recorded["memory_over_replay"] + 0.3, recorded["memory_over_replay"] + 1),
        ("replay_copies", 0, 1),
        ("loop_over_floor", 0.1, np.nan),
    ):
        assert guard.failures({**recorded, key: fine}, recorded) == []
        (line,) = guard.failures({**recorded, key: gross}, recorded)
        assert guard.BOUNDS[key].meaning in line and f"{gross:.3g}" in line


def test_copies_of_the_replay_are_counted():
    trainer = TrainingSession(config.load(["seeds=2", "total_steps=30000"])).trainer
    shape = f"f32[1,{trainer.schedule.replay_capacity},127]{{2,1,0}}"
    text = f"  %a = {shape} parameter(0)\n  %b = {shape} copy(%a)\n  %c = f32[1,100,127]{{2,1,0}} copy(%d)\n"
    assert copies_in(text, trainer) == 1


def test_compile_times_reports_medians_and_slow_programs():
    def report(scale):
        stages = {"trace": 1.0, "lower": 1.0, "compile": scale, "seconds": 2 + scale, "cpu": scale}
        return {"import": 3.0, "programs": dict.fromkeys(compile_times.PROGRAMS, stages), "total": 3 + 4 * scale}

    cold = compile_times.median([report(10.0), report(40.0), report(31.0)])
    assert cold["programs"]["interval"]["cpu"] == 31.0 and cold["total"] == 127.0
    environments = {"simple": {"cold": cold, "warm": report(1.0)}, "ant": {"cold": report(29.0), "warm": report(40.0)}}
    assert compile_times.slow(environments)[3] == "simple: interval took 31 s of a core cold, more than 30"
    assert len(compile_times.slow(environments)) == len(compile_times.PROGRAMS)
    assert "33.0 (31.0)" in compile_times.row("simple", "cold", cold)
    with pytest.raises(UserError, match="simple_spraed.*simple_spread"):
        compile_times.main(["envs=[simple_spraed]"])


def test_a_fresh_process_answers_or_says_what_went_wrong(tmp_path):
    (tmp_path / "asked.py").write_text(
        "import os, sys\nprint('on the way')\nif sys.argv[1] == 'well': print('{\"a\": 1}')\n"
        "if sys.argv[1] == 'mistake': sys.exit(print('error: no seeds', file=sys.stderr) or 2)\n"
        "if sys.argv[1] == 'killed': os.kill(os.getpid(), 9)\nif sys.argv[1] == 'bug': 1 / 0\n"
    )
    environment = {"PYTHONPATH": str(tmp_path)}
    assert fresh.run("asked", ["well"], environment) == {"a": 1}
    for word, error, text in (
        ("mistake", UserError, "^no seeds$"),
        ("killed", UserError, "killed by signal 9"),
        ("bug", RuntimeError, "ZeroDivisionError"),
    ):
        with pytest.raises(error, match=text):
            fresh.run("asked", [word], environment)


def test_recording_counts_the_replays_that_it_writes(tmp_path):
    """Two seeds' full replays of 400 rows: the checkpoint is at least as large, and nothing is left behind."""
    line = ["env=point_reach", "algo=iddpg", "seeds=2", "learning_starts=200", "num_envs=4", "rollout_length=5"]
    line += ["batch_size=16", "replay_capacity=400", "algo.hidden=[8]", "log_every=100", "eval_every=0"]
    out = tmp_path / "report.json"
    argv = [*line, "total_steps=600", "intervals=1", "repeats=1", f"folder={tmp_path}", f"out={out}"]
    assert recording.main(argv) == 0
    found = json.loads(out.read_text())
    row_size = TrainingSession(config.load([*line, "total_steps=600"])).layout.row_size
    assert found["checkpoint"]["rows_of_a_seed"] == 400
    assert found["settings"] == [*line, "total_steps=600"]  # nothing of this machine
    replays = 2 * 400 * row_size * 4
    assert replays < found["checkpoint"]["bytes"] < replays + 200_000
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]
