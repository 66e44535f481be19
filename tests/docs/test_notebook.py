"""The notebook of the tutorials runs from top to bottom, and shows what it says."""

import importlib.util
import json

import nbclient
import nbformat
import pytest
from documents import ROOT

NOTEBOOK = ROOT / "docs" / "tutorials" / "first_run.ipynb"
LIMIT = 180
"""Seconds on two cores."""


def test_it_is_committed_without_outputs_for_any_python():
    notebook = json.loads(NOTEBOOK.read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert code and not any(cell["outputs"] or cell["execution_count"] for cell in code)
    assert notebook["metadata"]["kernelspec"]["name"] == "python3" and NOTEBOOK.stat().st_size < 300_000
    assert not {"version", "codemirror_mode"} & set(notebook["metadata"]["language_info"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_it_runs_from_top_to_bottom(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=LIMIT, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    shown = [kind for output in outputs for kind in output.get("data", {})]
    assert shown.count("image/png") == 2 and shown.count("image/gif") == 1
    said = "".join(output.get("text", "") for output in outputs if output["output_type"] == "stream")
    assert "over 3 seeds" in said and "untrained, trained" in said
    assert len(list((tmp_path / "runs" / "lr").rglob("metrics.csv"))) == 3


def test_the_first_cell_finds_a_clone_or_a_zip(tmp_path, monkeypatch):
    """Where the package is missing: what pip would be given."""
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = "".join(next(cell for cell in cells if cell["cell_type"] == "code")["source"])
    code = code.replace('%pip install -q "{source}"', "installed.append(source)")
    assert "%" not in code
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    def installed(folder):
        monkeypatch.chdir(folder)
        found = []
        exec(code, {"installed": found})
        return found

    (tmp_path / "clone" / "src" / "matd3_jax").mkdir(parents=True)
    (tmp_path / "clone" / "docs" / "tutorials").mkdir(parents=True)
    assert installed(tmp_path / "clone" / "docs" / "tutorials") == [str(tmp_path / "clone")]
    with pytest.raises(FileNotFoundError, match="neither a clone"):
        installed(tmp_path)
    (tmp_path / "matd3_jax-main.zip").touch()
    assert installed(tmp_path) == [str(tmp_path / "matd3_jax-main.zip")]
