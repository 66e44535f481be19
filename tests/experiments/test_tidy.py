"""The experiments' tidy tables: means over episodes, thinning, files."""

import numpy as np
from study_cases import table_of

from experiments import tidy
from experiments.tidy import Table


def test_the_mean_of_the_last_episodes_by_hand():
    episodes = np.array([[600, 600, 0, 800, 200]])
    values = np.array([[1.0, 2.0, np.nan, 4.0, 10.0]])
    # 600 x 1 | 400 x 1 + 600 x 2 | the same | 200 x 2 + 800 x 4 | 800 x 4 + 200 x 10, each over the last 1,000
    np.testing.assert_allclose(tidy.trailing_mean(episodes, values, 1000), [[1.0, 1.6, 1.6, 3.6, 5.2]])
    table = table_of({(("algo", "matd3"),): {"return_agents": [np.zeros(2), [1, 3], [5, 7]]}}, seeds=2)
    assert tidy.window(table) == 600  # a fifth of 3,000 episodes
    np.testing.assert_allclose(tidy.final(table, "return_agents"), [5, 7])
    np.testing.assert_allclose(tidy.along(table, "return_agents"), [3, 5])  # without the untrained row


def test_thinned_rows_keep_every_mean():
    rng = np.random.default_rng(0)
    metrics = {"seed": np.zeros(200), "step": 25.0 * np.arange(1, 201), "updates": np.arange(200.0)}
    metrics |= {"episodes": rng.integers(10, 90, 200).astype(float), "return_agents": rng.normal(size=200)}
    metrics["eval_return_agents"] = np.where(np.arange(200) % 10 == 9, np.arange(200.0), np.nan)
    thin = tidy.thin(metrics, 20)
    assert 35 < len(thin["step"]) < 45  # 20 and those of the last 1,000 episodes, some 20
    assert thin["episodes"].sum() == metrics["episodes"].sum()
    np.testing.assert_allclose(
        (thin["episodes"] * thin["return_agents"]).sum(), (metrics["episodes"] * metrics["return_agents"]).sum()
    )
    assert [thin[name][0] for name in metrics][:-1] == [metrics[name][0] for name in metrics][:-1]
    for weights, values in ((thin["episodes"], thin["return_agents"]), (metrics["episodes"], metrics["return_agents"])):
        last = tidy.trailing_mean(weights[None], values[None], 1000)[0, -1]
        np.testing.assert_allclose(last, np.average(np.repeat(*_reversed(metrics))[:1000]))
    assert thin["eval_return_agents"][-1] == 199  # the last evaluation there is
    assert tidy.thin(metrics, 300)["step"].tolist() == metrics["step"].tolist()


def _reversed(metrics):
    """Every single episode's return, the last one first."""
    return metrics["return_agents"][::-1], metrics["episodes"][::-1].astype(int)


def test_csv_gives_the_table_back(tmp_path):
    table = Table({"env": np.array(["a", "b"]), "step": np.array([1500500.0, 2]), "x": np.array([np.nan, 1 / 3])})
    tidy.write(table, tmp_path / "data.csv")
    assert (tmp_path / "data.csv").read_text() == "env,step,x\na,1500500,nan\nb,2,0.333333\n"
    again = tidy.read(tmp_path / "data.csv")
    assert again["env"].tolist() == ["a", "b"] and again["step"].tolist() == [1500500, 2]
    assert len(again.where(env="b", step=2)) == 1 and len(again.where(algo="c")) == 0
