"""Paths on the way through Hydra's command line to the jobs of a launcher."""

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from matd3_jax.sweep import launcher


@pytest.mark.parametrize(
    "text",
    [
        "/runs/a", "/a b", "/it's", '/"a"', "/a=b", "/a,b", "/[a]", "/{a}", "/${a}", "/$a", "/a\\b", "/a\\'b", "/a\\",
        "/a\\\\", "/\\${a}", "/naïve ü 日本", "/1e3", "/null", "/a#b", "/a:b", "/(a)",
    ],
)  # fmt: skip
def test_a_job_gets_the_path_as_it_is(text):
    override = OverridesParser.create().parse_override(f"sweep={launcher.quoted(Path(text))}")
    settings = OmegaConf.create({"sweep": ""})
    OmegaConf.update(settings, "sweep", override.value())
    assert settings.sweep == text
