"""The objective of a fit, batch by batch, beside the likelihood and the prior differentiated directly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.spread import BENT, GOALS, at, demonstrations
from helpers.walled import BLANK
from sidestep.inference import batching
from sidestep.inference.batching import planned
from sidestep.inference.objective import MEMORY, Objective, Problem, _of_actions
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import grid_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import ALL_TERMS, log_likelihood
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.native import cores
from sidestep.tabular.tasks import reach

SOLVERS = {"jacobi": Jacobi(), "ordered": GaussSeidel()}
PEOPLE = Behavior(BoltzmannAverage(), 10.0)
MODEL = ObstacleGrid(BLANK, -2.0)
PRIOR = Normal(-1.0, 3.0)
POINT = MODEL.parameters + BENT
TASKS, STATES = len(GOALS), BLANK.size
ONE_TASK = STATES * 4 * 2 * 8.0
"""The bytes of one model's probabilities: four actions, two outcomes, numbers of eight bytes."""


def problem_of(solver=SOLVERS["jacobi"], terms=ALL_TERMS, shown=None, model=MODEL):
    return Problem(model, behavior_model(PEOPLE), shown or demonstrations(), PRIOR, terms, SolveOptions(solver=solver))


def directly(problem, parameters):
    """The parts and the slope of the loss, from the likelihood of all demonstrations and the prior."""

    def loss(parameters):
        likelihood = log_likelihood(
            problem.model.with_parameters(parameters),
            problem.demonstrations,
            PEOPLE,
            options=SolveOptions(solver=problem.solver),
        )
        prior = problem.prior.log_density(parameters)
        return -likelihood.total - prior, (likelihood.actions, likelihood.transitions, prior)

    (_, parts), slope = jax.jit(jax.value_and_grad(loss, has_aux=True))(parameters)
    return np.array(parts), np.asarray(slope)


@pytest.mark.parametrize("memory", [MEMORY, 46 * ONE_TASK, 1.0])
@pytest.mark.parametrize("name", SOLVERS)
def test_batches_add_up_to_the_likelihood_and_the_prior(name, memory):
    problem = problem_of(SOLVERS[name])
    objective = Objective(problem, memory)
    found, _ = objective.evaluate(at(POINT), objective.cold_starts())
    parts, slope = directly(problem, POINT)
    np.testing.assert_allclose([found.actions, found.transitions, found.prior], parts, rtol=1e-9)
    assert found.objective == pytest.approx(parts.sum(), rel=1e-9)
    np.testing.assert_allclose(found.slope.model, slope, rtol=1e-9, atol=1e-9 * np.abs(slope).max())


def test_one_compiled_function_serves_data_of_many_sizes():
    """More walks and goals come in arrays of the same shapes, as long as they fit into one batch."""
    shapes = []
    for goals in (5, 6, 8):
        walks = [Trajectory(np.arange(goal, -1, -1), np.full(goal, 2), 0) for goal in range(1, goals - 3)]
        tasks = [reach(BLANK, 5 * goal % 24) for goal in range(goals)]
        objective = Objective(problem_of(shown=gather(walks, tasks)), MEMORY)
        shapes.append(jax.tree.map(jnp.shape, (objective.batches, objective.arrivals)))
    assert shapes[0] == shapes[1] == shapes[2]


def test_the_less_memory_the_more_batches():
    memories = (MEMORY, 46 * ONE_TASK, 25 * ONE_TASK, 1.0)
    objectives = [Objective(problem_of(), memory) for memory in memories]
    assert [len(objective.batches) for objective in objectives] == [1, 2, 5, 5]
    for objective in objectives:
        tasks = [np.asarray(batch.choices.counts).sum() for batch in objective.batches]
        assert sum(tasks) == len(objective.problem.demonstrations)
        assert len({batch.tasks.terminal.shape for batch in objective.batches}) == 1


