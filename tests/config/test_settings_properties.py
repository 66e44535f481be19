"""Any text for any setting, and any damage of config.yaml: checked settings that a file gives back, or one line."""

import dataclasses
import functools
import tempfile
from pathlib import Path

from hypothesis import example, given
from hypothesis import strategies as st
from properties import examples, texts

from matd3_jax import config
from matd3_jax.config import AlgoConfig, Config
from matd3_jax.config.schema import DiagnosticsConfig, keys
from matd3_jax.errors import UserError

GROUPS = {"": Config, "algo.": AlgoConfig, "adversary.": AlgoConfig, "diagnostics.": DiagnosticsConfig}
SETTINGS = [f"{prefix}{name}" for prefix, cls in GROUPS.items() for name in keys(cls)]


def read_back(settings: Config) -> Config:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.yaml"
        config.write(settings, path)
        return config.read(path)


def check(settings: Config) -> None:
    """Every value is of its field's type, and within its bounds; the file gives the same."""
    assert read_back(settings) == settings
    groups = [settings, settings.algo, settings.diagnostics, *([settings.adversary] if settings.adversary else [])]
    for part in groups:
        for field in dataclasses.fields(part):
            value, bounds = getattr(part, field.name), field.metadata["bounds"]
            for member in value if isinstance(value, tuple) else (value,):
                if isinstance(member, int | float) and not isinstance(member, bool):
                    assert bounds.admits(member), (field.name, value)


def refused(make) -> bool:
    """Whether there are no such settings, said in words."""
    try:
        check(make())
    except UserError as error:
        assert str(error).strip()
        return True
    return False


@given(st.sampled_from([key for key in SETTINGS if key not in ("name", "out")]), texts)
@examples(60)
def test_any_text_for_any_setting(key, text):
    team = ["env=simple_tag"] if key.startswith("adversary") else []
    refused(lambda: config.load([*team, f"{key}={text}"]))


@given(st.sampled_from(["name", "out"]), texts)
@example("name", "1e3")
@example("name", "null")
@example("out", "lr=0.01,[a]")
@example("out", "'x' \u00e9")
@examples(10)
def test_a_text_is_taken_as_it_is_typed(key, text):
    if not refused(lambda: config.load([f"{key}={text}"])):
        assert getattr(config.load([f"{key}={text}"]), key) == text


@functools.cache
def written() -> bytes:
    return config.text(config.load(["env=simple_tag", "adversary=maddpg", "algo.hidden=[8,8]"])).encode()


@given(st.data())
@examples(50)
def test_any_damage_of_a_file_of_settings(data):
    whole = written()
    place = data.draw(st.integers(0, len(whole) - 1))
    byte = data.draw(st.sampled_from([b"", *(bytes([b]) for b in b"0159-.:#\"'[]{}&*!|>%@`,?~ \t\n\0\xff\xc3abent")]))
    damaged = data.draw(st.sampled_from([whole[:place], whole[:place] + byte + whole[place + 1 :]]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.yaml"
        path.write_bytes(damaged)
        refused(lambda: config.read(path))
