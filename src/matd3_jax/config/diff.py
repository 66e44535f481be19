"""In which settings runs differ, and short names made of that."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from matd3_jax import config as configuration
from matd3_jax.config import Config, schema
from matd3_jax.config.schema import Affects
from matd3_jax.errors import UserError

NOT_LEARNING = schema.keys(Config, Affects.SEEDS, Affects.BOOKKEEPING)
"""Keys that say which seeds a run has, how long it goes and what it leaves behind: not how it learns."""

NAMES = ("env.name", "algo.name", "adversary.name")


def flat(config: Config) -> dict[str, Any]:
    """Every setting by its dotted key; the adversaries' are those of `algo` where they have none of their own."""
    values = config.to_dict()
    return _flat({**values, "adversary": values["adversary"] or values["algo"]})


def learning(config: Config) -> dict[str, Any]:
    """What makes a run learn as it does: `flat` without `NOT_LEARNING`."""
    return {key: value for key, value in flat(config).items() if key.split(".")[0] not in NOT_LEARNING}


def differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys of settings (as `flat` and `learning` give them) that are not the same in all, in their order."""
    keys = dict.fromkeys(key for values in settings for key in values)
    return [key for key in keys if any(_get(values, key) != _get(settings[0], key) for values in settings)]


def label_differences(configs: Sequence[Config]) -> list[str]:
    """A short name for each run, made of the settings in which they differ; no two are alike.

    Environment and algorithms come first, by name (`simple_tag, matd3 vs maddpg`). Other keys follow as `key=value`
    where they differ between runs of the same names, or where some run has another value than its names bring along
    (so `matd3` and `maddpg` are not also distinguished by `num_critics=2` and `num_critics=1`). A learning rate that is
    the same for actor and critic is `lr`. Runs that learn alike are distinguished by their seeds, then by what they
    leave behind, at last by a number. Where nothing differs (one run, say) the name is that of the algorithms.
    """
    settings = [learning(config) for config in configs]
    keys = differing(settings)
    names = [key for key in NAMES if key in keys]
    kinds = [tuple(values[key] for key in names) for values in settings]
    defaults = {kind: _defaults(configs[kinds.index(kind)]) for kind in set(kinds)} if names else {}

    def matters(key: str) -> bool:
        by_kind: dict[tuple[str, ...], list[Any]] = {}
        for kind, values in zip(kinds, settings, strict=True):
            if key in values:
                by_kind.setdefault(kind, []).append(values[key])
        inside = any(value != found[0] for found in by_kind.values() for value in found)
        return inside or any(
            value != _get(defaults.get(kind, {}), key) for kind, found in by_kind.items() for value in found
        )

    settings, keys = _merged(settings, [key for key in keys if key not in names and matters(key)])
    short = Counter(key.split(".")[-1] for key in keys)
    labels = []
    for config, values in zip(configs, settings, strict=True):
        parts = [values["env.name"]] if "env.name" in names else []
        parts += [algorithms(config)] if "algo.name" in names or "adversary.name" in names else []
        for key in keys:
            last = key.split(".")[-1]
            parts += [f"{last if short[last] == 1 else key}={text(values[key])}"] if key in values else []
        labels.append(", ".join(parts) or ("" if keys else algorithms(config)))
    labels = _told_apart(labels, [f"seeds {c.seed} to {c.seed + c.seeds - 1}" for c in configs])
    rest = differing([flat(config) for config in configs])
    rest = [key for key in rest if key.split(".")[0] in schema.RECORDS]
    labels = _told_apart(labels, [", ".join(f"{k}={text(_get(flat(c), k))}" for k in rest) for c in configs])
    seen: Counter[str] = Counter()
    repeated = {label for label, count in Counter(labels).items() if count > 1}
    for i, label in enumerate(labels):
        seen[label] += 1
        labels[i] = f"{label} ({seen[label]})" if label in repeated else label
    return labels


def environment(config: Config) -> str:
    """The environment of a run in a few words: its name, and of another library's what that calls it."""
    return " ".join(str(config.env[key]) for key in ("name", "id") if config.env.get(key) is not None)


def algorithms(config: Config) -> str:
    """`matd3`, or `matd3 vs maddpg` where the adversaries have another."""
    other = config.teams()["adversaries"].name
    return config.algo.name if other == config.algo.name else f"{config.algo.name} vs {other}"


def text(value: Any) -> str:
    """A setting as one writes it on the command line."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(text, value))}]"
    if value is None or isinstance(value, bool):
        return {True: "true", False: "false", None: "null"}[value]
    return str(value)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found.update(_flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value})
    return found


def _get(values: Mapping[str, Any], key: str) -> Any:
    return values.get(key, _ABSENT)


_ABSENT = object()


def _defaults(config: Config) -> dict[str, Any]:
    """What the names of environment and algorithms bring along by themselves; nothing if they are not known here."""
    lines = [f"env={config.env['name']}", f"algo={config.algo.name}", f"recipe={config.recipe}"]
    lines += [f"adversary={config.adversary.name}"] if config.adversary else []
    try:
        return learning(configuration.load(lines))
    except UserError:
        return {}


def _merged(settings: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Without repetition: `lr` for equal actor_lr and critic_lr, `algo.` for both teams where they are equal."""
    merged, left = [dict(values) for values in settings], list(keys)
    for key in keys:
        if key.startswith("adversary.") and all(v[key] == v["algo." + key.split(".")[1]] for v in merged):
            left.remove(key)
    for team in ("algo", "adversary"):
        actor, critic = f"{team}.actor_lr", f"{team}.critic_lr"
        if actor in left and critic in left and all(values[actor] == values[critic] for values in merged):
            left[left.index(actor)] = f"{team}.lr"
            left.remove(critic)
            for values in merged:
                values[f"{team}.lr"] = values[actor]
    return merged, left


def _told_apart(labels: Sequence[str], more: Sequence[str]) -> list[str]:
    """Labels, those that occur several times with `more` added where that differs between them."""
    groups: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        groups.setdefault(label, []).append(i)
    found = list(labels)
    for label, members in groups.items():
        if len({more[i] for i in members}) > 1:
            for i in members:
                found[i] = ", ".join(part for part in (label, more[i]) if part)
    return found
