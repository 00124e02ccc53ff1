"""Values and likelihood of a chain's map before any proposal, as `solve` and `log_likelihood` have them."""

import jax
import numpy as np
import pytest

from helpers.barrier_worlds import COSTLY, DISCOUNTED, KINDS, exact_model, world
from sidestep.inference.chains import barrier_problem
from sidestep.tabular.backups import LogSumExp
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models.barriers import barriers_of
from sidestep.tabular.solve import solve


@pytest.mark.filterwarnings("ignore:agents of task 0 avoid its goal")  # as they do at this β
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "8 moves"])
@pytest.mark.parametrize("reward", [DISCOUNTED, COSTLY], ids=["discounted", "costly"])
def test_solve_of_a_chain_has_the_values_and_likelihood_of_its_map(kind, reward):
    one = world(kind, reward, LogSumExp(), beta=3.0, lapse=0.1)
    model, agents = one.model, behavior_model(one.behavior)
    problem = barrier_problem(
        barriers_of(model), one.demonstrations, agents, one.prior, available=model.graph.available
    )
    for fraction in (0.0, 0.5):
        closed = np.random.default_rng(0).random(len(problem.barriers.known)) < fraction
        state = problem.start(closed, 1, np.random.default_rng(0))
        np.testing.assert_array_equal(state.chain.closed[problem.free], closed[problem.free])
        problem.solve(state.chain)
        tasks = [jax.tree.map(lambda leaf, at=at: leaf[at], one.demonstrations.tasks) for at in range(2)]
        expected = [solve(exact_model(model, state.chain.closed), task, one.behavior).values for task in tasks]
        np.testing.assert_allclose(state.chain.values, expected, rtol=1e-6, atol=1e-6)
        problem.refresh(state.chain, state.work)
        likelihood = log_likelihood(exact_model(model, state.chain.closed), one.demonstrations, one.behavior)
        np.testing.assert_allclose(state.chain.totals, np.array(likelihood), rtol=1e-4, atol=1e-3)