@pytest.mark.parametrize(("tasks", "devices", "expected"), [(5, 1, 8), (5, 4, 8), (8, 4, 8), (3, 4, 4), (9, 2, 16)])
def test_devices_share_tasks_equally(tasks, devices, expected):
    assert planned(MODEL, Jacobi(), tasks, MEMORY, devices) == (expected, True, False)


def test_memory_is_that_of_each_device():
    """Six tasks need two batches on one device, and one on two devices."""
    memory = 46 * ONE_TASK
    assert planned(MODEL, Jacobi(), 6, memory, 1)[0] == 3
    assert planned(MODEL, Jacobi(), 6, memory, 2)[0] == 6


def test_starts_are_dropped_where_there_is_no_room():
    roomy, tight = Objective(problem_of(), MEMORY), Objective(problem_of(), 1.0)
    assert (roomy.planned.keeps_starts, tight.planned.keeps_starts) == (True, False)
    cold = tight.cold_starts()
    _, left = tight.evaluate(at(POINT), cold)
    assert left is cold
    _, left = roomy.evaluate(at(POINT), roomy.cold_starts())
    assert np.isfinite(left[0].adjoint).all()
    assert (np.asarray(left[0].adjoint) != 0).any()


@pytest.mark.parametrize("name", SOLVERS)
def test_where_solves_start_makes_no_difference(name):
    objective = Objective(problem_of(SOLVERS[name]), MEMORY)
    cold, starts = objective.evaluate(at(POINT), objective.cold_starts())
    warm, _ = objective.evaluate(at(POINT), starts)
    assert np.mean(warm.solved[0].sweeps) < np.mean(cold.solved[0].sweeps)
    np.testing.assert_allclose(warm[:4], cold[:4], rtol=1e-8)
    np.testing.assert_allclose(
        warm.slope.model, cold.slope.model, rtol=1e-7, atol=1e-7 * np.abs(cold.slope.model).max()
    )


@pytest.fixture
def a_task_a_batch(monkeypatch):
    """An objective with a batch for each of its five tasks, whose parts are taken over, and one with all in one."""
    monkeypatch.setattr(batching, "LARGE", 1)
    monkeypatch.setattr(batching, "cores", lambda: 1)
    problem = problem_of(SOLVERS["ordered"])
    objective, whole = Objective(problem, MEMORY, takes_over=True), Objective(problem, MEMORY)
    assert (len(objective.batches), objective.planned.takes_over, len(whole.batches)) == (5, True, 1)
    return objective, whole


def test_what_a_batch_added_at_the_same_point_is_taken_over(a_task_a_batch):
    objective, _ = a_task_a_batch
    found, starts = objective.evaluate(at(POINT), objective.cold_starts())
    assert sum(part.actions for part in found.parts) == found.actions
    marked = [part._replace(actions=2.0**index) for index, part in enumerate(found.parts)]
    again, left = objective.evaluate(at(POINT), starts, known=marked)
    assert again.actions == 31
    np.testing.assert_array_equal(again.slope.model, found.slope.model)
    assert all(one is other for one, other in zip(left, starts, strict=True))
    elsewhere, _ = objective.evaluate(at(POINT + 1e-9), starts, known=marked)
    assert elsewhere.actions == pytest.approx(found.actions, rel=1e-6)


def test_only_batches_that_a_change_concerns_are_solved_anew(a_task_a_batch):
    """One parameter is moved by as much as would change one task's part by a nat, and others hardly."""
    objective, whole = a_task_a_batch
    found, starts = objective.evaluate(at(POINT), objective.cold_starts())
    slopes = np.abs([part.slope.model for part in found.parts])
    rest = slopes.sum(axis=0) - slopes.max(axis=0)
    cell = np.argmin(np.where(slopes.max(axis=0) > 1e-3, rest / slopes.max(axis=0), np.inf))
    move = 1 / slopes[:, cell].max()
    moved = POINT.at[cell].add(move)
    concerned = slopes[:, cell] * move >= 0.1
    assert 0 < concerned.sum() < 5
    again, _ = objective.evaluate(at(moved), starts, known=found.parts, negligible=0.1)
    kept = [now is before for now, before in zip(again.parts, found.parts, strict=True)]
    np.testing.assert_array_equal(kept, ~concerned)
    exact, _ = whole.evaluate(at(moved), whole.cold_starts())
    assert abs(exact.actions - found.actions) > 0.5
    assert again.actions == pytest.approx(exact.actions, abs=0.1)


