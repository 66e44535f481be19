"""Settings: what the files say, what overrides do, and one clear line for every mistake."""

import dataclasses
import json

import jax
import pytest

from matd3_jax import config, envs
from matd3_jax.errors import UserError
from matd3_jax.training import memory
from matd3_jax.training.session import TrainingSession

PAPER = {
    "actor_lr": 0.01,
    "critic_lr": 0.01,
    "gamma": 0.95,
    "tau": 0.01,
    "hidden": (64, 64),
    "clip": "variable",
    "max_grad_norm": 0.5,
    "logit_regularizer": 1e-3,
    "target_noise": 0.0,
    "target_noise_clip": 0.5,
}
MINIMAX = {"m3ddpg", "m3matd3"}
FAMILY = {  # joint, critic, number of critics, policy delay
    "matd3": (False, "central", 2, 2),
    "maddpg": (False, "central", 1, 1),
    "iltd3": (False, "own", 2, 2),
    "iddpg": (False, "own", 1, 1),
    "td3": (True, "own", 2, 2),
    "ddpg": (True, "own", 1, 1),
    "m3ddpg": (False, "central", 1, 1),
    "m3matd3": (False, "central", 2, 2),
    "hybrid": (True, "central", 2, 2),
}


@pytest.mark.parametrize("name", FAMILY)
def test_every_algorithm_has_the_papers_settings(name):
    algo = config.load([f"algo={name}"]).algo
    assert (algo.joint, algo.critic, algo.num_critics, algo.policy_delay) == FAMILY[name]
    assert {key: getattr(algo, key) for key in PAPER} == PAPER
    assert algo.name == name and algo.hands_over == (name == "hybrid")
    steps = (1e-3, 1e-5) if name in MINIMAX else (0, 0)  # adv-eps and adv-eps-s of the authors of M3DDPG
    assert (algo.adversarial_step, algo.adversarial_step_team) == steps and algo.adversarial == (name in MINIMAX)


