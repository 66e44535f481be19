"""Where copies of an environment come from: a name on the command line, a function, or an instance."""

import contextlib
import copy
import importlib
import io
import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from matd3_jax.errors import OptionError, described, one_line


class Kwargs(Mapping):
    """Keyword arguments that can be part of a static environment: hashable, as they are plain values of YAML."""

    def __init__(self, values: Mapping[str, Any]):
        if not isinstance(values, Mapping):
            raise OptionError(f"kwargs={values!r}: must be a group of keys, for instance env.kwargs={{N:3}}")
        try:
            self._text = json.dumps(dict(values), sort_keys=True)
        except TypeError as error:
            raise OptionError(
                f"kwargs={dict(values)!r}: must be numbers, words, lists and groups of them; hand a function that "
                "makes the environment to envs.from_pettingzoo or envs.from_gymnasium for others"
            ) from error
        self._values = json.loads(self._text)

    def __getitem__(self, key: str) -> Any:
        return copy.deepcopy(self._values[key])

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        return hash(self._text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mapping) and dict(self) == dict(other)

    def __repr__(self) -> str:
        return repr(self._values)


def named(key: str, name: Any, example: str) -> Any:
    """What a dotted name stands for: a module, or `module:attribute`.

    Raises OptionError, with the package to install where one is missing.
    """
    if not isinstance(name, str) or not name:
        raise OptionError(f"{key}={name!r}: must name {example}")
    path, _, attribute = name.partition(":")
    found = _module(key, name, path, example)
    for part in attribute.split(".") if attribute else ():
        if not hasattr(found, part):
            raise OptionError(f"{key}={name}: {path} has no {attribute}")
        found = getattr(found, part)
    return found


def _module(key: str, name: str, path: str, example: str) -> Any:
    try:
        with without_greetings():
            return importlib.import_module(path)
    except ModuleNotFoundError as error:
        if error.name and not (path == error.name or path.startswith(error.name + ".")):
            raise OptionError(
                f"{key}={name}: it needs the package {error.name.split('.')[0]}: {_install(error)}"
            ) from error
        parent, _, last = path.rpartition(".")
        if error.name == path and parent:  # an attribute of its package, which is imported already
            package = importlib.import_module(parent)
            if hasattr(package, last):
                return getattr(package, last)
            raise OptionError(f"{key}={name}: {parent} has no {last}") from error
        raise OptionError(
            f"{key}={name}: there is no module {error.name}; {_install(error)}, or name {example}"
        ) from error
    except (ImportError, ValueError, TypeError) as error:
        raise OptionError(f"{key}={name}: cannot be imported ({one_line(error)})") from error


def _install(error: ModuleNotFoundError) -> str:
    package = (error.name or "").split(".")[0]
    return "pip install 'matd3_jax[pettingzoo]'" if package == "pettingzoo" else f"pip install {package}"


@contextlib.contextmanager
def without_greetings() -> Iterator[None]:
    """Nothing on standard output, where pygame greets whoever imports it, and no warnings."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def unmade(id: Any, kwargs: Mapping[str, Any], error: Exception) -> str:
    """What is said of an environment whose function raised an error."""
    return f"env.id={id} cannot be made with env.kwargs={kwargs!r}: {described(error)}"


def called(source: Any) -> str:
    """What errors call a function that makes environments, or an instance."""
    return getattr(source, "__qualname__", type(source).__name__)


def maker(source: Any, is_environment: Callable[[Any], bool]) -> tuple[Callable[[], Any], Any]:
    """(a function that makes copies, the first) of a function or of an instance, which is copied and left alone.

    Raises OptionError where neither works.
    """
    if is_environment(source):
        make = _copies(source)
        return make, make()
    if callable(source):
        return source, source()
    raise OptionError(f"{source!r} is neither an environment nor a function that makes one")


def _copies(instance: Any) -> Callable[[], Any]:
    pristine: list[Any] = []
    try:
        pristine.append(copy.deepcopy(instance))
    except Exception as error:
        raise OptionError(
            f"{type(instance).__name__} cannot be copied ({one_line(error)}), and every seed needs copies "
            "of its own: give a function that makes it"
        ) from error
    return lambda: copy.deepcopy(pristine[0])
