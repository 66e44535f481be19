"""Runs in MLflow."""

import importlib.util
import os
import re
import time
from pathlib import Path
from typing import Any

from matd3_jax.tracking.backend import Known
from matd3_jax.tracking.messages import FINISHED, STOPPED, Numbers, TrackedRun, flat

EXPERIMENT = "matd3_jax"
"""Unless the settings or MLFLOW_EXPERIMENT_NAME name another."""

PATIENCE = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "20", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "3"}
"""With a server that does not answer, unless the environment says otherwise: MLflow's own is many minutes."""

AT_ONCE = {"metrics": 1000, "params": 100}
"""What a server takes in one request."""


class MlflowBackend:
    """Each run is a run there, and its seeds, unless they are one with it, are nested in it."""

    has_parents = True

    def __init__(self) -> None:
        for name, value in PATIENCE.items():
            os.environ.setdefault(name, value)
        # Directories are for those who ask for one; MLflow 3 wants a variable for that.
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
        import mlflow

        self.mlflow = mlflow
        self.clients: dict[tuple[int, int | None], Any] = {}
        self.runs: dict[tuple[int, int | None], str] = {}
        self.done: dict[tuple[int, int | None], int] = {}
        """The last env step that a run that is continued has."""
        self.where = ""

    def open(self, key: tuple[int, int | None], run: TrackedRun) -> None:
        known, (number, seed) = Known(run.folder, "mlflow"), key
        uri = self._uri(run.settings["mlflow"]["tracking_uri"], known.text("tracking_uri"))
        client = self.clients[key] = self.mlflow.MlflowClient(tracking_uri=uri)
        name = known.run(seed)
        if name is not None:
            self.runs[key] = name
            client.update_run(name, status="RUNNING")
            self.done[key] = self._last_step(client, name)
            return
        experiment = run.settings["mlflow"]["experiment"] or os.environ.get("MLFLOW_EXPERIMENT_NAME") or EXPERIMENT
        found = client.get_experiment_by_name(experiment)
        place = found.experiment_id if found is not None else client.create_experiment(experiment)
        tags = {"mlflow.source.name": "matd3_jax", "run_directory": run.folder}
        if run.sweep is not None:
            tags["sweep"] = run.sweep
        if seed is not None:
            tags["mlflow.parentRunId"] = self.runs[number, None]
        title = run.title if seed is None else f"{run.title}-seed_{seed}"
        self.runs[key] = client.create_run(place, tags=tags, run_name=title).info.run_id
        known.keep(seed, self.runs[key], tracking_uri=uri, experiment=experiment)
        self.where = f"experiment {experiment} at {uri}"
        params = flat({**run.settings, **({} if seed is None else {"seed": seed})})
        entity = self.mlflow.entities.Param
        self._send(key, "params", [entity(name, str(value)) for name, value in params.items()])
        for file in ("config.yaml", "machine.json") if seed is None else ():
            if (Path(run.folder) / file).is_file():
                client.log_artifact(self.runs[key], str(Path(run.folder) / file))

    def describe(self) -> str:
        return f"MLflow: {self.where or 'continues its runs'}"

    def log(self, key: tuple[int, int | None], step: int, values: Numbers) -> None:
        if step <= self.done.get(key, -1):
            return  # it has them from before the run was resumed
        now, entity = int(1000 * time.time()), self.mlflow.entities.Metric
        self._send(key, "metrics", [entity(_allowed(name), value, now, step) for name, value in values.items()])

    def attach(self, key: tuple[int, int | None], step: int, path: Path) -> None:
        folder = "videos" if path.suffix in (".gif", ".mp4") else None
        self.clients[key].log_artifact(self.runs[key], str(path), folder)

    def summarize(self, key: tuple[int, int | None], step: int, values: Numbers) -> None:
        self.done.pop(key, None)
        self.log(key, step, {f"summary/{name}": value for name, value in values.items()})

    def close(self, key: tuple[int, int | None], how: str) -> None:
        status = {FINISHED: "FINISHED", STOPPED: "KILLED"}.get(how, "FAILED")
        self.clients[key].set_terminated(self.runs[key], status)

    def _send(self, key: tuple[int, int | None], what: str, entries: list) -> None:
        size = AT_ONCE[what]
        for first in range(0, len(entries), size):
            self.clients[key].log_batch(self.runs[key], **{what: entries[first : first + size]})

    def _uri(self, wanted: str | None, kept: str | None) -> str:
        """Where the runs are kept. A resumed run stays there, as its settings do; MLFLOW_TRACKING_URI may change."""
        found = (kept or wanted) if wanted else (os.environ.get("MLFLOW_TRACKING_URI") or kept)
        if not found:
            # Without the packages for its database (mlflow-skinny) MLflow has no default.
            found = self.mlflow.get_tracking_uri() if importlib.util.find_spec("sqlalchemy") else "mlruns"
        is_path = ":" not in found and found not in ("databricks", "uc")
        return Path(found).absolute().as_uri() if is_path else found

    @staticmethod
    def _last_step(client: Any, run: str) -> int:
        """The last env step of which a run has numbers; those of a summary are of the last there are."""
        named = [name for name in client.get_run(run).data.metrics if not name.startswith("summary/")]
        counted = [name for name in named if name == "updates"] or named[:1]
        return max((one.step for name in counted for one in client.get_metric_history(run, name)), default=-1)


def _allowed(name: str) -> str:
    """A metric's name in the letters that MLflow takes."""
    return re.sub(r"[^\w\-. :/]", "_", name)