def test_the_default_schedule_is_the_papers():
    settings = config.load()
    assert settings.num_envs * settings.rollout_length == 100 and settings.updates_per_collect == 1
    assert (settings.batch_size, settings.replay_capacity, settings.learning_starts) == (1024, 1_000_000, 25_600)
    assert settings.total_steps == 60_000 * 25
    trainer = TrainingSession(settings).trainer
    # 2,245 updates by env step 250,000 (the authors' program), counted through this project's own schedule.
    assert trainer.updates(250_000 // 100) == 2245


@pytest.mark.parametrize("name", [n for n in envs.names()])
def test_every_environment_has_a_file_that_lists_its_options_and_defaults(name):
    env = dict(config.load([f"env={name}"]).env)
    assert env.pop("name") == name
    defaults = dict(envs.options(name))
    if "physics" in defaults:
        assert defaults["physics"] == "auto"
        defaults["physics"] = "c"  # what a CPU gets; that the file has "auto" is tested below
    assert env == defaults


def test_files_of_algorithms_and_environments_are_all_known():
    assert set(config.known_names("algo")) == set(FAMILY)
    assert set(config.known_names("env")) == set(envs.names())


def test_adversary_takes_a_file_of_its_own():
    settings = config.load(["env=simple_tag", "algo=matd3", "adversary=maddpg", "algo.lr=0.003"])
    teams = settings.teams()
    assert (teams["agents"].name, teams["adversaries"].name) == ("matd3", "maddpg")
    assert (teams["agents"].actor_lr, teams["adversaries"].actor_lr) == (0.003, 0.01)


def test_adversary_values_alone_keep_the_algorithm_and_its_other_values():
    settings = config.load(["env=simple_tag", "algo=iltd3", "algo.tau=0.02", "adversary.lr=0.001"])
    assert settings.adversary == dataclasses.replace(settings.algo, actor_lr=0.001, critic_lr=0.001)
    assert settings.algo.tau == 0.02


def test_without_adversary_both_teams_share_all_values():
    teams = config.load(["env=simple_tag", "algo.lr=0.003"]).teams()
    assert teams["agents"] == teams["adversaries"]


def test_lr_sets_both_and_either_can_be_set():
    algo = config.load(["algo.lr=0.1", "algo.critic_lr=0.2"]).algo
    assert (algo.actor_lr, algo.critic_lr) == (0.1, 0.2)


def test_written_settings_read_back_the_same(tmp_path):
    settings = config.load(["env=simple_tag", "adversary=iddpg", "algo.hidden=[8]", "total_steps=1e6"])
    config.write(settings, tmp_path / "config.yaml")
    assert config.read(tmp_path / "config.yaml") == settings


def test_settings_of_a_run_from_before_a_key_mean_what_they_meant(tmp_path):
    """Such a run had no evaluations on the way: its table has no columns for them, and must get none on resume."""
    old = config.load(["eval_every=0"])
    keys = set(config.ADDED_LATER) - {"algo", "adversary"}
    kept = {key: value for key, value in old.to_dict().items() if key not in keys}
    kept["algo"] = {key: value for key, value in kept["algo"].items() if key not in config.ADDED_LATER["algo"]}
    (tmp_path / "config.yaml").write_text(json.dumps(kept))  # JSON is YAML
    assert config.read(tmp_path / "config.yaml") == old


@pytest.mark.parametrize(
    ("name", "option", "other"),
    [
        ("simple_speaker_listener", "speaking_steps", 3),
        ("humanoid", "velocities", False),
        ("brax_ant", "velocities", False),
    ],
)
def test_runs_from_before_an_option_of_their_environment(name, option, other, tmp_path):
    """They had its default, so that they belong to those of today that have it."""
    settings = config.load([f"env={name}"])
    old = settings.to_dict()
    del old["env"][option]
    (tmp_path / "config.yaml").write_text(json.dumps(old))
    assert config.read(tmp_path / "config.yaml") == settings
    old["env"][option] = other
    (tmp_path / "config.yaml").write_text(json.dumps(old))
    assert config.read(tmp_path / "config.yaml").env[option] == other


def test_keys_have_had_other_names(tmp_path):
    """Runs from before are read; who writes an old name is given the new one."""
    settings = config.load(["env=simple_tag", "adversary=maddpg", "normalize_observations=true"])
    old = settings.to_dict()
    old["normalise_observations"] = old.pop("normalize_observations")
    old["normalise_least_deviation"] = old.pop("normalize_least_deviation")
    for team in ("algo", "adversary"):
        old[team]["logit_regulariser"] = old[team].pop("logit_regularizer")
    (tmp_path / "config.yaml").write_text(json.dumps(old))
    assert config.read(tmp_path / "config.yaml") == settings
    with pytest.raises(UserError, match="it is called 'algo.logit_regularizer' now"):
        config.load(["algo.logit_regulariser=0"])


@pytest.mark.parametrize(
    ("before", "now"), [("exact", "mjx"), ("fast", "mjx_fast"), ("mjx", "mjx"), ("mjx_fast", "mjx_fast"), ("c", "c")]
)
def test_a_run_keeps_its_engine_under_its_new_name(before, now, tmp_path):
    settings = config.load(["env=hopper", "env.physics=mjx"])
    old = settings.to_dict()
    old["env"]["physics"] = before
    (tmp_path / "config.yaml").write_text(json.dumps(old))
    found = config.read(tmp_path / "config.yaml")
    assert found.env["physics"] == now
    assert found == dataclasses.replace(settings, env={**settings.env, "physics": now})


@pytest.mark.parametrize("name", ["ant", "half_cheetah", "hopper", "walker2d", "humanoid", "swimmer"])
def test_auto_is_resolved_once_for_the_run(name, tmp_path, monkeypatch):
    settings = config.load([f"env={name}"])
    assert settings.env["physics"] == "c"
    config.write(settings, tmp_path / "config.yaml")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert config.load([f"env={name}"]).env["physics"] == "mjx"
    assert config.read(tmp_path / "config.yaml").env["physics"] == "c"


def test_a_new_run_is_given_the_engines_new_name():
    with pytest.raises(UserError, match=r"^env\.physics='fast': must be one of .* it is called 'mjx_fast' now$"):
        config.load(["env=ant", "env.physics=fast"])


MISTAKES = {
    "algo.adversarial_step=-1": "algo.adversarial_step=-1.0: must not be negative",
    "algo=mad3": "matd3",
    "env=simple_sprad": "simple_spread",
    "adversary=madpg": "maddpg",
    "algo.lrr=1": "'lr'",
    "lr=0.1": "'algo.lr'",
    "rules=mpe2": "'env.rules'",
    "algo.batch_size=2": "'batch_size'",
    "env.rles=orig": "'rules'",
    "totalsteps=3": "'total_steps'",
    "seeds=0": "seeds=0",
    "seeds=1.5": "seeds=1.5",
    "seeds=-1": "seeds=-1",
    "seed=-1": "seed=-1",
    "seeds=true": "seeds=True",
    "seeds=": "seeds",
    "seeds": "key=value",
    "seeds=1,2": "one value",
    "algo.lr=fast": "fast",
    "algo.lr=0": "algo.actor_lr=0",
    "algo.lr=nan": "nan",
    "algo.gamma=1.1": "gamma",
    "algo.tau=-1": "tau",
    "algo.policy_delay=0": "policy_delay=0",
    "algo.num_critics=0": "num_critics=0",
    "algo.hidden=64": "hidden",
    "algo.hidden=[0]": "hidden",
    "algo.clip=global": "variable, network, none",
    "algo.critic=joint": "central, own",
    "algo.actor=lstm": "mlp, gru",
    "algo.critic_norm=batch": "none, layer",
    "algo.critic_head=gaussian": "scalar, categorical, quantile",
    "algo.target_critics=3": "algo.num_critics=2",
    "algo.target_critics=0": "at least 1",
    "algo.actor_critics=min": "first, all",
    "algo.dropped_quantiles=-1": "must not be negative",
    "algo.critic_head=categorical": "algo.critic_range=[low,high]",
    "algo.critic_range=[5,5]": "below the second",
    "algo.critic_range=[0,inf]": "finite",
    "algo.critic_range=9": "[low,high]",
    "algo.critic_atoms=1": "at least 2",
    "update_order=random": "simultaneous, sequential",
    "warmup=none": "policy, random",
    "updates_per_collect=3": "policy_delay=2",
    "updates_per_collect=0": "updates_per_collect=0",
    "batch_size=2000000": "replay_capacity",
    "replay_capacity=25650": "multiple",
    "replay_capacity=1000": "larger than replay_capacity",
    "learning_starts=0": "learning_starts=0",
    "total_steps=1000": "learning_starts",
    "total_steps=0": "total_steps=0",
    "n_step=0": "n_step=0",
    "n_step=250001": "n_step=250001 is more than the 250000 env steps",
    "log_every=0": "log_every",
    "eval_every=-1": "eval_every=-1",
    "eval_episodes=0": "eval_episodes=0",
    "keep_checkpoints=0": "keep_checkpoints=0",
    "algo.lr=${nothing}": "nothing",
    "=3": "key",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_every_mistake_gives_one_line_that_names_it(text):
    with pytest.raises(UserError) as error:
        config.load([text])
    assert MISTAKES[text] in str(error.value)
    assert "\n" not in str(error.value)


def test_a_target_needs_some_quantiles():
    settings = ["algo.critic_head=quantile", "algo.dropped_quantiles=25"]
    with pytest.raises(UserError, match=r"^algo\.dropped_quantiles=25 leaves none of algo\.critic_quantiles=25$"):
        config.load(settings)
    assert config.load([*settings, "algo.critic_quantiles=26"]).algo.dropped_quantiles == 25


@pytest.mark.parametrize("key", ["adversarial_step", "adversarial_step_team"])
def test_who_does_not_see_the_others_cannot_fear_them(key):
    with pytest.raises(UserError, match=rf"^adversary\.{key}=0\.1 needs adversary\.critic=central: iltd3's critics do"):
        config.load(["env=simple_tag", "adversary=iltd3", f"adversary.{key}=0.1"])
    assert config.load(["env=simple_tag", "adversary=iltd3", f"algo.{key}=0.1"]).algo.adversarial


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        (["adversary=maddpg"], "no adversaries"),
        (["env.rules=mpe"], "rules"),
        (["env.num_agents=0"], "num_agents"),
        (["env.local_ratio=0.5"], "local_ratio"),
    ],
)
def test_what_the_environment_does_not_take_is_named(overrides, names):
    with pytest.raises(ValueError, match=names):
        TrainingSession(config.load(overrides))


