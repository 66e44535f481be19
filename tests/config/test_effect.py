"""Settings that count only beside another are refused alone, and taken where they count in one of some settings."""

import pytest

import matd3_jax
from matd3_jax import config
from matd3_jax.cli import sweep, train
from matd3_jax.config import effect
from matd3_jax.errors import UserError

PAIRS = [
    ("algo.gru_units=8", "algo.actor=gru", "algo.actor=gru"),
    ("sequence_length=8", "algo.actor=gru", "algo.actor=gru"),
    ("burn_in=4", "algo.actor=gru", "algo.actor=gru"),
    ("algo.critic_atoms=21", "algo.critic_head=categorical algo.critic_range=[-9,9]", "algo.critic_head=categorical"),
    ("algo.critic_range=[-9,9]", "algo.critic_head=categorical", "algo.critic_head=categorical"),
    ("algo.critic_quantiles=5", "algo.critic_head=quantile", "algo.critic_head=quantile"),
    ("algo.dropped_quantiles=1", "algo.critic_head=quantile", "algo.critic_head=quantile"),
    ("algo.distillation_updates=9", "algo=hybrid algo.handover=distill", "algo.handover=distill"),
    ("algo.target_noise_clip=0.2", "algo.target_noise=0.1", "algo.target_noise above 0"),
    ("diagnostics.q_bias_steps=9", "diagnostics.q_bias=true", "diagnostics.q_bias=true"),
    ("diagnostics.q_bias_rollouts=9", "diagnostics.q_bias=true", "diagnostics.q_bias=true"),
    ("wandb.project=mine", "logger=wandb", "logger=[csv,wandb]"),
    ("wandb.entity=us", "logger=wandb", "logger=[csv,wandb]"),
    ("wandb.mode=offline", "logger=wandb", "logger=[csv,wandb]"),
    ("mlflow.tracking_uri=tracks", "logger=mlflow", "logger=[csv,mlflow]"),
    ("mlflow.experiment=mine", "logger=mlflow", "logger=[csv,mlflow]"),
]


@pytest.mark.parametrize(("alone", "beside", "partner"), PAIRS)
def test_alone_they_are_refused_and_beside_it_they_count(alone, beside, partner):
    with pytest.raises(UserError) as error:
        effect.check([alone], [config.load([alone])])
    assert str(error.value) == f"{alone}: goes with {partner}"
    given = [*beside.split(), alone]
    effect.check(given, [config.load(given)])


def test_every_such_key_is_tried():
    keys = {pair[0].partition("=")[0] for pair in PAIRS}
    of_team = {f"algo.{key}" for names in effect.OF_TEAM for key in names}
    assert keys == of_team | {key for names in effect.OF_RUN for key in names}


def test_of_the_opponents_their_own_settings_count():
    given = ["env=simple_tag", "adversary.actor=gru", "adversary.gru_units=8"]
    effect.check(given, [config.load(given)])
    given = ["env=simple_tag", "adversary.actor=gru", "algo.gru_units=8"]  # algo.* holds for all teams
    effect.check(given, [config.load(given)])
    given = ["env=simple_tag", "adversary=maddpg", "adversary.gru_units=8"]
    with pytest.raises(UserError, match=r"^adversary\.gru_units=8: goes with adversary\.actor=gru$"):
        effect.check(given, [config.load(given)])


def test_commands_refuse_them_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = r"^algo\.gru_units=8: goes with algo\.actor=gru$"
    with pytest.raises(UserError, match=message):
        train.main(["algo.gru_units=8"])
    with pytest.raises(UserError, match=message):
        matd3_jax.train("algo.gru_units=8")
    with pytest.raises(UserError, match=r"^algo\.gru_units=8,16: goes with algo\.actor=gru$"):
        sweep.main(["algo.gru_units=8,16"])
    assert not list(tmp_path.iterdir())


def test_in_a_sweep_they_count_where_one_setting_has_it():
    chosen, settings = sweep.read(["algo.critic_head=scalar,categorical", "algo.critic_range=[-9,9]"], None, 0)
    assert len(chosen) == len(settings) == 2
