"""What the fields of the settings say of themselves, against what the settings do."""

import dataclasses

import pytest

from matd3_jax import config
from matd3_jax.config import AlgoConfig, Config, DiagnosticsConfig, MlflowConfig, WandbConfig, schema
from matd3_jax.config.schema import Affects
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.errors import UserError
from matd3_jax.sweep import batching

SCHEMAS = (Config, AlgoConfig, DiagnosticsConfig, MlflowConfig, WandbConfig)
OTHER = {  # another value of each setting of an algorithm
    "name": "other",
    "joint": True,
    "critic": "own",
    "num_critics": 3,
    "policy_delay": 3,
    "hidden": (8,),
    "clip": "none",
    "adam": "epsilon_hat",
    "actor_output": "tanh",
    "target_noise": 0.3,
    "sync_targets": False,
    "actor": "gru",
    "gru_units": 9,
    "critic_norm": "layer",
    "critic_head": "categorical",
    "critic_atoms": 11,
    "critic_range": (-1.0, 2.0),
    "target_critics": 1,
    "actor_critics": "all",
    "critic_quantiles": 9,
    "dropped_quantiles": 3,
}


@pytest.mark.parametrize("cls", SCHEMAS)
def test_every_field_says_what_it_affects_and_has_no_default(cls):
    for field in dataclasses.fields(cls):
        assert isinstance(field.metadata["affects"], Affects), field.name
        assert field.default is field.default_factory is dataclasses.MISSING, f"{field.name}: defaults are in YAML"
        bookkeeping = field.metadata["affects"] is Affects.BOOKKEEPING
        assert bookkeeping or not (field.metadata["splits"] or field.metadata["reported"]), field.name


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(AlgoConfig)])
def test_what_a_setting_of_an_algorithm_affects(name):
    """Numbers go to the hyper-parameters, all else to the shape: as `core` has them."""
    # With smoothing and a step of the others, so that their lengths are numbers.
    algo = dataclasses.replace(config.load().algo, target_noise=0.1, adversarial_step=0.1)
    other = dataclasses.replace(algo, **{name: OTHER.get(name, 0.4321)})
    learning = name in schema.HYPER_PARAMS
    # What a frozen team begins with and which phases a run has, not what is computed.
    if name in ("hands_over", "handover", "distillation_updates") or (
        name.startswith("policy") and name != "policy_delay"
    ):
        assert other.algorithm() == algo.algorithm() and not learning
        return
    assert (other.hyper_params() != algo.hyper_params()) == learning
    assert (other.algorithm() != algo.algorithm()) == (not learning)
    assert not learning or name in HyperParams._fields


def test_programs_are_split_by_shapes_and_by_what_their_interval_does():
    base = config.load(["seeds=2", "total_steps=50000"])
    alike = {
        "seeds": 3,
        "seed": 7,
        "name": "a",
        "out": "b",
        "checkpoint_every": 1,
        "checkpoint_minutes": 3.0,
        "keep_checkpoints": 9,
        "logger": ("csv", "wandb"),
        "logger_seeds": "bands",
        "wandb": config.WandbConfig("project", None, "offline"),
        "mlflow": config.MlflowConfig(None, "experiment"),
        "video_every": 5,
    }
    assert set(alike) == set(schema.UNSHARED)
    assert {batching.program(dataclasses.replace(base, **{k: v})) for k, v in alike.items()} == {batching.program(base)}
    for name in set(schema.keys(Config)) - set(alike) - {"env", "algo", "adversary", "diagnostics"}:
        assert batching.program(dataclasses.replace(base, **{name: "other"})) != batching.program(base), name


def test_lists_that_follow_from_the_fields():
    assert set(schema.RECORDS) == {
        "total_steps", "name", "out", "log_every", "eval_every", "eval_episodes", "diagnostics", "checkpoint_every",
        "checkpoint_minutes", "keep_checkpoints", "logger", "logger_seeds", "wandb", "mlflow", "video_every",
        "on_divergence",
    }  # fmt: skip
    # What a table says of a seed depends on how long the run was and how it was evaluated.
    reported = {"total_steps", "eval_every", "eval_episodes", "diagnostics"}
    assert set(schema.UNREPORTED) == set(schema.RECORDS) - reported | {"seed", "seeds"}
    of_teams = [f"{team}.{name}" for team in ("algo", "adversary") for name in ("policy", "policy_checkpoint")]
    assert schema.TEXTS == ("init", "init_checkpoint", "name", "out", *of_teams)


@pytest.mark.parametrize(
    "text",
    [
        "1e3", "true", "null", "007", "a b", "a=b", "a,b", "[a,b]", "{a: b}", "it's", '"a"', "naïve ü 日本", "${x}",
        "a\\", "#1", "-",
    ],
)  # fmt: skip
def test_texts_are_taken_as_they_are_typed(text, tmp_path):
    settings = config.load([f"name={text}", f"out={text}/runs", "seeds=3"])
    assert (settings.name, settings.out, settings.seeds) == (text, f"{text}/runs", 3)
    config.write(settings, tmp_path / "config.yaml")
    assert config.read(tmp_path / "config.yaml") == settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("out=", "^out=: must name a directory$"),
        ("name=${a", r"^name=\${a: must not hold an unfinished"),
        ("+name=a", "the key is there"),
        ("algo.hidden=[8,0]", r"^algo.hidden=\[8, 0\]: each must be at least 1$"),
        ("algo.exploration_noise=[0.4,0.1]", "must not end below its start"),
        ("algo.exploration_noise=[-0.1,0.1]", "must not be negative"),
        ("algo.critic_range=[-1,inf]", r"^algo.critic_range=\[-1.0, inf\]: each must be finite$"),
        ("algo.exploration_noise=inf", "must not be negative"),
        ("seed=3000000000", "^seed=3000000000: must lie between 0 and 2147483647$"),
        ("resum=a", "did you mean"),
    ],
)
def test_values_that_are_not_allowed(text, message):
    with pytest.raises(UserError, match=message):
        config.load([text], known=("resume",))
