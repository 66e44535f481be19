"""What users install: a clone without symbolic links, a repository ZIP, an sdist and a wheel hold the same and train.

The top-level `envs` is a link. Windows clones and many programs that unpack ZIPs make a small text file of it.
"""

import csv
import importlib.metadata
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest


def major(package: str) -> int:
    """First number of an installed version; 0 of what is not there."""
    try:
        return int(importlib.metadata.version(package).split(".")[0])
    except importlib.metadata.PackageNotFoundError:
        return 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not major("pip") or major("setuptools") < 77,
        reason="needs pip and the setuptools that pyproject.toml names, as nothing is fetched",
    ),
]

ROOT = Path(__file__).parents[1]
LINK = "src/matd3_jax/envs"
KINDS = ("clone", "zip", "sdist", "wheel")


def git(*arguments: str | Path) -> str:
    words = ["git", "-c", "user.name=test", "-c", "user.email=test", "-c", "commit.gpgsign=false", *arguments]
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def repository(tmp_path_factory) -> Path:
    """A repository whose one commit holds the files as they now are, committed or not."""
    if not (ROOT / ".git").exists():
        pytest.skip("not in a clone")
    folder = tmp_path_factory.mktemp("repository")
    for name in git("-C", ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard").split("\0")[:-1]:
        if os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    git("init", "-q", folder)
    git("-C", folder, "add", "-A")
    git("-C", folder, "commit", "-q", "-m", "all")
    return folder


def source(kind: str, repository: Path, folder: Path) -> Path:
    """What a user has before the installation, in the new `folder`."""
    checkout = folder / "checkout"
    if kind == "zip":
        git("-C", repository, "archive", "--format=zip", f"--output={folder / 'all.zip'}", "HEAD")
        with zipfile.ZipFile(folder / "all.zip") as archive:
            archive.extractall(checkout)  # writes links as files with the place they lead to, as some programs do
        assert (checkout / "envs").read_text() == LINK
        return checkout
    git("-c", f"core.symlinks={str(kind != 'clone').lower()}", "clone", "-q", repository, checkout)
    if kind == "clone":
        assert not (checkout / "envs").is_symlink() and (checkout / "envs").read_text() == LINK
        return checkout
    code = f"import setuptools.build_meta as build; print(build.build_{kind}({str(folder)!r}))"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=checkout, capture_output=True)
    (built,) = folder.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return built


@pytest.fixture(scope="module", params=KINDS)
def installed(request, repository, tmp_path_factory) -> Path:
    """The folder that one of the sources was installed into, by itself and without a network."""
    folder = tmp_path_factory.mktemp(request.param)
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
    words += ["--no-index", "--no-deps", "--no-build-isolation", "--target", folder / "site"]
    words += [source(request.param, repository, folder)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shutil.rmtree(folder / "checkout", ignore_errors=True)  # nothing may be read from there
    return folder / "site"


def test_the_whole_package_is_installed_and_nothing_else(installed, repository):
    """Every file of ours, settings and the mark of types among them, and neither tests nor studies nor `envs`."""
    ours = repository / "src" / "matd3_jax"
    wanted = {path.relative_to(ours): path.read_bytes() for path in ours.rglob("*") if path.is_file()}
    assert {Path("py.typed"), Path("config/config.yaml"), Path("config/algo/matd3.yaml")} <= wanted.keys()
    package = installed / "matd3_jax"
    found = {path.relative_to(package): path.read_bytes() for path in package.rglob("*") if path.is_file()}
    assert found.keys() == wanted.keys()
    assert found == wanted
    others = {path.name for path in installed.iterdir()} - {"bin", "matd3_jax"}
    (information,) = others
    assert information.endswith(".dist-info")
    assert (installed / information / "licenses" / "LICENSE").read_text() == (repository / "LICENSE").read_text()
    assert {path.name for path in (installed / "bin").iterdir()} == {"matd3"}


@pytest.fixture(scope="module")
def users(tmp_path_factory) -> dict[str, str]:
    """The environment of a user's process: full optimization, and programs compiled once for all installations."""
    environment = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "PYTHONPATH")}
    return environment | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled"))}


def test_an_installation_trains(installed, users, tmp_path):
    """From a folder that knows nothing of the project, with the libraries of this interpreter."""
    settings = ["env=simple_spread", "seeds=2", "total_steps=400", "learning_starts=200", "batch_size=32"]
    settings += ["algo.hidden=[16]", "log_every=100", "eval_every=200", "eval_episodes=2", "name=first"]
    code = "import runpy, matd3_jax as m; print(m.__file__); runpy.run_module('matd3_jax.train', run_name='__main__')"
    environment = users | {"PYTHONPATH": str(installed)}
    words = [sys.executable, "-c", code, *settings]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[0]) == installed / "matd3_jax" / "__init__.py"
    with (tmp_path / "runs" / "first" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["seed"] for row in rows} == {"0", "1"} and int(rows[-1]["step"]) >= 400
    losses = [float(value) for name, value in rows[-1].items() if name.endswith("critic_loss")]
    assert len(losses) == 3 and np.isfinite(losses).all()
    assert (tmp_path / "runs" / "first" / "summary.json").exists()
