"""Several processes: who they are, what they send each other, and that a run of theirs is that of one process."""

import csv
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
from checkpoint_arrays import leaves
from jax._src.clusters.slurm_cluster import SlurmCluster

from matd3_jax import config
from matd3_jax.cli import sweep, train
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import multihost, slurm
from matd3_jax.runtime.multihost import Processes
from matd3_jax.sweep import runner
from matd3_jax.training import checkpoint
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

# A point mass, with evaluations and a ring that comes round on the way.
TINY = [
    "env=point_reach", "algo=iddpg", "algo.hidden=[8]", "batch_size=16", "learning_starts=200", "total_steps=900",
    "log_every=100", "replay_capacity=500", "eval_every=300", "eval_episodes=3",
]  # fmt: skip
SEVEN = [*TINY, "seeds=7", "checkpoint_every=0"]

# ---- who the processes are -------------------------------------------------------------------------------------------

GIVEN = {"coordinator_address": "10.0.0.1:1234", "num_processes": "2", "process_id": "1"}


@pytest.mark.parametrize(
    "changed, words",
    [
        ({"process_id": None}, "num_processes=2: process_id= is missing"),
        ({"coordinator_address": None, "process_id": None}, "num_processes=2: coordinator_address= is missing"),
        ({"coordinator_address": "10.0.0.1"}, "coordinator_address=10.0.0.1: must be HOST:PORT"),
        ({"coordinator_address": "a:70000"}, "a:70000: must be HOST:PORT"),
        ({"num_processes": "two"}, "num_processes=two: must be a whole number of at least 1"),
        ({"num_processes": "0"}, "num_processes=0: must be"),
        ({"process_id": "-1"}, "process_id=-1: must be a whole number of at least 0"),
        ({"process_id": "2"}, "process_id=2: with num_processes=2 it goes from 0 to 1"),
    ],
)
def test_wrong_settings_get_one_line_and_leave_nothing(changed, words, tmp_path):
    given = [f"{key}={value}" for key, value in (GIVEN | changed).items() if value is not None]
    for main in (train.main, sweep.main):
        with pytest.raises(UserError, match=re.escape(words)) as error:
            main([*TINY, f"out={tmp_path}", *given])
        assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_settings_name_a_cluster_also_on_slurm():
    job = {"SLURM_STEP_NUM_TASKS": "4", "SLURM_STEP_NODELIST": "n1", "SLURM_JOB_ID": "1", "SLURM_PROCID": "0"}
    for environ in ({}, job):
        assert slurm.detect(GIVEN, environ) == ("10.0.0.1:1234", 2, 1, None)
    assert slurm.detect(GIVEN | {"coordinator_address": "[::1]:80"}, {}).coordinator_address == "[::1]:80"


def test_a_port_in_use_and_an_unknown_host_are_reported(monkeypatch):
    monkeypatch.setattr(slurm, "START_SECONDS", 0)
    with socket.create_server(("", 0)) as taken:
        address = f"localhost:{taken.getsockname()[1]}"
        with pytest.raises(UserError, match="cannot open port"):
            slurm.look_for(address, first=True)
    with pytest.raises(UserError, match="process 0 was not there within 0 s"):
        slurm.look_for(address, first=False)
    with pytest.raises(UserError, match="there is no host nowhere.invalid"):
        slurm.look_for("nowhere.invalid:1234", first=False)


STEP = {
    "SLURM_JOB_ID": "4711", "SLURM_STEP_ID": "0", "SLURM_NTASKS": "8", "SLURM_STEP_NUM_TASKS": "8",
    "SLURM_STEP_NODELIST": "node[007-009,020]", "SLURM_STEP_TASKS_PER_NODE": "2(x4)", "SLURM_PROCID": "5",
    "SLURM_NODEID": "2", "SLURM_LOCALID": "1",
}  # fmt: skip


def test_several_tasks_of_a_slurm_step_are_found():
    """4711 mod 4096 = 615, from 61440 on."""
    assert slurm.detect({}, STEP) == ("node007:62055", 8, 5, None)
    assert slurm.detect({}, STEP | {"JAX_COORDINATOR_PORT": "99"}).coordinator_address == "node007:99"
    other = slurm.detect({}, STEP | {"SLURM_STEP_ID": "1"})
    assert other.coordinator_address.startswith("node007:") and other.coordinator_address != "node007:62055"