def test_a_replay_that_cannot_fit_is_refused_with_the_arithmetic():
    training = TrainingSession(config.load(["seeds=20000", "total_steps=2000000"]))
    with pytest.raises(UserError, match=r"20000 seeds x 1,000,000 transitions x 127 numbers x 4 bytes = 10160.00 GB"):
        training.check_memory()


def test_several_steps_need_one_number_more():
    one, three = (TrainingSession(config.load([f"n_step={n}", "total_steps=100000"])) for n in (1, 3))
    assert (one.layout.row_size, three.layout.row_size) == (127, 128)
    said = [memory.of_replay(session.trainer, session.processes) for session in (one, three)]
    assert "more" not in said[0] and "x 128 numbers" in said[1] and "rewards 3, more 1," in said[1]


def test_recurrent_networks_need_their_states():
    session = TrainingSession(config.load(["algo.actor=gru", "algo.gru_units=7", "total_steps=100000"]))
    assert session.layout.row_size == 127 + 1 + 3 * 7
    said = memory.of_replay(session.trainer, session.processes)
    assert "x 149 numbers" in said and "rewards 3, more 1, states 21, x' 54" in said


def test_a_short_run_allocates_no_rows_it_would_never_write():
    training = TrainingSession(config.load(["seeds=2", "total_steps=100000"]))
    assert training.trainer.schedule.replay_capacity == training.total_steps < 101_000
    assert training.trainer.replay_bytes == 2 * training.total_steps * 127 * 4


