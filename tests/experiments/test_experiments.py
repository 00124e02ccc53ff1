"""The paper's variants of learning on one world, and the demonstration in a small office."""

import json

import numpy as np
import pytest
from PIL import Image

import sidestep as ss
from sidestep.experiments import demo
from sidestep.experiments.reproduce import VARIANTS, ReproduceConfig, reproduce, simulate_walks
from sidestep.maps.config import SimulationConfig
from sidestep.tabular.graph import walkable_graph
from sidestep.worlds.grids import block

pytestmark = pytest.mark.slow

SCORES = {
    "auc", "average_precision", "auc_relevant", "mean_obstacle", "mean_free", "max_probability", "legal_fraction",
    "excess_length",
}  # fmt: skip


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """The experiments on the block only, discounted more, which takes fewer sweeps: the folder and its summary."""
    folder, lines = tmp_path_factory.mktemp("figures"), []
    config = ReproduceConfig(("block",), beta=20.0, reward=ss.Reward(0.9))
    summary = reproduce(folder, seed=0, notify=lines.append, config=config)
    assert len(lines) == 4
    return folder, summary


def test_variants_are_those_of_the_paper():
    assert {name: (variant.terms, variant.gradient) for name, variant in VARIANTS.items()} == {
        "bam": (("actions", "transitions"), "fixed_policy"),
        "bam_exact": (("actions", "transitions"), "exact"),
        "actions_only": (("actions",), "fixed_policy"),
        "transitions_only": (("transitions",), "exact"),
    }
    kinds = {"fixed_policy": ss.Adam, "exact": ss.LBFGS}
    assert all(isinstance(variant.optimizer, kinds[variant.gradient]) for variant in VARIANTS.values())


def test_reproduce_writes_figures_and_numbers(reproduced):
    folder, summary = reproduced
    assert {path.name for path in folder.iterdir()} == {
        "figure1.png", "figure2.png", "figure3.png", "figure4.png", "summary.json",
    }  # fmt: skip
    for path in folder.glob("*.png"):
        with Image.open(path) as picture:
            assert min(picture.size) > 100
    assert json.loads((folder / "summary.json").read_text()) == summary
    assert set(summary["maps"]) == {"block"}
    assert set(summary["maps"]["block"]) == set(VARIANTS)
    for scores in summary["maps"]["block"].values():
        assert set(scores) >= SCORES
        assert scores["converged"]


def test_reproduce_finds_the_block_by_actions(reproduced):
    bam, exact, actions, transitions = (reproduced[1]["maps"]["block"][name] for name in VARIANTS)
    for scores in (bam, exact):
        assert scores["auc"] >= 0.95
        assert scores["mean_obstacle"] >= 0.4
        assert scores["mean_free"] <= 0.1
        assert scores["legal_fraction"] >= 0.97
        assert scores["legal_fraction"] > transitions["legal_fraction"]
    assert transitions["max_probability"] < 0.2
    assert actions["mean_free"] > bam["mean_free"]


def test_simulate_walks_returns_optimal_walks_with_random_ties():
    world = block()
    paths = simulate_walks(world, ReproduceConfig(), seed=0).paths()
    assert len(paths) == 10 * len(world.starts) * len(world.goals)
    legal = walkable_graph(world.truth).toarray() > 0
    assert all(legal[path[:-1], path[1:]].all() for path in paths)
    from_start_to_corner = {tuple(path) for path in paths if (path[0], path[-1]) == (0, 80)}
    assert {len(path) for path in from_start_to_corner} == {17}
    assert len(from_start_to_corner) > 3
    again = simulate_walks(world, ReproduceConfig(), seed=0).paths()
    assert [path.tolist() for path in again] == [path.tolist() for path in paths]


def test_demo_in_a_small_office_writes_map_and_numbers(tmp_path):
    config = demo.DemoConfig(rows=10, columns=10, agents=SimulationConfig(walks=60, goals=5))
    lines = []
    summary = demo.demo(tmp_path, seed=1, notify=lines.append, config=config)
    assert len(lines) == 3
    assert json.loads((tmp_path / "summary.json").read_text()) == json.loads(json.dumps(summary))
    assert set(summary["scores"]) >= SCORES
    assert summary["scores"]["auc"] > 0.7
    assert {path.name for path in tmp_path.iterdir()} == {
        "demo.png", "learned", "office.pgm", "office.yaml", "summary.json", "truth.pgm", "truth.yaml", "walks.csv",
    }  # fmt: skip
    learned = ss.load_map(tmp_path / "learned")
    assert learned.unknown.all()  # nothing of the office was known
    assert learned.blocked.shape == (10, 10)
    assert np.isfinite(learned.blocked).all()