@pytest.mark.parametrize("nodes", ["a", "a1,b2", "node[001-004]", "node[003,007-015],host2", "n-x[2,4]"])
def test_the_first_node_is_the_one_that_jax_finds(nodes, monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "4711")
    monkeypatch.setenv("SLURM_STEP_NODELIST", nodes)
    theirs = SlurmCluster.get_coordinator_address(None, None)
    assert slurm.detect({}, STEP | {"SLURM_STEP_NODELIST": nodes}).coordinator_address == theirs


def test_a_single_task_is_alone():
    """One task of srun; a batch script of a job with several tasks that calls no srun; no SLURM at all."""
    one = STEP | {"SLURM_NTASKS": "1", "SLURM_STEP_NUM_TASKS": "1"}
    script = {name: value for name, value in STEP.items() if "STEP" not in name}
    for environ in (one, script, {}):
        assert slurm.detect({}, environ) is None
    assert multihost.start({}) is multihost.SINGLE_PROCESS
    assert multihost.start(GIVEN | {"num_processes": "1", "process_id": "0"}) is multihost.SINGLE_PROCESS


@pytest.mark.parametrize(
    "more, gpus",
    [
        ({"CUDA_VISIBLE_DEVICES": "0,1"}, (1,)),
        ({"CUDA_VISIBLE_DEVICES": "0,1,2,3"}, (1, 3)),
        ({"CUDA_VISIBLE_DEVICES": "3"}, None),  # each task sees its own
        ({"CUDA_VISIBLE_DEVICES": "2,3", "SLURM_GPUS_PER_TASK": "2"}, None),
        ({"CUDA_VISIBLE_DEVICES": "0,1,2,3", "SLURM_STEP_TASKS_PER_NODE": "3(x2),1,2"}, None),  # alone on its node
        ({"CUDA_VISIBLE_DEVICES": "0,1,2,3,4,5", "SLURM_STEP_TASKS_PER_NODE": "1,2,3"}, (1, 4)),
    ],
)
def test_tasks_of_a_node_share_its_gpus_out(more, gpus):
    assert slurm.detect({}, STEP | more).local_device_ids == gpus


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_shares_are_neighbors_and_nearly_equal(size):
    for seeds in range(size, 20):
        shares = [Processes(index, size).share(seeds).seeds for index in range(size)]
        whole = [seed for share in shares for seed in range(seeds)[share]]
        lengths = [len(range(seeds)[share]) for share in shares]
        assert whole == list(range(seeds)) and max(lengths) - min(lengths) <= 1
    with pytest.raises(UserError, match=f"{size - 1} seeds? for {size} processes"):
        Processes(0, size).share(size - 1)


# ---- what they send each other ---------------------------------------------------------------------------------------


class Store:
    """A key-value store as the coordination service's, for threads."""

    def __init__(self):
        self.values, self.changed = {}, threading.Condition()

    def key_value_set_bytes(self, key, value):
        with self.changed:
            assert key not in self.values
            self.values[key] = value
            self.changed.notify_all()

    key_value_set = key_value_set_bytes

    def blocking_key_value_get_bytes(self, key, milliseconds):
        with self.changed:
            if not self.changed.wait_for(lambda: key in self.values, milliseconds / 1000):
                raise jax.errors.JaxRuntimeError(f"DEADLINE_EXCEEDED: {key}")
            return self.values[key]

    def key_value_delete(self, key):
        del self.values[key]

    def key_value_dir_get(self, folder):
        return [(key, value) for key, value in list(self.values.items()) if key.startswith(folder)]


def together(size, work):
    """What `work`(processes) gives, or raises, in each of `size` threads; and the store that they talked through."""
    store = Store()

    def one(index):
        try:
            with Processes(index, size, store) as processes:
                return work(processes)
        except Exception as error:
            return error

    with ThreadPoolExecutor(size) as threads:
        return list(threads.map(one, range(size))), store


