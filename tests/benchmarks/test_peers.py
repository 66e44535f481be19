"""`benchmarks.peers` without the peers: its arithmetic and table, the workers' protocol on small scripts, errors."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import peers
from benchmarks.peers_scripts import process, rows
from benchmarks.peers_scripts.process import WorkerError
from benchmarks.peers_scripts.rows import Row, Variant, Worker
from matd3_jax import config
from matd3_jax.errors import UserError

SCRIPT = f"""
import os, sys, time
sys.path.insert(0, {str(Path(process.__file__).parent)!r})
import serve

def prepare(case):
    if case.get("broken"):
        raise RuntimeError("first line\\nno such environment")
    def block():
        print("noise on the standard output")
        if case.get("dies"):
            print("MemoryError: all gone", file=sys.stderr, flush=True)
            os._exit(3)
        time.sleep(case["pause"])
        return 10
    return block

serve.serve(prepare, ("numpy", "no-such-package"))
"""

SLOW, QUICK = Variant("ours", "slow", {"pause": 0.02}), Variant("ours", "quick", {"pause": 0.004})
DIES, BROKEN = Variant("AgileRL", "dies", {"dies": True}), Variant("AgileRL", "broken", {"broken": True})
PAIR = Variant("AgileRL", "two", {"pause": 0.02}, processes=2)


@pytest.fixture
def workers(tmp_path, monkeypatch):
    """Both sides run a script that sleeps; `tmp_path` is the folder of environments."""
    script = tmp_path / "worker.py"
    script.write_text(SCRIPT)
    monkeypatch.setitem(rows.WORKERS, "ours", Worker(str(script), "numpy"))
    monkeypatch.setitem(rows.WORKERS, "AgileRL", Worker(str(script), "no-such-package"))
    return tmp_path


def test_rates_are_measured_and_failures_are_reported(workers):
    group = [Row("a", (SLOW, QUICK), (PAIR,)), Row("b", (SLOW,), (DIES,)), Row("c", (SLOW,), (BROKEN,))]
    outcomes, versions = peers.measure(group[:1] + group[2:], 3, 0.05, workers)
    assert versions["ours"]["numpy"] and versions["AgileRL"]["no-such-package"] is None
    assert outcomes[peers.key(BROKEN)] == "no such environment"  # the last line of what was raised
    slow, quick, pair = rates = [outcomes[peers.key(v)] for v in (SLOW, QUICK, PAIR)]
    assert [len(turns) for turns in rates] == [3, 3, 3]
    # Ten env steps a pause: no sleep is shorter than asked for, and two processes are counted together.
    assert 0 < max(slow) <= 500 and 0 < max(quick) <= 2500 and 0 < max(pair) <= 1000
    assert sorted(quick)[1] > sorted(slow)[1]
    assert peers.best(group[0].ours, outcomes)[0] == QUICK
    ended, _ = peers.measure(group[1:2], 1, 0.05, workers)
    assert ended[peers.key(DIES)] == "MemoryError: all gone" and not isinstance(ended[peers.key(SLOW)], str)


def test_table_has_medians_and_the_ratio_of_the_same_turn():
    a, b = Variant("ours", "1 seed", {"n": 1}), Variant("ours", "2 seeds", {"n": 2})
    x, y = Variant("rejax", "x|y", {"n": 1}), Variant("rejax", "y", {"n": 2})
    outcomes: dict[str, peers.Outcome] = {
        peers.key(a): [100.0, 900.0, 110.0],  # the highest of all, but not the highest median
        peers.key(b): [1000.0, 120.0, 4000.0],
        peers.key(x): [500.0, 80.0, 1000.0],
        peers.key(y): "ImportError: no y",
    }
    row = Row("work", (a, b), (y, x))
    cells = peers.line(row, outcomes, {"rejax": {"rejax": "0.1.3"}})
    assert cells == [
        "work",
        "rejax 0.1.3",
        "**1,000** (120 to 4,000); 2 seeds",
        "**500** (80 to 1,000); x|y",
        "**2.00** (1.50 to 4.00)",  # 1000/500, 120/80, 4000/1000
    ]
    entry = peers.entry(row, outcomes)
    assert entry["ratio"] == {"median": 2.0, "lowest": 1.5, "highest": 4.0}
    assert entry["peer"][0]["error"] == "ImportError: no y"
    assert entry["ours"][0]["env_steps_per_second"] == [100.0, 900.0, 110.0]
    json.dumps(entry)
    failed = peers.line(Row("work", (a,), (y,)), outcomes, {})
    assert failed[1] == "rejax" and failed[3] == "failed: ImportError: no y; y" and failed[4] == ""
    assert peers.table([cells]).splitlines()[2].endswith("| **500** (80 to 1,000); x\\|y | **2.00** (1.50 to 4.00) |")
    assert [len(line.replace("\\|", "").split("|")) for line in peers.table([cells, failed]).splitlines()] == [7] * 4


def test_environment_of_a_worker(tmp_path, monkeypatch):
    worker = Worker("x.py", "thing", (("thing==1",),))
    assert process.python_of("ours", Worker("x.py", "thing"), tmp_path) == Path(sys.executable)
    with pytest.raises(WorkerError, match=f"not installed: .* prepare=true envs={tmp_path}"):
        process.python_of("thing", worker, tmp_path)
    failure = "ERROR: No matching distribution found for thing==1"
    calls = []

    class Done:
        returncode, stdout = 0, ""
        stderr = f"{failure}\nWARNING: something else"

    def run(call, **_):
        calls.append(call)
        Done.returncode = int("pip" in call and "thing==1" in call)
        return Done

    monkeypatch.setattr(process.subprocess, "run", run)
    assert process.install(worker, tmp_path) == failure and len(calls) == 2
    with pytest.raises(WorkerError, match=failure):
        process.python_of("thing", worker, tmp_path)
    good = Worker("x.py", "thing", (("other==1",), ("thing==2",)))
    assert process.install(good, tmp_path) is None and len(calls) == 5
    assert process.python_of("thing", good, tmp_path) == tmp_path / "thing" / "bin" / "python"
    with pytest.raises(WorkerError, match="other versions"):
        process.python_of("thing", worker, tmp_path)


def test_rows_ask_the_same_of_both_sides():
    """Networks, batch, update ratio and episode length; and every worker's script is there."""
    groups = rows.groups(2)
    for worker in rows.WORKERS.values():
        assert (Path(rows.__file__).parent / worker.script).is_file()
    for row in groups["agilerl"]:
        for mine in row.ours:
            ours = config.load(mine.case["settings"])
            for other in row.peer:
                case = other.case
                assert ours.algo.name.upper() == case["algorithm"] and list(ours.algo.hidden) == case["hidden"]
                assert ours.batch_size == case["batch_size"] and ours.replay_capacity == case["capacity"]
                assert ours.num_envs * ours.rollout_length == case["learn_every"] * ours.updates_per_collect
                assert (
                    ours.env["episode_length"] == case["episode_length"] and case["learn_every"] % case["num_envs"] == 0
                )
    for row in groups["rejax"]:
        ours, case = config.load(row.ours[0].case["settings"]), row.peer[0].case
        assert (ours.seeds, ours.num_envs, ours.updates_per_collect) == (case["seeds"],) + (case["num_envs"],) * 2
        assert (ours.batch_size, ours.replay_capacity) == (case["batch_size"], case["capacity"])
        assert (ours.algo.hidden, ours.algo.policy_delay, ours.algo.joint) == ((64, 64), 2, True)
    for row in groups["jaxmarl"]:
        ours, peer = row.ours[0].case, row.peer[0].case
        assert (ours["num_envs"], ours["steps"]) == (peer["num_envs"], peer["steps"])
        assert ours["options"]["episode_length"] == peer["options"]["max_steps"]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("turn=3", "there is no key 'turn'; did you mean 'turns'"),
        ("turns=0", "turns=0: must be a whole number of at least 1"),
        ("turns=2.5", "turns=2.5: must be"),
        ("seconds=0", "seconds=0: must be a positive number"),
        ("prepare=yes_please", "prepare=yes_please: must be true or false"),
        ("only=[agilerl,jaxmarel]", r"only=\[agilerl,jaxmarel\]: must be one of .*; did you mean 'jaxmarl'"),
        ("out=no/such/place.json", "out=no/such/place.json: there is no directory no/such"),
    ],
)
def test_mistakes_on_the_command_line(argument, message):
    with pytest.raises(UserError, match=message):
        peers.main([argument])
