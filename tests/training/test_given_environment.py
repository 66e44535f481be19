"""Runs whose environment is given as an object: its options are kept, compared, and not given twice."""

import dataclasses

import numpy as np
import pytest

import matd3_jax
from matd3_jax import envs
from matd3_jax.cli import check, evaluate
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.errors import OptionError, UserError
from matd3_jax.export.numpy_reader import load as read_policies
from matd3_jax.runs import alike
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training.given_environment import LONGEST, check_same, recorded

SMALL = {
    "seeds": 1, "num_envs": 2, "rollout_length": 5, "total_steps": 300, "learning_starts": 100, "batch_size": 16,
    "log_every": 100, "eval_every": 0,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Options(PointReach):
    """Values that settings have, and others."""

    words: tuple[str, ...] = ("a", "b")
    number: float = np.float64(0.5)
    other: object = None
    nested: object = envs.make("point_reach")
    name: str = "mine"


def test_what_is_kept_of_an_object():
    found, inherited = recorded(Options()), recorded(PointReach())
    assert found.pop("nested").startswith("PointReach(")
    assert found == {**inherited, "name": "Options", "words": ["a", "b"], "number": 0.5, "other": None}
    assert type(found["number"]) is float
    for other in (object(), lambda: 0, "${x", "x" * (LONGEST + 1), (object(),)):
        assert "other" not in recorded(Options(other=other))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "five"
    env = envs.make("point_reach", episode_length=5)
    return matd3_jax.train("algo.hidden=[8]", "algo.policy_delay=1", env=env, run_dir=path, **SMALL)


def test_runs_with_other_options_are_no_seeds_of_one_setting(run):
    settings = RunDirectory.open(run.run_dir)[1]
    assert settings.env["name"] == "PointReach" and settings.env["episode_length"] == 5
    other = dataclasses.replace(settings, seed=7, env={**settings.env, "episode_length": 6})
    path = run.run_dir.parent / "six"
    RunDirectory.create(path, other, {})
    assert len(alike.groups([run.run_dir, path])) == 2


def test_it_goes_on_with_the_same_options_alone(run):
    six = envs.make("point_reach", episode_length=6)
    with pytest.raises(UserError, match="five: env.episode_length=5 there, 6 here$"):
        matd3_jax.resume(run.run_dir, env=six, total_steps=500)
    with pytest.raises(UserError, match="five: env.name=PointReach there, SimplePush here$"):
        matd3_jax.resume(run.run_dir, env=envs.make("simple_push"), total_steps=500)
    with pytest.raises(UserError, match=r"as an object: give env=PointReach\(\.\.\.\)$"):
        matd3_jax.resume(run.run_dir, total_steps=500)
    longer = matd3_jax.resume(run.run_dir, env=envs.make("point_reach", episode_length=5), total_steps=500)
    assert longer.metrics["step"][0, -1] >= 500


def test_of_older_runs_the_name_is_compared():
    check_same({"name": "PointReach"}, envs.make("point_reach", episode_length=6), "old")
    with pytest.raises(UserError, match="^old has its environment, simple_tag, by name: leave env= out$"):
        check_same({"name": "simple_tag"}, envs.make("simple_tag"), "old")
    check_same({"name": "simple_tag"}, None, "old")


@pytest.mark.parametrize("given", [["env.episode_length=7"], ["env={episode_length:7}"]])
def test_options_beside_an_object_are_refused(given):
    with pytest.raises(UserError, match="env= is an object, which has its options already"):
        matd3_jax.train(*given, env=envs.make("point_reach"), **SMALL)


def test_its_policies_are_exported(run, tmp_path):
    exported = run.export(tmp_path / "out")
    agents = read_policies(exported.folder / "policies.npz")
    observation = np.zeros(run.training.layout.observation_sizes[0], np.float32)
    assert np.isfinite(next(iter(agents.values()))(observation)).all()
    with pytest.raises(UserError, match="^seed=3: the seeds of the run are 0 to 0$"):
        run.export(tmp_path / "other", seed=3)


def test_errors_of_options_are_the_user_s_to_mend():
    with pytest.raises(UserError, match="no environment is called"):
        envs.make("simple_spred")
    assert issubclass(OptionError, UserError)


def test_commands_say_where_such_a_run_goes_on(run, capsys):
    assert check.main([f"run={run.run_dir}"]) == 0
    line = rf"finished; train it on from Python: matd3_jax.resume('{run.run_dir}', env=PointReach(...), total_steps=N)"
    assert capsys.readouterr().out.splitlines()[-1] == line
    with pytest.raises(
        UserError, match="^no environment is called 'PointReach': one that was given as an object takes"
    ):
        evaluate.main([f"run={run.run_dir}"])


@pytest.mark.parametrize("setting", ["name=x", "checkpoint_every=100", "video_every=100", "logger=tensorboard"])
def test_without_a_directory_nothing_is_left(setting):
    with pytest.raises(UserError, match=r"needs a run directory: give run_dir=$"):
        matd3_jax.train(setting, env="point_reach", **SMALL)
