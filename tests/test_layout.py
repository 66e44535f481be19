"""The tests are laid out as the packages are: one name, one file."""

from collections import Counter
from pathlib import Path

TESTS = Path(__file__).parent
OTHERS = {"benchmarks", "data", "docs", "experiments", "helpers"}
"""Folders for what is not in the package, and for what tests share."""


def test_folders_are_packages():
    packages = {path.parent.name for path in (TESTS.parent / "src" / "matd3_jax").glob("*/__init__.py")}
    folders = {path.parent.relative_to(TESTS).parts[0] for path in TESTS.glob("*/**/*.py")}
    assert len(packages) > 10 and folders - OTHERS <= packages


def test_each_name_is_there_once():
    names = Counter(path.name for path in TESTS.rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
