"""Any text as the name of a directory: one strictly inside its parent, or refused in one line; nothing else is made."""

import contextlib
import os
import re
import tempfile
from pathlib import Path

from hypothesis import example, given
from hypothesis import strategies as st
from properties import examples, texts

from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.paths import as_part, check_directory, inside, is_name
from matd3_jax.sweep.search_space import Axis, names

SETTINGS = config.load(["env=point_reach"])
paths = st.one_of(
    texts, st.lists(st.sampled_from(["..", ".", "a", "b c", "", "~", "\u00e9"]), max_size=5).map("/".join)
)


@contextlib.contextmanager
def parent():
    """A directory whose surroundings are seen."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "other").mkdir()
        made = Path(folder) / "parent"
        made.mkdir()
        yield made
        assert sorted(os.listdir(folder)) == ["other", "parent"] and not os.listdir(Path(folder) / "other")


@given(paths)
@example("../other")
@example("x" * 256)
@example("\u00e9" * 128)
@example("\ud800")
@example("a\0b")
@examples(25)
def test_a_run_of_any_name_is_inside_its_parent(text):
    with parent() as folder:
        try:
            path = inside(folder, text, "name")
            RunDirectory.check_new(path)
        except UserError as error:
            assert str(error).strip() and not os.listdir(folder)
            return
        run = RunDirectory.create(path, SETTINGS, {})
        assert folder.resolve() in run.path.resolve().parents
        assert RunDirectory.open(run.path)[1] == SETTINGS


@given(st.one_of(paths, st.none(), st.integers()))
@example("x" * 256)
@example("\ud800")
@examples(60)
def test_a_name_from_a_file_is_one_directory_in_another(value):
    if is_name(value):
        with parent() as folder:
            (folder / value).mkdir()
            assert [path.name for path in folder.iterdir()] == [value]


@given(st.one_of(paths, texts))
@example("package:Name-v0")
@example("x" * 300)
@examples(60)
def test_a_text_is_made_a_part_of_a_name(text):
    made = as_part(text)
    assert re.fullmatch(r"[A-Za-z0-9.+_-]{0,100}", made) and is_name(f"x-{made}-x")
    assert made == text or re.search(r"[^A-Za-z0-9.+_-]", text) or len(text) > 100


@given(paths)
@examples(60)
def test_any_path_can_be_checked(text):
    with parent() as folder, contextlib.suppress(UserError):
        check_directory(folder / text, "out")


@given(st.lists(texts, min_size=1, max_size=4))
@examples(100)
def test_settings_of_a_sweep_have_names(values):
    made = names([Axis("algo.lr", ())], [{"algo.lr": value} for value in values])
    assert all(map(is_name, made)) and len(set(made)) == len(made)
