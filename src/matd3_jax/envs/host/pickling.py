"""Pickles of environments with all that they are in the middle of."""

import pickle
from io import BytesIO
from typing import Any


class Pickler(pickle.Pickler):
    """Pickles environments as they are.

    Many environments are `EzPickle`s, which pickle the arguments of their constructor and forget where they are: of
    these the attributes are kept. Surfaces and fonts of pygame, on which environments draw themselves, are left out.
    """

    def reducer_override(self, obj: Any) -> Any:
        if type(obj).__module__.split(".")[0] == "pygame":
            return _nothing, ()
        if hasattr(obj, "_ezpickle_args") and not isinstance(obj, type) and hasattr(obj, "__dict__"):
            return _bare, (type(obj),), dict(obj.__dict__), None, None, _set_attributes
        return NotImplemented


def loads(dumped: bytes) -> Any:
    """What a `Pickler` wrote. Runs what the bytes say, as every pickle does."""
    return pickle.load(BytesIO(dumped))


def _bare(cls: type) -> Any:
    return object.__new__(cls)


def _set_attributes(obj: Any, attributes: dict[str, Any]) -> None:
    obj.__dict__.update(attributes)


def _nothing() -> None:
    return None
