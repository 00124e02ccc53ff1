"""The maximize of a fit: which of its looks save work."""

import jax
import numpy as np

from sidestep.inference import batching, maximize, objective
from sidestep.inference.fit import fit
from sidestep.inference.objective import Objective
from sidestep.inference.optimizers import Rprop
from sidestep.maps.config import SimulationConfig
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import reach
from sidestep.worlds.offices import office
from sidestep.worlds.walks import simulate_walks


def test_states_are_left_out_only_where_a_step_is_tried(monkeypatch):
    """And not once solves are exact; whether a step is taken is decided by all states."""
    for module in (maximize, batching):
        monkeypatch.setattr(module, "LARGE", 1)
    looks, solved, again = [], [], []
    evaluate, of_actions = Objective.evaluate, objective._of_actions

    def watched(self, parameters, starts, tolerance, known, negligible, little):
        looks.append((tolerance, negligible > 0, little > 0))
        found, left = evaluate(self, parameters, starts, tolerance, known, negligible, little)
        assert little > 0 or all(part.everywhere for part in found.parts)
        again.extend(
            part.everywhere
            for part in known
            if little == 0 and all(map(np.array_equal, jax.tree.leaves(part.parameters), jax.tree.leaves(parameters)))
        )
        return found, left

    def of_batch(problem, parameters, batch, starts, everywhere, mesh):
        solved.append((looks[-1], everywhere))
        return of_actions(problem, parameters, batch, starts, everywhere, mesh)

    monkeypatch.setattr(Objective, "evaluate", watched)
    monkeypatch.setattr(objective, "_of_actions", of_batch)
    truth = office(20, 24, 2)
    trajectories, goals = simulate_walks(truth, SimulationConfig(24, 6, reward=Reward(1.0, 1.0)))
    shown = gather(trajectories, [reach(truth.forget(), goal, discount=1.0, step_cost=1.0) for goal in goals])
    found = fit(ObstacleGrid(truth.forget(), 0.0), shown, Behavior(LogSumExp(), 5.0), optimizer=Rprop(tolerance=1.0))
    assert found.converged
    assert {look for look, everywhere in solved if not everywhere} == {(Rprop.exactness, True, True)}
    assert {rough for _, rough, _ in looks} == {False, True}
    # proper looks come after rough ones at the same point, some of whose parts are not of all states
    assert set(again) == {False, True}
    assert all(little == (rough and tolerance == Rprop.exactness) for tolerance, rough, little in looks)
