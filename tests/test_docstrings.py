"""The examples in docstrings are true."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src"


def examples():
    """Of every module that holds some: its docstrings with examples."""
    for path in sorted(ROOT.rglob("*.py")):
        if ">>>" in path.read_text():
            parts = path.relative_to(ROOT).with_suffix("").parts
            module = importlib.import_module(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
            yield from (found for found in doctest.DocTestFinder().find(module) if found.examples)


EXAMPLES = list(examples())


def test_functions_that_are_used_most_have_examples():
    names = {found.name for found in EXAMPLES}
    assert names >= {"matd3_jax.envs.make", "matd3_jax.training.train.train", "matd3_jax.stats.intervals.compare"}


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda found: found.name)
def test_example(example):
    report = []
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=report.append)
    assert result.attempted == len(example.examples) and not result.failed, "".join(report)