@pytest.mark.parametrize(("before", "now"), [(True, ("csv", "tensorboard")), (False, ("csv",))])
def test_loggers_of_a_run_from_before_the_list(before, now, tmp_path):
    """It had `tensorboard`; who writes that is told of the list."""
    old = config.load().to_dict()
    for key in ("logger", "logger_seeds", "wandb", "mlflow", "video_every"):
        del old[key]
    (tmp_path / "config.yaml").write_text(json.dumps({**old, "tensorboard": before}))
    assert config.read(tmp_path / "config.yaml") == dataclasses.replace(config.load(), logger=now)
    with pytest.raises(UserError, match=r"no key 'tensorboard'; it is logger=\[csv,tensorboard\] now"):
        config.load(["tensorboard=true"])


@pytest.mark.parametrize(
    ("given", "found"),
    [("[]", "csv"), ("wandb", "csv,wandb"), ("[mlflow,wandb,mlflow]", "csv,wandb,mlflow"), ("[csv]", "csv")],
)
def test_the_table_is_always_among_the_loggers(given, found):
    assert ",".join(config.load([f"logger={given}"]).logger) == found


def test_merge_replaces_settings_of_the_same_keys():
    """However an override is marked, and with several values, as a sweep has them; what it replaces goes."""
    usual = ["env=ant", "algo.lr=0.1", "env.split='4x2'", "seeds=2", "name=algo.lr=1"]
    assert config.merge(usual, []) == usual
    found = config.merge(usual, ["algo.lr=0.01,0.001", "++seeds=3", "env.split=2x4", "tau=1"])
    assert found == ["env=ant", "name=algo.lr=1", "algo.lr=0.01,0.001", "++seeds=3", "env.split=2x4", "tau=1"]
    with pytest.raises(UserError, match="cannot read 'algo.lr'"):
        config.merge(usual, ["algo.lr"])
