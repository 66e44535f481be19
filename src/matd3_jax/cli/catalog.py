"""Every command: its options, usage and examples. Imports nothing heavy, so that --help is quick."""

import textwrap

from matd3_jax import groups
from matd3_jax.cli.arguments import Check, CrossPlay, Evaluate, Export, Plot, Render, Report, Sweep, Train
from matd3_jax.cli.options import WIDTH, Command


def _settings() -> str:
    """What train's help says of settings, from the files of settings."""
    comments = (groups.FOLDER / "config.yaml").read_text(encoding="utf-8").split("\n\n", 2)[2]
    names = {"environments:": "env", "algorithms:": "algo", "recipes:": "recipe"}
    lines = [f"{title:<14}{', '.join(groups.known_names(group))}" for title, group in names.items()]
    wrapped = [textwrap.fill(line, WIDTH, subsequent_indent=" " * 14) for line in lines]
    return (
        "\n".join(wrapped) + " (of robots; fast by default)\n\n"
        "settings and their defaults (those of a file: env.KEY=value, algo.KEY=value, adversary.KEY=value); robots "
        f"bring others\nalong, which --cfg env=ant prints:\n\n{comments.strip()}"
    )


def _python(name: str) -> str:
    return f"python -m matd3_jax.{name}"


TRAIN = Command(
    _python("train"), Train, more=_settings,
    usage=(
        "[env=NAME] [algo=NAME] [adversary=NAME] [recipe=NAME] [key=value ...]",
        "resume=RUN_DIR [checkpoint=STEP] [total_steps=N]",
        "--cfg [key=value ...]",
    ),
    examples=(
        "python -m matd3_jax.train env=simple_tag algo=matd3 adversary=maddpg seeds=8",
        "python -m matd3_jax.train env=ant seeds=6 name='first ant'",
    ),
)  # fmt: skip
SWEEP = Command(
    _python("sweep"), Sweep,
    usage=(
        "[env=NAME] [algo=NAME] [key=value ...] key=VALUES ... [option=value ...]",
        "resume=SWEEP_DIR [batch=K] [metric=COLUMN]",
    ),
    examples=(
        "python -m matd3_jax.sweep algo.lr=0.01,0.003,0.001 algo.policy_delay=1,2 seeds=4",
        "python -m matd3_jax.sweep algo.lr='interval(1e-4,1e-2)' samples=16 seeds=4 memory=8",
        "python -m matd3_jax.sweep algo.lr='interval(1e-4,1e-2)' samples=16 pbt=true",
    ),
)  # fmt: skip
EVALUATE = Command(
    _python("evaluate"), Evaluate, examples=("python -m matd3_jax.evaluate run=runs/first episodes=1000",)
)
RENDER = Command(
    _python("render"), Render,
    more="Robots need OpenGL, in software or not; MUJOCO_GL (egl, osmesa, glfw) in the environment chooses which.",
    examples=("python -m matd3_jax.render run=runs/first out=first.mp4 seed=2",),
)  # fmt: skip
CROSSPLAY = Command(
    _python("crossplay"), CrossPlay, examples=("python -m matd3_jax.crossplay runs='runs/push-*' pairing=matched",)
)
PLOT = Command(
    _python("plot"), Plot,
    examples=("python -m matd3_jax.plot runs='runs/sweep/runs/*' y=return_agents,eval_return_agents average=iqm",),
)  # fmt: skip
EXPORT = Command(
    _python("export"), Export,
    more="format=onnx needs the extra: pip install 'matd3_jax[export]'.",
    examples=(
        "python -m matd3_jax.export run=runs/first format=onnx which=best",
        "python -m matd3_jax.export run=runs/first format=numpy seed=2 out=policies",
    ),
)  # fmt: skip
REPORT = Command(
    _python("report"), Report, examples=("python -m matd3_jax.report runs='runs/sweep/runs/*' out=sweep.html",)
)
CHECK = Command(
    _python("check"), Check, usage=("run=RUN_DIR", "sweep=SWEEP_DIR"),
    examples=("python -m matd3_jax.check run=runs/first", "python -m matd3_jax.check sweep=runs/sweep"),
)  # fmt: skip

COMMANDS: dict[str, Command] = {
    "train": TRAIN,
    "sweep": SWEEP,
    "evaluate": EVALUATE,
    "crossplay": CROSSPLAY,
    "plot": PLOT,
    "render": RENDER,
    "export": EXPORT,
    "report": REPORT,
    "check": CHECK,
}
