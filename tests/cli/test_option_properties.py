"""Any text for any option of any command: a value of its type and within its bounds, or one line."""

import dataclasses
import typing
from pathlib import Path

import bad_input
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples, texts

from matd3_jax.cli import catalog
from matd3_jax.errors import UserError

OPTIONS = [
    (command, field.name)
    for command in catalog.COMMANDS.values()
    for field in dataclasses.fields(command.options)
    if "bounds" in field.metadata
]


def needed(command, name) -> list[str]:
    """What else must be given."""
    fields = [field for field in dataclasses.fields(command.options) if "bounds" in field.metadata]
    required = [field for field in fields if field.default is dataclasses.MISSING and field.name != name]
    return [f"{field.name}={bad_input.good(field.metadata['bounds'])}" for field in required]


def fits(value, hint, bounds) -> bool:
    if typing.get_args(hint) and typing.get_origin(hint) is not tuple:
        return any(fits(value, part, bounds) for part in typing.get_args(hint))
    if typing.get_origin(hint) is tuple:
        return isinstance(value, tuple) and all(fits(member, typing.get_args(hint)[0], bounds) for member in value)
    if hint in (int, float):
        return type(value) is hint and bounds.admits(value)
    if bounds.choices is not None and value is not None:
        return value in bounds.choices
    return isinstance(value, hint)


@given(st.sampled_from(OPTIONS), texts)
@examples(300)
def test_any_text_for_any_option(option, text):
    command, name = option
    try:
        found = getattr(command.parse([*needed(command, name), f"{name}={text}"]), name)
    except UserError as error:
        assert name in str(error)
        return
    field = next(field for field in dataclasses.fields(command.options) if field.name == name)
    assert fits(found, typing.get_type_hints(command.options)[name], field.metadata["bounds"])
    if isinstance(found, str):
        assert found == text
    elif isinstance(found, Path):
        assert found == Path(text)


@given(st.lists(st.text(st.characters(exclude_characters="'\""), min_size=1, max_size=6), min_size=1, max_size=4))
@examples(100)
def test_a_list_in_quotation_marks_gives_its_words_back(words):
    """Commas, brackets and blanks within a word stay in it."""
    if any(word != word.strip() for word in words):
        return
    given = catalog.PLOT.parse(["runs=nowhere", "labels=" + ",".join(f'"{word}"' for word in words)])
    assert given.labels == tuple(words)


@pytest.mark.parametrize("digits", [400, 5000])
def test_numbers_that_no_machine_number_holds(digits):
    for command, name in OPTIONS:
        field = next(field for field in dataclasses.fields(command.options) if field.name == name)
        kinds = str(typing.get_type_hints(command.options)[name])
        if ("int" in kinds or "float" in kinds) and field.metadata["read"] is None:
            with pytest.raises(UserError, match=f"{name}="):
                command.parse([*needed(command, name), f"{name}={'9' * digits}"])
