"""What the GPU benchmark makes of what it measures: traces, memory, what is kept, what is said of the targets."""

import json

import numpy as np
import pytest
from jax.profiler import ProfileData

from benchmarks.gpu import launches, seeds, targets, wall_clock
from benchmarks.gpu.report import Report
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.training import memory
from matd3_jax.training.session import TrainingSession

# Times in us. Stream 7: 0-2 and 5-6; stream 8: 1-3, a copy 5.5-7.5. Together 0-3 and 5-7.5: 5.5 of 7.5. Line 3 shows
# the same again by module; the host's plane is no device.
TRACE = """
planes { name: "/device:GPU:0"
  lines { id: 1 name: "Stream #7(Compute)" timestamp_ns: 5000
    events { metadata_id: 1 offset_ps: 0 duration_ps: 2000000 }
    events { metadata_id: 1 offset_ps: 5000000 duration_ps: 1000000 } }
  lines { id: 2 name: "Stream #8(Compute,MemcpyD2D)" timestamp_ns: 6000
    events { metadata_id: 2 offset_ps: 0 duration_ps: 2000000 }
    events { metadata_id: 3 offset_ps: 4500000 duration_ps: 2000000 } }
  lines { id: 3 name: "XLA Modules" timestamp_ns: 5000
    events { metadata_id: 4 offset_ps: 0 duration_ps: 9000000 } }
  event_metadata { key: 1 value { id: 1 name: "loop_fusion_1" } }
  event_metadata { key: 2 value { id: 2 name: "gemm" } }
  event_metadata { key: 3 value { id: 3 name: "MemcpyD2D" } }
  event_metadata { key: 4 value { id: 4 name: "jit_repeat" } } }
planes { name: "/host:CPU"
  lines { id: 1 name: "Stream #1" timestamp_ns: 0 events { metadata_id: 1 offset_ps: 0 duration_ps: 90000000 } }
  event_metadata { key: 1 value { id: 1 name: "thread" } } }
"""


def profile(text):
    return ProfileData.from_serialized_xspace(ProfileData.text_proto_to_serialized_xspace(text))


def test_read_a_trace():
    seen = launches.read(profile(TRACE))
    assert (seen["kernels"], seen["copies"]) == (3, 1)
    assert seen["window_seconds"] == pytest.approx(7.5e-6) and seen["busy_seconds"] == pytest.approx(5.5e-6)
    assert seen["idle_traced"] == pytest.approx(2 / 7.5)
    assert [row["kernel"] for row in seen["longest"]] == ["loop_fusion_1", "gemm"]
    assert launches.read(profile(TRACE[TRACE.index('planes { name: "/host') :])) is None


def test_covered():
    """The union of intervals, against the cells of a grid that any of them covers."""
    random = np.random.default_rng(0)
    for _ in range(20):
        spans = [(a, a + n) for a, n in zip(random.integers(0, 50, 12), random.integers(0, 12, 12), strict=True)]
        assert launches.covered(spans) == len({cell for a, b in spans for cell in range(a, b)})


def test_replay_plan():
    """The replay takes what is left, in whole rollouts: one rollout more would not fit."""
    trainer = TrainingSession(config.load(seeds.settings(64, 100_000))).trainer
    found = seeds.fitting(trainer, 1e15, 10**9)
    assert found == 10**9, "at most what was asked for"
    row, budget = 4 * 127 * trainer.sharding.padded_seeds, 10e9
    capacity = seeds.fitting(trainer, budget, 10**9)
    together = trainer.mesh.size if trainer.on_cpu else trainer.sharding.padded_seeds
    free = budget - trainer.sharding.padded_seeds * memory.seed_bytes(trainer) - together * memory.update_bytes(trainer)
    assert capacity % 100 == 0 and capacity * row <= free < (capacity + 100) * row
    with pytest.raises(ValueError, match="64 seeds need .* GB"):
        seeds.fitting(trainer, 1e8, 10**9)


def test_report_continues_where_it_was_cut_off(tmp_path):
    def fail():
        raise RuntimeError("out of\n memory")

    first = Report(tmp_path, minutes=1)
    assert first.case("seeds", "1, loop", lambda: {"cycle_seconds": 0.5})["cycle_seconds"] == 0.5
    assert first.case("seeds", "2, loop", fail) is None
    second = Report(tmp_path, minutes=1)
    assert second.case("seeds", "1, loop", fail)["cycle_seconds"] == 0.5, "not measured again"
    assert "RuntimeError: out of memory" in "\n".join(targets.table(second))
    assert second.case("seeds", "2, loop", lambda: {"cycle_seconds": 0.25}) is not None, "what failed is"
    out_of_time = Report(tmp_path, minutes=0)
    assert out_of_time.case("seeds", "4, loop", fail) is None and out_of_time.left == ["seeds: 4, loop"]
    assert list(out_of_time.rows("seeds")) == ["1, loop", "2, loop"]
    stored = json.loads((tmp_path / "report.json").read_text())
    stored["machine"]["devices"] = ["gpu:0 another"]
    (tmp_path / "report.json").write_text(json.dumps(stored))
    with pytest.raises(UserError, match="another; take another directory"):
        Report(tmp_path, minutes=1)


def test_targets(tmp_path):
    """What is missed is said together with what bounds it; a run at another size is not held against a target."""
    report = Report(tmp_path, minutes=1)
    loop = {"seeds": 20, "env_steps_per_second": 4e5, "cycle_seconds": 0.01}
    report.parts = {
        "seeds": {"20, loop": loop, "20, update": loop | {"env_steps_per_second": 9e9}},
        "launches": {
            "simple_spread, 20 seeds": {
                "cycle_seconds": 0.01,
                "busy_seconds_per_cycle": 0.002,
                "idle": 0.8,
                "kernels_per_cycle": 1500,
                "copies_per_cycle": 3,
            }
        },
        "floor": {
            "20 seeds": {"products_seconds": 1e-3, "bytes_seconds": 5e-4, "flops": 2e10},
            "1024 seeds": {"products_seconds": 7.0, "bytes_seconds": 7.0, "flops": 7.0},
        },
        "ant": {"loop, mjx, 20": {"seeds": 1, "num_envs": 20, "seconds_for_all": 60.0}},
    }
    text = "\n".join(targets.lines(report))
    assert "(20 seeds): 400,000; target 1,000,000: MISSED" in text
    assert "takes 10.00 ms, 2.00 of them with a kernel running (1500 kernels, 3 copies); the rest, 80%" in text
    assert "1.00 ms of products" in text and "(20 TFLOP/s), 0.50 ms of memory traffic" in text
    assert "(20 environments): 1.0 min\n" in text


def test_returns_compared_with_the_recorded_ones():
    """Half of the recorded seeds learn as the others do; 30 more return, which is what a defect would cost, shows."""
    table = wall_clock.recorded()
    odd, even = (table.take(table["seed"] % 2 == k) for k in (1, 0))
    rows = wall_clock.compared(odd, even)
    assert [row["episodes"] for row in rows] == [5_000, 10_000, 20_000, 40_000, 60_000]
    assert all(row["p"] > 0.01 for row in rows)
    better = Table({**odd.columns, wall_clock.RETURN: odd[wall_clock.RETURN] + 30})
    assert sum(row["p"] < 0.01 for row in wall_clock.compared(better, even)) >= 3
