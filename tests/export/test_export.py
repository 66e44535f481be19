"""Exported policies do what the trained ones do, in programs that know nothing of ours; what cannot be is refused."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.cli import command, train
from matd3_jax.core import acting, agents
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.errors import UserError
from matd3_jax.export import FORMATS, compare, export, numpy_file, onnx_file, saved_function, write
from matd3_jax.export.policy import function
from matd3_jax.training.saved_policies import SavedPolicies
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SMALL = [
    "seeds=2", "seed=3", "num_envs=2", "learning_starts=100", "batch_size=8", "replay_capacity=400", "total_steps=200",
    "eval_every=0",
]  # fmt: skip
CASES = {
    "sigmoid": ["env=point_reach"],
    "tanh": ["env=point_reach", "algo.actor_output=tanh", "algo.actor_average=0.1", "normalize_observations=true"],
    "soft words and moves": ["env=simple_reference"],
    "one actor for both": ["env=point_reach", "algo.share_parameters=kind", "normalize_observations=true"],
    "choices": ["env=simple_reference", "env.actions=discrete", "normalize_observations=true",
                "normalize_least_deviation=0.3"],
    "a choice, and teams": ["env=simple_tag", "env.actions=discrete", "adversary=maddpg", "adversary.hidden=[9,7]"],
    "one for all": ["env=simple_reference", "algo=td3", "env.actions=discrete"],
    "one for its team": ["env=simple_tag", "algo=matd3", "adversary=td3", "env.actions=continuous", "env.rules=mpe2"],
}  # fmt: skip


def untrained(lines) -> tuple[TrainingSession, SavedPolicies]:
    """A run's policies with weights as large as trained ones, and statistics of observations that say something."""
    settings = config.load([*lines, *SMALL, "algo.hidden=[12,10]"])
    training = TrainingSession(settings)
    state = training.trainer.init(training.keys())
    rng = np.random.default_rng(0)

    def stirred(tree):
        return jax.tree.map(lambda leaf: leaf + 0.3 * rng.normal(size=leaf.shape).astype(np.float32), tree)

    groups = tuple(
        group._replace(actor=stirred(group.actor), actor_average=stirred(group.actor_average)) for group in state.groups
    )
    state = state._replace(groups=groups)
    if state.statistics is not None:
        shape = state.statistics.mean.shape
        state = state._replace(
            statistics=Statistics(*(rng.uniform(low, 1, shape).astype(np.float32) for low in (-1, 0.01)))
        )
    return training, SavedPolicies(state, np.array([120, 120]), np.array([True, True]), {})


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return untrained(CASES[request.param])


def runners(folder: Path, format: str, names) -> list:
    """The policies that a folder holds, as functions of observations [batch, size], by code of others."""
    index = json.loads((folder / "policies.json").read_text())
    if format == "numpy":
        loaded = numpy_file.read(folder)
        return [loaded[name] for name in names]
    files = [folder / agent["file"] for agent in index["agents"]]
    each = [onnx_file.runner(file)[0] if format == "onnx" else saved_function.read(file) for file in files]
    return [lambda x, run=run: np.asarray(run(x)["action"]) for run in each]


@pytest.mark.parametrize("format", FORMATS)
def test_they_play_the_run_s_evaluations(case, format, tmp_path):
    """Whole episodes with the files' actions in place of the policies': the same returns."""
    if format == "onnx":
        pytest.importorskip("onnx")
    training, saved = case
    found = export(training, saved, 4, format, tmp_path / "out")
    assert found.difference < 1e-5 and {p.name for p in tmp_path.iterdir()} == {"out"}
    env, names = training.env, training.layout.agents
    run = runners(found.folder, format, names)
    wanted = training.evaluate(saved.state, 3, deterministic=True).episode_return[1]
    key = jax.random.fold_in(jax.random.key(0), 2**31 - 1)
    state_key, _ = jax.random.split(key)
    state, observation = jax.vmap(env.reset)(jax.random.split(state_key, 3))
    step = jax.jit(jax.vmap(env.step))
    total = np.zeros((3, len(names)))
    for _ in range(env.episode_length):
        actions = tuple(np.asarray(one(np.asarray(seen))) for one, seen in zip(run, observation, strict=True))
        after = step(jax.random.split(key, 3), state, actions)
        state, observation, total = after.state, after.observation, total + np.asarray(after.reward, float)
    np.testing.assert_allclose(total, wanted, rtol=2e-3, atol=2e-3)


