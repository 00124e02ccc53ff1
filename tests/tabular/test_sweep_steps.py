"""Single steps of Gauss–Seidel iteration: a state's own equation, and the sweep in which no state sees another."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import logsumexp

from helpers.numbered_worlds import NO_COSTS, numbered_process, order_of, some_map
from sidestep.tabular.solvers.native import BOLTZMANN, LOG_SUM_EXP, NativeBackup, compiled
from sidestep.tabular.solvers.sweep_loop import SweepLoop
from sidestep.tabular.solvers.value_kernels import Scratch, own_root
from sidestep.tabular.tasks import reach

BETA = 5.0


@compiled()
def root_of(backup, exit_values, exit_weights, guess, repeat_value):
    scratch = Scratch(exit_values, exit_weights, np.empty_like(exit_values))
    return own_root(len(exit_values), backup, len(exit_values), guess, repeat_value, scratch)


@pytest.mark.parametrize("guess", [10.0, 100.0])
def test_own_root_of_the_log_sum_exp_from_far_above_is_near_the_root(guess):
    """Far above it, the action that hardly leaves seems best, and a step along its slope ends far below."""
    exit_values, exit_weights = np.array([-1.0, -1.0]), np.array([1.0, 1e-3])
    root = brentq(lambda value: logsumexp(BETA * (exit_values - exit_weights * value)), -2, 0, xtol=1e-14)
    backup = NativeBackup(LOG_SUM_EXP, np.float64(BETA), np.float64(0))
    repeat_value = (exit_values / exit_weights).max()
    assert abs(repeat_value - root) > 1e-3
    assert root_of(backup, exit_values, exit_weights, guess, repeat_value) == pytest.approx(root, abs=1e-5)


@pytest.mark.parametrize("kind", [BOLTZMANN, LOG_SUM_EXP], ids=["Boltzmann", "log-sum-exp"])
def test_jacobi_sweep_solves_each_state_as_if_it_were_the_only_one(kind):
    """Where values change, too: no state sees what the others become, and none is moved along with another."""
    model = some_map(6, 7)
    task, states = reach(model.graph, 5, discount=0.99), model.graph.states
    order = order_of(model, task)
    process, backup = numbered_process(model, task, order), NativeBackup(kind, np.float64(1), np.float64(0))
    values = -np.sort(np.random.default_rng(0).uniform(0, 1, states))
    values[0] = 1
    nearer = process.successors.min(axis=(1, 2))  # what each state is moved along with, elsewhere

    def swept(positions):
        rules = backup, NO_COSTS, np.float64(1e-10), 100, 100
        loop = SweepLoop(process, values.copy(), nearer.copy(), np.asarray(positions, np.int32), *rules)
        return loop.jacobi_sweep()[0], loop.values

    residual, together = swept(np.arange(states))
    alone = [swept([position]) for position in range(states)]
    np.testing.assert_array_equal(together, [own[1][position] for position, own in enumerate(alone)])
    assert residual == max(own[0] for own in alone)
    assert (together != values).mean() > 0.9