def test_messages():
    """Rows of 3 + 2 + 2 seeds as one table with the types and the very bits; the largest number; the first's word; and
    what was sent does not stay behind."""
    rng = np.random.default_rng(0)
    table = {"step": np.full(7, 2**40), "seed": np.arange(7), "return": rng.normal(size=7), "loss": rng.normal(size=7)}
    table["loss"][[2, 5]] = np.nan

    def work(processes):
        own = {name: column[processes.share(7).seeds] for name, column in table.items()}
        found = [processes.gather(own), processes.agree([3, 15, 2][processes.index])]
        found.append(processes.broadcast({"a": [processes.index]} if processes.first else None))
        part = processes.part(2)
        found.append(None if part is None else [part.agree(10 * part.index), part.broadcast(part.index)])
        processes.check_same("x", "settings")
        return found

    (first, second, third), store = together(3, work)
    for name, column in table.items():
        np.testing.assert_array_equal(first[0][name], column)
        assert first[0][name].dtype == column.dtype
        np.testing.assert_array_equal(third[0][name], column[5:])
    for found in (first, second, third):
        assert found[1:3] == [15, {"a": [0]}]
    assert first[3] == second[3] == [10, 0] and third[3] is None
    assert (
        all(key.endswith("broadcast") for key in store.values) and len(store.values) <= 3
    )  # since the last collection


def test_other_settings_and_what_ends_one_end_all():
    (first, second), _ = together(2, lambda processes: processes.check_same(f"seeds={processes.index}", "settings"))
    assert str(first) == "process 1 was given settings other than process 0: seeds=1"
    assert str(second) == f"process 0 has ended: {first}" and isinstance(second, UserError)

    def fail(processes):
        if processes.index == 1:
            raise ValueError("no such luck")
        processes.barrier()

    (first, second, third), _ = together(3, fail)
    assert isinstance(second, ValueError)
    assert str(first) == str(third) == "process 1 has ended: ValueError('no such luck')"


def test_nothing_is_written_where_one_process_cannot_train(tmp_path, monkeypatch):
    def check(self, recorded=False):
        if self.processes.index == 1:
            raise UserError("no memory here")

    monkeypatch.setattr(TrainingSession, "check_memory", check)
    settings = config.load(SEVEN)
    (first, second), _ = together(2, lambda processes: Recorder(processes).start(settings, tmp_path / "new" / "run"))
    assert str(second) == "no memory here" and str(first) == "process 1 has ended: no memory here"
    assert not list(tmp_path.iterdir())


# ---- a run and a sweep -----------------------------------------------------------------------------------------------

WORKER = """
import os, signal, sys
stop, *arguments = sys.argv[1:]
from matd3_jax.cli import command, train
from matd3_jax.training.session import TrainingSession
advance = TrainingSession.advance
def counted(self, state):
    state, row = advance(self, state)
    if str(row["step"][0]) == stop:
        os.kill(os.getpid(), signal.SIGTERM)
    return state, row
TrainingSession.advance = counted
sys.exit(command.code(train.main, arguments))
"""


def table(run: Path) -> dict[str, np.ndarray]:
    with (run / "metrics.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    return {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(header)}


def same_numbers(ours, theirs, rtol=2e-5, atol=1e-5):
    """Rollouts of a device's seeds are one batch, and products of batches of another size sum in another order."""
    assert list(ours) == list(theirs)
    for name in ours:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=rtol, atol=atol, err_msg=name)


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """Seven seeds in one process, on one device, to the end."""
    out = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        one = jax.local_devices()[:1]
        patch.setattr(jax, "local_devices", lambda: one)
        assert train.main([*SEVEN, f"out={out}", "name=run"]) == 0
    return out / "run"


