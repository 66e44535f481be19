"""The torture of runs (`python -m tests.torture`), one trial of each kind."""

import random
import sys

import pytest

from tests import torture

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="descriptors are looked up in /proc"),
]


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    found = torture.Torture(tmp_path_factory.mktemp("torture"), random.Random(0))
    yield found
    found.close()


def test_faults_hit_every_kind_of_call(trials):
    """Of the unbroken run's calls: the shim sees them, those of Orbax included."""
    assert {call.split()[0] for call in trials.calls} >= {
        "open",
        "write",
        "fsync",
        "replace",
        "rename",
        "mkdir",
        "unlink",
    }
    assert any("/checksums.json" in call for call in trials.calls)
    assert trials.planned() > 5


@pytest.mark.parametrize("number", range(torture.KINDS))
def test_each_kind_of_fault_leads_on(trials, number):
    before = sum(trials.table.values())
    trials.trials()[number]()
    assert not trials.failures
    assert sum(trials.table.values()) == before + 1


def test_a_loss_would_be_seen(trials):
    """What the trials compare differs where one row, or one array, does."""
    assert torture.same(trials.whole, trials.whole) == ""
    path = trials.back()
    assert torture.same(path, trials.whole) != ""
    path = torture.shutil.copytree(trials.whole, trials.path())
    data = (path / "metrics.csv").read_bytes()
    (path / "metrics.csv").write_bytes(data[:-3] + bytes([data[-3] ^ 1]) + data[-2:])
    assert torture.same(path, trials.whole) == "metrics.csv differs"
