"""Tests that documents name are there."""

import ast
import re

from documents import DOCUMENTS, ROOT


def functions(path):
    return {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}


def test_files_and_functions_are_there():
    text = "\n".join(path.read_text() for path in DOCUMENTS.values())
    files = set(re.findall(r"`(tests/[\w/]+\.py)`", text))
    named = set(re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text))
    everywhere = {name for path in (ROOT / "tests").rglob("*.py") for name in functions(path)}
    assert len(files) > 5 and len(named) > 40
    assert all((ROOT / file).is_file() for file in files)
    assert not [f"{file}::{name}" for file, name in sorted(named) if name not in functions(ROOT / file)]
    assert set(re.findall(r"`(test_\w+)`", text)) <= everywhere