def test_their_facts_say_what_they_take_and_give(case, tmp_path):
    training, saved = case
    export(training, saved, 3, "numpy", tmp_path / "out")
    index = json.loads((tmp_path / "out" / "policies.json").read_text())
    assert index["seed"] == 3 and index["step"] == 120 and index["settings"] == training.config.to_dict()
    assert index["checked"]["observations"] == 1000 and index["checked"]["tolerance"] == 1e-5
    for agent, name, size, space in zip(
        index["agents"], training.env.agents, training.env.observation_sizes, training.env.action_spaces, strict=True
    ):
        assert agent["name"] == name and agent["observation"]["shape"] == ["batch", size]
        assert agent["action"]["shape"] == ["batch", *space.shape]
        assert len(agent["action"]["entries"]) == space.size
        entries = agent["observation"]["entries"]
        assert entries is None or len(entries) == size


def test_a_joint_policy_says_whom_it_moves(tmp_path):
    training, saved = untrained(CASES["one for its team"])
    export(training, saved, 3, "numpy", tmp_path / "out")
    joint, alone = json.loads((tmp_path / "out" / "policies.json").read_text())["agents"]
    assert joint["members"] == ["adversary_0", "adversary_1", "adversary_2"] and "members" not in alone
    assert joint["members_action_sizes"] == [5, 5, 5] and joint["action"]["entries"][5] == "adversary_1: stay"


def test_large_ranges_and_any_number_of_rows(tmp_path):
    """Actions of a Box that is not [-1, 1]; 1, 7 and 600 rows, one row at a time by the NumPy reader."""
    training, saved = untrained(["env=simple_speaker_listener", "env.actions=continuous", "env.rules=mpe2"])
    for format in ("numpy", "saved_fn"):
        export(training, saved, 3, format, tmp_path / format)
    reader = numpy_file.read(tmp_path / "numpy")["listener_0"]
    run = saved_function.read(tmp_path / "saved_fn" / "listener_0.saved_fn")
    x = np.random.default_rng(1).normal(size=(600, 11)).astype(np.float32)
    for rows in (1, 7, 600):
        np.testing.assert_allclose(run(x[:rows])["action"], reader(x[:rows]), atol=1e-5)
    np.testing.assert_allclose(reader(x[5]), reader(x)[5], atol=1e-6)
    assert 0 <= reader(x).min() < 0.3 and 0.7 < reader(x).max() <= 1


def test_the_reader_is_thirty_lines_and_needs_numpy_alone(tmp_path):
    training, saved = untrained(CASES["choices"])
    export(training, saved, 3, "numpy", tmp_path / "out")
    reader = tmp_path / "out" / "read_policies.py"
    assert len(reader.read_text().splitlines()) <= 30
    code = (
        "import sys, numpy; before = set(sys.modules); sys.path.insert(0, sys.argv[1]); import read_policies\n"
        "p = read_policies.load(sys.argv[1] + '/policies.npz')['agent_1']; print(p(numpy.zeros(21)).tolist())\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('jax', 'flax', 'matd3_jax', 'scipy', 'onnx')])"
    )
    done = subprocess.run([sys.executable, "-c", code, str(reader.parent)], capture_output=True, text=True)
    expected = function(training.layout, policy_of(training, saved, 0), 1)(jnp.zeros((1, 21)))["action"][0]
    assert done.stdout.splitlines() == [str(expected.tolist()), "[]"], done.stderr


