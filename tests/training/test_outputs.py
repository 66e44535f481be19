"""Who logs, and what is checked before anything is written."""

import sys
from types import SimpleNamespace

import pytest

from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import outputs
from matd3_jax.training.recorded_run import Listeners, RecordedRun


class Noted:
    def __init__(self):
        self.calls = 0

    def log(self, row):
        self.calls += 1

    def close(self):
        self.calls += 1


@pytest.mark.parametrize(("first", "calls"), [(True, 2), (False, 0)])
def test_of_several_processes_the_first_logs(first, calls, tmp_path):
    noted = Noted()
    listeners = Listeners(SimpleNamespace(first=first), print, [noted], None)
    training = SimpleNamespace(config=config.load(["env=point_reach"]), share=SimpleNamespace(total=4))
    with RecordedRun(listeners, training, RunDirectory(tmp_path)).outputs() as out:
        out.log({})
    assert noted.calls == calls


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow"])
def test_a_missing_package_is_one_line_with_its_extra(name, tmp_path, monkeypatch):
    """Also where W&B has left a folder `wandb` that can be imported as if it were a package."""
    module = {"tensorboard": "tensorboardX"}.get(name, name)
    settings = config.load([f"logger={name}"])
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=rf"logger=\[{name}\] needs the package {module}: pip .*matd3_jax\[{name}\]"):
        outputs.check(settings)
    if name != "tensorboard":
        monkeypatch.delitem(sys.modules, module)
        (tmp_path / module / "offline-run-1").mkdir(parents=True)
        monkeypatch.setattr(sys, "path", [str(tmp_path)])
        with pytest.raises(UserError, match="needs the package"):
            outputs.check(settings)