def test_what_changed_since_is_counted_from_where_a_part_was_solved(a_task_a_batch):
    """A part that was taken over twice does not drift away by less than is negligible each time."""
    objective, _ = a_task_a_batch
    found, starts = objective.evaluate(at(POINT), objective.cold_starts())
    first = found.parts[0]
    direction = 0.06 * np.sign(first.slope.model) / np.abs(first.slope.model).sum()
    once, starts = objective.evaluate(at(POINT + direction), starts, known=found.parts, negligible=0.1)
    assert once.parts[0] is first
    twice, _ = objective.evaluate(at(POINT + 2 * direction), starts, known=once.parts, negligible=0.1)
    assert twice.parts[0] is not first


@pytest.fixture
def evaluated(monkeypatch):
    """For each batch that is evaluated, whether all states were to be solved."""
    asked = []

    def of_actions(problem, parameters, batch, starts, everywhere, mesh):
        asked.append(everywhere)
        return _of_actions(problem, parameters, batch, starts, everywhere, mesh)

    monkeypatch.setattr("sidestep.inference.objective._of_actions", of_actions)
    return asked


def test_where_little_has_changed_only_states_that_mattered_are_solved(a_task_a_batch, evaluated):
    objective, whole = a_task_a_batch
    found, starts = objective.evaluate(at(POINT), objective.cold_starts())
    moved = at(POINT + 1e-3 * BENT)
    changes = [np.abs(part.slope.model * 1e-3 * BENT).sum() / abs(part.actions) for part in found.parts]
    little = float(np.mean(np.sort(changes)[1:3]))
    exact, _ = whole.evaluate(moved, whole.cold_starts())
    evaluated.clear()
    again, _ = objective.evaluate(moved, starts, known=found.parts, little=little)
    assert evaluated == [not change < little for change in changes]
    assert set(evaluated) == {False, True}
    np.testing.assert_allclose(again[:4], exact[:4], rtol=1e-8)
    evaluated.clear()
    objective.evaluate(moved, starts, known=found.parts)
    objective.evaluate(moved, starts, little=little)
    assert evaluated == [True] * 10


def test_states_that_come_to_matter_are_solved_after_all(a_task_a_batch, evaluated):
    """Where solves of the states that are said to matter leave no gradient, all states are solved."""
    objective, whole = a_task_a_batch
    found, starts = objective.evaluate(at(POINT), objective.cold_starts())
    moved = at(POINT + 0.1 * BENT)
    exact, _ = whole.evaluate(moved, whole.cold_starts())
    hardly_any = [start._replace(adjoint=jnp.zeros_like(start.adjoint).at[:, 12].set(1.0)) for start in starts]
    evaluated.clear()
    again, left = objective.evaluate(moved, hardly_any, known=found.parts, little=np.inf)
    assert evaluated == [False, True] * 5
    np.testing.assert_allclose(again[:4], exact[:4], rtol=1e-8)
    np.testing.assert_allclose(again.slope.model, exact.slope.model, rtol=1e-7, atol=1e-7)
    assert all(np.isfinite(start.adjoint).all() for start in left)