@pytest.mark.slow
def test_two_processes_make_the_run_of_one(alone, tmp_path):
    """Four seeds on three devices and three on one; SIGTERM to the second alone. Both stop with one checkpoint, each
    having written its part; this process resumes from it, to the run of one device."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    flags = " ".join(flag for flag in os.environ["XLA_FLAGS"].split() if "device_count" not in flag)
    places = (
        {"XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=3"},
        {"XLA_FLAGS": flags, "JAX_NUM_CPU_DEVICES": "1"},
    )
    clean = {name: value for name, value in os.environ.items() if name != "JAX_NUM_CPU_DEVICES"}
    workers = [
        subprocess.Popen(
            [sys.executable, "-c", WORKER, "500" if index else "", *SEVEN,
             f"out={tmp_path}", "name=run", f"coordinator_address={address}", "num_processes=2",
             f"process_id={index}"],
            env=clean | place, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        for index, place in enumerate(places)
    ]  # fmt: skip
    try:
        said = [worker.communicate(timeout=300)[0] for worker in workers]
    finally:
        for worker in workers:
            worker.kill()
    assert [worker.returncode for worker in workers] == [128 + signal.SIGTERM] * 2, said
    run = tmp_path / "run"
    assert f"stopped by SIGTERM at env step 500; resume with: python -m matd3_jax.train resume={run}" in said[0]
    assert "run directory" not in said[1] and "%" not in said[1]
    machine = json.loads((run / "machine.json").read_text())
    assert [len(process["devices"]) for process in machine["processes"]] == [3, 1]
    saved = checkpoint.verify(run / "checkpoints")
    assert saved.name == "500"
    assert {part.name for part in (saved / "state").iterdir()} == {"0", "4"}
    assert sorted(seed.name for seed in (saved / "replay").iterdir()) == list("0123456")
    whole = table(alone)
    same_numbers(table(run), {name: column[: 5 * 7] for name, column in whole.items()})

    assert train.main([f"resume={run}"]) == 0
    same_numbers(table(run), whole)
    ours, theirs = (json.loads((path / "summary.json").read_text()) for path in (run, alone))
    assert ours.keys() == theirs.keys() and ours["last_tenth"].keys() == {"agents"}
    states = [leaves(path) for path in (run, alone)]
    assert any("optimizer" in name for name in states[0])
    same_numbers(*states, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("index", range(3))
def test_any_number_of_processes_reads_a_checkpoint_of_one(alone, index):
    run, settings = RunDirectory.open(alone)
    training = TrainingSession(settings, processes=Processes(index, 3))
    state = checkpoint.restore(checkpoint.verify(run.checkpoints), training.trainer, training.share)
    own, saved = [slice(0, 3), slice(3, 5), slice(5, 7)][index], leaves(alone)
    for path, leaf in jax.tree_util.tree_flatten_with_path(state.groups)[0]:
        np.testing.assert_array_equal(leaf[: own.stop - own.start], saved[f".groups{jax.tree_util.keystr(path)}"][own])
    np.testing.assert_array_equal(jax.random.key_data(state.key)[: own.stop - own.start], saved[".key"][own])
    for place, seed in enumerate(range(7)[own]):
        np.testing.assert_array_equal(state.replay[place], saved[f"replay {seed}"])
    np.testing.assert_array_equal(training.seeds, np.arange(7)[own])


class OneAtATime(ocp.StandardCheckpointer):
    """Orbax counts what it does for a whole interpreter: its threads must not do it at the same time."""

    lock = threading.Lock()

    def __enter__(self):
        self.lock.acquire()
        return super().__enter__()

    def __exit__(self, *error):
        try:
            return super().__exit__(*error)
        finally:
            self.lock.release()


@pytest.mark.slow
def test_a_sweep_shares_the_seeds_of_each_batch(tmp_path, monkeypatch):
    """Two processes: a batch of two runs, with three seeds (the third in the second process) and with one, and a batch
    of one seed, which the second process sits out. The same runs as in one process."""
    more = [*TINY, "eval_every=0", "total_steps=400", f"out={tmp_path}"]
    settings = {
        name: config.load([*more, f"algo.lr={lr}", f"algo.hidden=[{units}]", f"seeds={seeds}"])
        for name, lr, units, seeds in (("a", 0.01, 8, 3), ("b", 0.1, 8, 1), ("c", 0.01, 7, 1))
    }
    monkeypatch.setattr(runner.Stop, "__init__", lambda self: setattr(self, "signal", None))  # not in threads
    monkeypatch.setattr(ocp, "StandardCheckpointer", OneAtATime)
    monkeypatch.setattr(runner, "fitting_seeds", lambda settings, budget: 4)

    def work(processes):
        made = runner.Sweep(tmp_path / str(processes.size), processes)
        if processes.first:
            made.add(settings)
        processes.barrier()
        return made.train()

    assert together(2, work)[0] == [0, 0]
    assert runner.Sweep(tmp_path / "2").batches == [["a", "b"], ["c"]] and (tmp_path / "2/runs/c/summary.json").exists()
    del settings["c"]
    assert together(1, work)[0] == [0]
    assert {part.name for part in (tmp_path / "2/runs/a/checkpoints/400/state").iterdir()} == {"0", "2"}
    for name, setting in settings.items():
        several, one = (tmp_path / folder / "runs" / name for folder in "21")
        same_numbers(table(several), table(one))
        assert json.loads((several / "summary.json").read_text())["last_tenth"].keys() == {"agents"}
        saved = [checkpoint.verify(run / "checkpoints") for run in (several, one)]
        states = [checkpoint.restore_actors(path, TrainingSession(setting).trainer) for path in saved]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), *(s.groups for s in states))
    assert not (tmp_path / "2" / "batches" / "0").exists()


@pytest.mark.slow
def test_processes_begin_with_the_networks_of_another_run(tmp_path, monkeypatch):
    """Each with those of its own seeds (here seeds 2 to 4 of three processes' run, seed 4 with the source's seed 0,
    counted round), and against the same frozen team, as the run of one process does."""
    monkeypatch.setattr(ocp, "StandardCheckpointer", OneAtATime)
    small = ["env=simple_push", *TINY[1:], "checkpoint_every=0", "eval_every=0", "total_steps=400"]
    Recorder().start(config.load([*small, "seeds=2"]), tmp_path / "source")
    begun = [f"init={tmp_path / 'source'}", f"adversary.policy={tmp_path / 'source'}", "adversary.frozen=true"]
    settings = config.load([*small, *begun, "seed=2", "seeds=3"])

    def work(processes):
        return Recorder(processes).start(settings, tmp_path / f"of {processes.size}").training.seeds.tolist()

    found, _ = together(2, work)
    assert found == [[2, 3], [4]]
    assert together(1, work)[0] == [[2, 3, 4]]
    several, one = tmp_path / "of 2", tmp_path / "of 1"
    for name, given in leaves_of_start(several).items():
        np.testing.assert_array_equal(given, leaves_of_start(one)[name])
    same_numbers(table(several), table(one))
    states = [checkpoint.read_state(checkpoint.verify(run / "checkpoints"), 0, 3, 3) for run in (several, one)]
    assert states[1].keys() == states[0].keys() and len(states[0]) > 10
    same_numbers(*states, rtol=1e-4)


@pytest.mark.slow
def test_a_hybrid_run_of_two_processes_is_that_of_one(tmp_path, monkeypatch):
    """By itself with joined networks and in a sweep with distilled ones: each process hands over the networks and the
    replays of its own seeds."""
    monkeypatch.setattr(runner.Stop, "__init__", lambda self: setattr(self, "signal", None))  # not in threads
    monkeypatch.setattr(ocp, "StandardCheckpointer", OneAtATime)
    small = [*TINY, "algo=hybrid", "algo.policy_delay=1", "eval_every=0", "checkpoint_every=0", "total_steps=600",
             "switch_at=300", "seeds=3"]  # fmt: skip
    settings = config.load(small)
    distilled = config.load([*small, "algo.handover=distill", "algo.distillation_updates=40", f"out={tmp_path}"])

    def work(processes):
        made = runner.Sweep(tmp_path / "sweep", processes)
        if processes.first:
            made.add({"a": distilled})
        processes.barrier()
        assert made.train() == 0
        return Recorder(processes).start(settings, tmp_path / "of 2").training.seeds.tolist()

    assert together(2, work)[0] == [[0, 1], [2]]
    for alone, several in ((settings, tmp_path / "of 2"), (distilled, tmp_path / "sweep" / "runs" / "a")):
        name = alone.algo.handover
        Recorder().start(alone, tmp_path / name)
        one = table(tmp_path / name)
        assert np.isfinite(one["agents_critic_loss"][one["updates"] > 0]).all()
        same_numbers(table(several), one)
        assert json.loads((several / "agents" / "summary.json").read_text())["total_steps"] == 300


@pytest.mark.slow
def test_a_recurrent_run_of_two_processes_is_that_of_one(tmp_path, monkeypatch):
    """What the actors remember while they act, and what the replay keeps of it, are of each process's own seeds."""
    monkeypatch.setattr(ocp, "StandardCheckpointer", OneAtATime)
    memory = ["algo.actor=gru", "algo.gru_units=4", "sequence_length=4", "burn_in=2"]
    settings = config.load([*TINY, *memory, "checkpoint_every=0", "total_steps=400", "seeds=3"])
    for size in (2, 1):
        together(size, lambda processes: Recorder(processes).start(settings, tmp_path / str(processes.size)))
    several, one = tmp_path / "2", tmp_path / "1"
    same_numbers(table(several), table(one))
    states = [checkpoint.read_state(checkpoint.verify(run / "checkpoints"), 0, 3, 3) for run in (several, one)]
    assert any("gru" in name for name in states[1])
    same_numbers(*states, rtol=1e-4)


def leaves_of_start(run: Path) -> dict[str, np.ndarray]:
    with np.load(run / "start.npz") as file:
        return {name: file[name] for name in file.files}
