"""The function that gives an environment here as a PettingZoo `ParallelEnv`; PettingZoo is loaded when it is called."""

from typing import TYPE_CHECKING, Any

from matd3_jax import envs
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError

if TYPE_CHECKING:
    from matd3_jax.interop.parallel_environment import ParallelEnvironment


def parallel_env(
    env: str | Environment, render_mode: str | None = None, size: int = 400, **options: Any
) -> "ParallelEnvironment":
    """Make a PettingZoo `ParallelEnv` of an environment: see `interop.parallel_environment.ParallelEnvironment`.

    Args:
        env: its name, as `env=` takes it, or an instance.
        render_mode: "rgb_array", or None for no pictures.
        size: pixels of a picture's longer side.
        options: of the environment that `env` names.

    Raises UserError where PettingZoo is not installed or `env` breaks the contract, OptionError for an unknown name or
    option.

    Example:
        >>> env = parallel_env("simple_spread", num_agents=2)
        >>> observations, infos = env.reset(seed=0)
        >>> observations["agent_1"].shape, env.action_space("agent_1")
        ((12,), SimplexSpace((5,)))
    """
    try:
        from matd3_jax.interop.parallel_environment import ParallelEnvironment
    except ImportError as error:
        raise UserError(
            f"parallel_env needs the extra 'pettingzoo': pip install 'matd3_jax[pettingzoo]' ({error})"
        ) from error
    return ParallelEnvironment(resolve(env, options), render_mode, size)


def resolve(env: str | Environment, options: dict[str, Any]) -> Environment:
    """The environment that `env` names or is, checked.

    Raises UserError for options of an instance, and for an environment that another library steps in Python already.
    """
    if isinstance(env, str):
        env = envs.make(env, **options)
    elif options:
        raise UserError(f"{', '.join(options)}: options go with an environment's name; this is an instance")
    envs.check(env)
    if env.on_host:
        raise UserError(f"{type(env).__name__} is another library's environment: hand that to who wants to step it")
    return env