def test_values_that_fail_are_not_solved_again(a_task_a_batch, evaluated):
    """They would do no better. And where nothing is known of a part, all states are solved."""
    objective, _ = a_task_a_batch
    found, starts = objective.evaluate(at(POINT), objective.cold_starts())
    hasty = Objective(problem_of(GaussSeidel(max_sweeps=1)), MEMORY, takes_over=True)
    evaluated.clear()
    again, _ = hasty.evaluate(at(POINT + BENT), starts, known=found.parts, little=np.inf)
    assert np.isnan(again.objective)
    assert evaluated == [False] * 5
    evaluated.clear()
    objective.evaluate(at(POINT), starts, known=again.parts, little=np.inf)
    assert evaluated == [True] * 5


def test_long_solves_to_take_over_come_in_batches_of_no_more_tasks_than_cores():
    large, small = (ObstacleGrid(Grid.unknown(100, columns), 0.0) for columns in (100, 99))
    tasks = 2 * cores()
    assert planned(large, GaussSeidel(), tasks, MEMORY, 1, takes_over=True) == (cores(), True, True)
    for model, solver, devices, asked in (
        (small, GaussSeidel(), 1, True),
        (large, Jacobi(), 1, True),
        (large, GaussSeidel(), 2, True),
        (large, GaussSeidel(), 1, False),
    ):
        assert planned(model, solver, tasks, MEMORY, devices, takes_over=asked) == (tasks, True, False)


def test_where_memory_is_short_parts_go_before_starts():
    """In a table, where every outcome has a parameter, they are larger than starts."""
    graph = grid_graph(Grid.unknown(100, 100))
    model = TabularModel(graph, jnp.zeros(graph.successors.shape))
    kept = [
        planned(model, GaussSeidel(), 100, memory, 1, takes_over=True)[1:] for memory in (2.0**32, 2.0**27, 2.0**22)
    ]
    assert kept == [(True, True), (True, False), (False, False)]


def test_transitions_alone_need_no_batches():
    problem = problem_of(terms=("transitions",))
    objective = Objective(problem, MEMORY)
    assert (objective.batches, objective.cold_starts()) == ([], [])
    found, starts = objective.evaluate(at(POINT), [])
    transitions = log_likelihood(MODEL.with_parameters(POINT), problem.demonstrations, PEOPLE).transitions
    assert (found.actions, found.solved, starts) == (0.0, [], [])
    assert found.transitions == pytest.approx(float(transitions), rel=1e-12)
    assert found.objective == found.transitions + found.prior


@pytest.mark.parametrize("name", SOLVERS)
def test_32_bit_parameters(name):
    model = ObstacleGrid(BLANK, jnp.full(STATES, -2.0, jnp.float32))
    objective = Objective(problem_of(SOLVERS[name], model=model), MEMORY)
    parameters = POINT.astype(jnp.float32)
    found, starts = objective.evaluate(at(parameters), objective.cold_starts())
    assert found.slope.model.dtype == starts[0].values.dtype == starts[0].adjoint.dtype == np.float32
    parts, slope = directly(problem_of(), POINT)
    np.testing.assert_allclose([found.actions, found.transitions, found.prior], parts, rtol=1e-4)
    np.testing.assert_allclose(found.slope.model, slope, atol=1e-3 * np.abs(slope).max())


def test_a_solve_that_fails_makes_the_objective_nan():
    objective = Objective(problem_of(Jacobi(max_sweeps=2)), MEMORY)
    found, _ = objective.evaluate(at(POINT), objective.cold_starts())
    assert np.isnan(found.objective)
    assert not np.asarray(found.solved[0].converged)[:TASKS].any()


def test_tasks_that_fill_up_a_batch_count_for_nothing():
    """Two batches of three tasks, of which there are five: the sixth has ended."""
    objective = Objective(problem_of(), 46 * ONE_TASK)
    found, _ = objective.evaluate(at(POINT), objective.cold_starts())
    last = found.solved[-1]
    assert (len(objective.batches), len(last.converged)) == (2, 3)
    assert np.asarray(objective.batches[-1].tasks.terminal)[-1].all()
    assert np.asarray(last.converged).all()
    assert not np.asarray(last.stuck).any()
