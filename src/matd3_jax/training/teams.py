"""Which environment a run's teams act in, and what each of them learns with."""

from matd3_jax.config import Config
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import UserError
from matd3_jax.training import handover


def joined(config: Config, env: Environment) -> tuple[Environment, dict[str, Algorithm]]:
    """The environment where teams that one policy controls are one agent, and the algorithm of each team.

    Raises UserError where the environment has not what the settings ask for.
    """
    if env.on_host and config.diagnostics.q_bias:
        raise UserError(
            f"diagnostics.q_bias=true puts environments back to earlier states, and {config.env['name']} is "
            "stepped in Python and only goes forward: leave it false"
        )
    if env.on_host and config.hands_over:
        raise UserError(
            f"algo=hybrid lets episodes go on with another environment, and {config.env['name']} is stepped in "
            "Python: train algo=matd3, then algo=td3 with init="
        )
    if config.adversary is not None and "adversaries" not in env.teams:
        raise UserError(f"adversary={config.adversary.name}: {config.env['name']} has no adversaries")
    teams = config.teams()
    algorithms = {team: algo.algorithm() for team, algo in teams.items()}
    for team in [team for team in dict.fromkeys(env.teams) if teams[team].joint]:
        if teams[team].hands_over and teams[team].handover == "join":
            algorithms[team] = handover.widened(algorithms[team], env.teams.count(team))
        env = JointTeam(env, (team,), full=not teams[team].hands_over)
    return env, algorithms
