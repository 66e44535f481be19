"""The worked examples of docs/extending.md, run as they stand there."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from documents import ROOT, apply_diff, blocks

DOCUMENT = ROOT / "docs" / "extending.md"
BLOCKS = blocks(DOCUMENT)
SCRIPT = """
import sys
import numpy as np
import matd3_jax
short = ["seeds=1", "total_steps=1000", "learning_starts=500", "num_envs=4", "rollout_length=5", "batch_size=32"]
short += ["algo.hidden=[16,16]", "algo.lr=0.001", "algo.policy_delay=1", "eval_every=0", "log_every=500"]
out, *runs = sys.argv[1:]
found = [matd3_jax.train(*short, *run.split(), env="point_reach").metrics for run in runs]
np.savez(out, package=matd3_jax.__file__, **{f"{i} {name}": v for i, m in enumerate(found) for name, v in m.items()})
"""
LEARNED = ("agent_0_critic_loss", "agent_0_q_value", "agent_0_actor_loss", "return_agents")


def edits(section):
    """The blocks of a section that edit the package: diffs, and files that begin with their name."""
    return [
        b
        for b in BLOCKS
        if b.section == section and (b.language == "diff" or b.code.startswith(("# core/", "# config/")))
    ]


def package(folder, sections):
    """A copy of the package with the edits of these sections, in `folder`."""
    shutil.copytree(ROOT / "src" / "matd3_jax", folder / "matd3_jax", ignore=shutil.ignore_patterns("__pycache__"))
    for block in [b for section in sections for b in edits(section)]:
        if block.language == "diff":
            apply_diff(block.code, folder / "matd3_jax")
        else:
            first, rest = block.code.split("\n", 1)
            (folder / "matd3_jax" / first.removeprefix("# ")).write_text(rest)
    return folder


def train(folder, *runs):
    """The metrics of short runs with these overrides, by the package in `folder`."""
    out = folder / "metrics.npz"
    env = {**os.environ, "PYTHONPATH": str(folder), "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "1"}
    subprocess.run([sys.executable, "-c", SCRIPT, str(out), *(runs or [""])], env=env, check=True, cwd=folder)
    with np.load(out) as table:
        assert str(table["package"]).startswith(str(folder)), "another package was imported"
        found = [{name: table[f"{i} {name}"] for name in LEARNED} for i in range(max(len(runs), 1))]
    assert all(np.isfinite(run[name][:, -1]).all() for run in found for name in LEARNED)
    return found


def same(a, b):
    return all(np.array_equal(a[name], b[name], equal_nan=True) for name in LEARNED)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A short run of the package as it is."""
    return train(package(tmp_path_factory.mktemp("plain"), []))[0]


@pytest.mark.slow
def test_environment_and_logger_train_as_written(tmp_path, monkeypatch, capsys):
    """In the order of the document: the blocks share their names, as they do for who pastes them."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "extending"}
    for block in BLOCKS:
        if block.language == "python" and block not in edits(block.section):
            exec(compile("\n" * (block.line - 1) + block.code, str(DOCUMENT), "exec"), names)
    returns = names["result"].metrics["return_agents"]
    assert (returns[:, -1] > returns[:, 0] + 3).all(), "the agents do not learn to meet"
    assert (tmp_path / "meet.gif").read_bytes()[:6] == b"GIF89a"
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert {row["seed"] for row in rows} == {0, 1} and max(row["step"] for row in rows) >= 20_000
    assert capsys.readouterr().out.startswith("[[")


@pytest.mark.slow
def test_loss_and_its_setting(tmp_path, plain):
    constant = train(package(tmp_path / "constant", ["A loss"]))[0]
    assert not same(constant, plain)
    edited = package(tmp_path / "setting", ["A loss", "Make it a setting"])
    off, on = train(edited, "algo.behavior_weight=0", "algo.behavior_weight=0.1")
    assert same(off, plain), "a weight of 0 changes the numbers"
    for name in LEARNED:
        np.testing.assert_allclose(on[name], constant[name], rtol=1e-3, err_msg=name)


@pytest.mark.slow
def test_critic_head(tmp_path, plain):
    """Before the first update nothing differs; then losses do, as errors beyond 1 count linearly."""
    usual, huber = train(package(tmp_path, ["A critic head"]), "algo=matd3", "algo=matd3_huber")
    assert same(usual, plain)
    assert np.array_equal(huber["return_agents"][:, 0], plain["return_agents"][:, 0])
    assert (huber["agent_0_critic_loss"][:, -1] < plain["agent_0_critic_loss"][:, -1]).all()


@pytest.mark.slow
def test_network(tmp_path, plain):
    residual = train(package(tmp_path, ["A network"]))[0]
    assert not same(residual, plain)


def added(block):
    """The lines of a block that somebody writes: those that a diff adds, a file, or a class; blank ones apart."""
    lines = block.code.splitlines()
    if block.language == "diff":
        lines = [line[1:] for line in lines if line[0] == "+"]
    elif block in edits(block.section):
        lines = lines[1:]
    else:
        node = next(node for node in ast.parse(block.code).body if isinstance(node, ast.ClassDef))
        lines = lines[min([node.lineno, *(d.lineno for d in node.decorator_list)]) - 1 : node.end_lineno]
    return [line for line in lines if line.strip()]


def test_the_table_counts_lines_and_names_files():
    row = re.compile(r"^\|.*\(#([\w-]+)\) \|.*\| (.*) \| (\d+) \|$", re.MULTILINE)
    rows = row.findall(DOCUMENT.read_text())
    assert len(rows) == 6
    for anchor, files, lines in rows:
        own = [block for block in BLOCKS if block.section.lower().replace(" ", "-") == anchor]
        assert sum(len(added(block)) for block in own) == int(lines), anchor
        named = re.findall(r"^(?:--- |# )(\S+\.(?:py|yaml))$", "".join(block.code for block in own), re.MULTILINE)
        assert len(named) == 4 if files == "four" else set(named) == set(re.findall(r"`(.*?)`", files)), anchor