def test_saved_functions_need_jax_alone(tmp_path):
    training, saved = untrained(CASES["tanh"])
    export(training, saved, 3, "saved_fn", tmp_path / "out")
    code = (
        "import sys; from jax import export; import numpy\n"
        "f = export.deserialize(bytearray(open(sys.argv[1], 'rb').read()))\n"
        "print(f.call(numpy.ones((5, 6), 'float32'))['action'].shape, 'matd3_jax' in sys.modules, f.platforms[:2])"
    )
    path = tmp_path / "out" / "agent_1.saved_fn"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert done.stdout == "(5, 2) False ('cpu', 'cuda')\n", done.stderr


def policy_of(training, saved, place):
    return jax.tree.map(lambda leaf: leaf[place], training.trainer.policy(saved.state, average=True))


def test_onnx_models_have_names_shapes_and_facts(tmp_path):
    onnx = pytest.importorskip("onnx")
    training, saved = untrained(CASES["choices"])
    export(training, saved, 3, "onnx", tmp_path / "out")
    model = onnx.load(tmp_path / "out" / "agent_0.onnx")
    assert [i.name for i in model.graph.input] == ["observation"]
    assert [o.name for o in model.graph.output] == ["action", "probabilities"]
    facts = {one.key: json.loads(one.value) for one in model.metadata_props}
    assert facts["name"] == "agent_0" and facts["environment"]["name"] == "simple_reference" and facts["step"] == 120
    assert facts["action"]["entries"][:2] == ["stay", "push -x"] and facts["action"]["entries"][5] == "say 0"


def test_what_a_choice_s_names_say_is_what_it_does():
    """Each option alone for one env step."""
    for lines in (["env.actions=soft"], ["env.actions=discrete"], ["env.actions=continuous", "env.rules=mpe2"]):
        env = TrainingSession(config.load(["env=simple_spread", "env.num_agents=1", *lines, *SMALL])).env
        state, _ = env.reset(jax.random.key(0))
        for k, name in enumerate(env.action_names[0]):
            action = jnp.int32(k) if "discrete" in lines[0] else jax.nn.one_hot(k, 5)
            moved = np.sign(np.asarray(env.step(jax.random.key(0), state, (action,)).state.vel[0]))
            way = {"stay": (0, 0), "push +x": (1, 0), "push -x": (-1, 0), "push +y": (0, 1), "push -y": (0, -1)}[name]
            assert tuple(moved) == way, (lines, name)


