"""What the device can do at most: how long an iteration must take, from its products and its bytes
(`benchmarks.limits`)."""

from benchmarks import limits
from benchmarks.gpu import seeds
from benchmarks.gpu.report import Report, Row
from matd3_jax import config
from matd3_jax.training.session import TrainingSession


def run(report: Report, scale: float) -> None:
    for count in (20, 1024) if scale >= 1 else (2,):
        report.case("floor", f"{count} seeds", lambda c=count: iteration(c))


def iteration(count: int) -> Row:
    """The roofline of an iteration of simple_spread at the paper's settings."""
    trainer = TrainingSession(config.load(seeds.settings(count, 100_000))).trainer
    found, products = limits.roofline(trainer, repeats=3)
    return {
        "products_seconds": found.alone,
        "bytes_seconds": found.moved,
        "flops": found.flops,
        "flops_of_traced_program": limits.compiled_flops(trainer),
        "products": products,
    }