# ---- what is not written ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["numpy", "onnx"])
def test_a_file_that_differs_is_an_error_and_nothing_is_left(format, tmp_path, monkeypatch):
    """By 1e-4 in one bias: too little to see in an episode."""
    if format == "onnx":
        pytest.importorskip("onnx")
    training, saved = untrained(CASES["sigmoid"])
    whole = write.perceptron

    def wrong(*args):
        found = whole(*args)
        return dataclasses.replace(found, biases=(*found.biases[:-1], found.biases[-1] + np.float32(1e-4)))

    monkeypatch.setattr(write, "perceptron", wrong)
    with pytest.raises(UserError, match="the exported policy of agent_0 differs from the trained one by [0-9.]+e-05"):
        export(training, saved, 3, format, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_another_choice_is_a_difference_unless_two_are_as_likely():
    space = TrainingSession(config.load(["env=simple_spread", "env.actions=discrete", *SMALL])).env.action_spaces[0]
    soft = np.array([[0.6, 0.4, 0, 0, 0], [0.4, 0.4 - 5e-6, 0.2, 0, 0]], np.float32)
    first, second = np.array([0, 0], np.int32), np.array([0, 1], np.int32)
    assert compare.difference(space, second, first, soft, soft) == 0
    assert compare.difference(space, second[::-1], first, soft, soft) == np.inf
    assert compare.difference(space, first, first, soft + 1e-3, soft) == pytest.approx(1e-3, rel=1e-3)
    assert compare.difference(space, first, first, soft * np.nan, soft) == np.inf


class Residual(nn.Module):
    """A network that is none of the family's."""

    features: tuple[int, ...]

    @nn.compact
    def __call__(self, x):
        y = nn.Dense(self.features[0])(x)
        return nn.Dense(self.features[-1])(nn.relu(y + nn.Dense(self.features[0])(nn.relu(y))))


def test_a_network_of_one_s_own(tmp_path, monkeypatch):
    """Saved functions hold it; the other formats say that they do not."""

    def features(group):
        return (*group.algorithm.hidden, group.action_space.size)

    stacked = nn.vmap(Residual, variable_axes={"params": 0}, split_rngs={"params": True})
    monkeypatch.setattr(agents.Group, "actor", property(lambda group: Residual(features(group))))
    monkeypatch.setattr(agents.Group, "actors", property(lambda group: stacked(features(group))))
    training, saved = untrained(CASES["sigmoid"])
    found = export(training, saved, 3, "saved_fn", tmp_path / "out")
    assert found.difference < 1e-5
    with pytest.raises(UserError, match="the actor of agent_0 is a Residual: format=saved_fn holds any network"):
        export(training, saved, 3, "numpy", tmp_path / "other")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_missing_library_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert command.code(lambda argv: command.start("export", argv), ["run=nowhere", "format=onnx"]) == 2
    assert capsys.readouterr().err == "error: format=onnx needs onnx: pip install 'matd3_jax[export]'\n"


def test_without_onnxruntime_onnx_s_own_implementation_compares(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    training, saved = untrained(CASES["choices"])
    found = export(training, saved, 3, "onnx", tmp_path / "out")
    assert "reference implementation" in found.checked_by and found.difference < 1e-5


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    lines = [text for text in SMALL if text != "eval_every=0"]
    assert train.main(["env=point_reach", *lines, "algo.hidden=[8]", f"out={out}", "name=a", "eval_every=50"]) == 0
    return out / "a"


def test_the_command_writes_the_best(run, capsys):
    assert command.start("export", [f"run={run}", "format=numpy", "which=best", "seed=4"]) == 0
    folder = run / "export" / "seed_4-best-numpy"
    assert f"{folder}: policies.json, policies.npz, read_policies.py" in capsys.readouterr().out
    facts = json.loads((folder / "policies.json").read_text())
    assert facts["kept_at"] == "best evaluation" and facts["best_evaluation"]["step"] == facts["step"]
    with pytest.raises(UserError, match="something is there already"):
        command.start("export", [f"run={run}", "format=numpy", "checkpoint=best", f"out={folder}"])


BAD = {
    "format=x": "format=x", "seed=9 format=numpy": "seed=9", "which=first format=numpy": "which=first",
    "which=best checkpoint=100 format=numpy": "which=best", "checkpoint=7 format=numpy": "no checkpoint of step 7",
    "": "format=",
}  # fmt: skip


@pytest.mark.parametrize("words", BAD)
def test_what_cannot_be_is_one_line(run, words, tmp_path, capsys):
    argv = [f"run={run}", f"out={tmp_path / 'out'}", *words.split()]
    assert command.code(lambda argv: command.start("export", argv), argv) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and BAD[words] in said and not list(tmp_path.iterdir())


def test_decide_is_what_evaluations_play(run):
    """What exported policies are compared with is the code that evaluations run."""
    training, saved = untrained(CASES["sigmoid"])
    policy = policy_of(training, saved, 0)
    seen = compare.observations(training, policy)
    assert seen.shape == (1000, training.layout.observation_size) and len(np.unique(seen, axis=0)) == 1000
    parts = [training.layout.observation_part(seen, i) for i in range(2)]
    played, _ = acting.decide(training.layout, policy, parts, None)
    for one, other in zip(compare.wanted(training, policy, seen), played, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
