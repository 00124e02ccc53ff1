"""The objective of a fit, batch by batch, against the likelihood and the prior differentiated directly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.spread import GOALS, STEP, at, demonstrations
from helpers.walled import BLANK
from sidestep.inference.batching import MEMORY, BatchPlan, plan_batches
from sidestep.inference.objective import Objective, Parameters, Problem
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph, grid_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import ALL_TERMS, log_likelihood
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.native import cores
from sidestep.tabular.tasks import reach, task

SOLVERS = {"jacobi": Jacobi(), "gauss_seidel": GaussSeidel()}
BEHAVIOR = Behavior(BoltzmannAverage(), 10.0)
MODEL = ObstacleGrid(BLANK, -2.0)
PRIOR = Normal(-1.0, 1.5)
POINT = MODEL.parameters + STEP
TASKS, STATES = len(GOALS), BLANK.size
ONE_TASK = STATES * 4 * 2 * 8.0
"""The bytes of the probabilities: four actions, two outcomes, numbers of eight bytes."""


class Watched(Objective):
    """Records for each batch that is evaluated whether all states are solved."""

    def __init__(self, *args):
        super().__init__(*args)
        self.calls = []

    def evaluate_batch(self, problem, parameters, batch, start, all_states):
        self.calls.append(all_states)
        return super().evaluate_batch(problem, parameters, batch, start, all_states)


def problem_of(solver=SOLVERS["jacobi"], terms=ALL_TERMS, demos=None, model=MODEL):
    return Problem(
        model, behavior_model(BEHAVIOR), demos or demonstrations(), PRIOR, terms, SolveOptions(solver=solver)
    )


def objective_of(memory, **changes):
    problem = problem_of(**changes)
    return Objective(problem, plan_batches(problem.model, problem.solver, TASKS, memory=memory))


def directly(problem, parameters):
    """The parts of the objective and the gradient of the loss, from all demonstrations and the prior."""

    def loss(parameters):
        likelihood = log_likelihood(
            problem.model.with_parameters(parameters),
            problem.demonstrations,
            BEHAVIOR,
            options=SolveOptions(solver=problem.solver),
        )
        prior = problem.prior.log_density(parameters)
        return -likelihood.total - prior, (likelihood.actions, likelihood.transitions, prior)

    (_, parts), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(parameters)
    return np.array(parts), np.asarray(gradient)


@pytest.mark.parametrize(("name", "memory"), [
    ("jacobi", MEMORY),
    ("jacobi", 46 * ONE_TASK),
    ("jacobi", 1.0),
    ("gauss_seidel", 46 * ONE_TASK),
])  # fmt: skip
@pytest.mark.slow
def test_evaluate_equals_likelihood_and_prior_for_every_batch_size(name, memory):
    objective = objective_of(memory, solver=SOLVERS[name])
    result, _ = objective.evaluate(at(POINT), objective.cold_starts())
    parts, gradient = directly(objective.problem, POINT)
    np.testing.assert_allclose([result.actions, result.transitions, result.prior], parts, rtol=1e-9)
    assert result.objective == pytest.approx(parts.sum(), rel=1e-9)
    np.testing.assert_allclose(result.gradient.model, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())


def test_evaluate_of_one_choice_has_tempered_actions_and_the_prior_of_behavior():
    """Five choices gain 1, two gain nothing, and log β is 3 where it started at 2: with x = σ(−β) all is known."""
    model = TabularModel(graph(np.array([[[1], [1]], [[1], [1]]])), jnp.zeros((2, 2, 1)))
    gain = task(np.array([[1.0, 0.0], [0.0, 0.0]]), 0.9, np.arange(2) == 1)
    demos = gather([Trajectory(np.array([0, 1]), np.array([action]), 0) for action in (0, 0, 1, 0, 0, 1, 0)], [gain])
    agents = behavior_model(Behavior(BoltzmannAverage(), 2.0), ["beta"])
    problem = Problem(model, agents, demos, Normal(0.5, 2.0), ALL_TERMS, SolveOptions(solver=Jacobi()), 0.3)
    objective, beta = Objective(problem), 3.0
    learned = agents.parameters._replace(log_beta=jnp.log(jnp.asarray([beta])))
    result, _ = objective.evaluate(Parameters(model.parameters, learned), objective.cold_starts())
    apart, x = np.log(beta / 2), 1 / (1 + np.exp(beta))
    assert result.actions == pytest.approx(0.3 * (5 * np.log(1 - x) + 2 * np.log(x)), rel=1e-9)
    assert result.prior == pytest.approx(-(apart**2) / 2 - 4 * 0.5**2 / 4, rel=1e-12)
    assert result.transitions == 0
    assert result.objective == pytest.approx(result.actions + result.prior, rel=1e-12)
    slope = result.gradient.behavior.log_beta
    np.testing.assert_allclose(slope, [-0.3 * beta * (5 * x - 2 * (1 - x)) + apart], rtol=1e-9)


def test_batches_of_several_data_sizes_have_equal_shapes():
    """One compiled function serves them all, as long as they fit into one batch."""
    shapes = []
    for goals in (5, 6, 8):
        paths = [Trajectory(np.arange(goal, -1, -1), np.full(goal, 2), 0) for goal in range(1, goals - 3)]
        tasks = [reach(BLANK, 5 * goal % 24) for goal in range(goals)]
        objective = Objective(problem_of(demos=gather(paths, tasks)))
        shapes.append(jax.tree.map(jnp.shape, (objective.batches, objective.arrivals)))
    assert shapes[0] == shapes[1] == shapes[2]


def test_plan_batches_with_less_memory_has_more_batches():
    memories = (MEMORY, 46 * ONE_TASK, 25 * ONE_TASK, 1.0)
    objectives = [objective_of(memory) for memory in memories]
    assert [len(objective.batches) for objective in objectives] == [1, 2, 5, 5]
    for objective in objectives:
        tasks = [np.asarray(batch.choices.counts).sum() for batch in objective.batches]
        assert sum(tasks) == len(objective.problem.demonstrations)
        assert len({batch.tasks.terminal.shape for batch in objective.batches}) == 1


@pytest.mark.parametrize(("tasks", "devices", "expected"), [(5, 1, 8), (5, 4, 8), (8, 4, 8), (3, 4, 4), (9, 2, 16)])
def test_plan_batches_gives_devices_equal_numbers_of_tasks(tasks, devices, expected):
    assert plan_batches(MODEL, Jacobi(), tasks, devices=devices) == (expected, True, False)
    # memory counts per device: six tasks need two batches on one device, and one on two
    sizes = [plan_batches(MODEL, Jacobi(), 6, memory=46 * ONE_TASK, devices=count).size for count in (1, 2)]
    assert sizes == [3, 6]


def test_evaluate_without_memory_for_warm_starts_returns_cold_starts():
    roomy, tight = objective_of(MEMORY), objective_of(1.0)
    assert (roomy.plan.keeps_warm_starts, tight.plan.keeps_warm_starts) == (True, False)
    cold = tight.cold_starts()
    _, left = tight.evaluate(at(POINT), cold)
    assert left is cold
    _, left = roomy.evaluate(at(POINT), roomy.cold_starts())
    assert np.isfinite(left[0].adjoint).all()
    assert (np.asarray(left[0].adjoint) != 0).any()


def test_evaluate_from_warm_starts_equals_from_cold_starts(one_batch):
    objective = one_batch
    cold, starts = objective.evaluate(at(POINT), objective.cold_starts())
    warm, _ = objective.evaluate(at(POINT), starts)
    assert np.mean(warm.solves[0].sweeps) < np.mean(cold.solves[0].sweeps)
    np.testing.assert_allclose(warm[:4], cold[:4], rtol=1e-8)
    np.testing.assert_allclose(
        warm.gradient.model, cold.gradient.model, rtol=1e-7, atol=1e-7 * np.abs(cold.gradient.model).max()
    )


@pytest.fixture(scope="module")
def one_batch():
    """All five tasks in one batch."""
    return Objective(problem_of(SOLVERS["gauss_seidel"]))


@pytest.fixture
def batches():
    """A batch for each of the five tasks; contributions are reused."""
    return Watched(problem_of(SOLVERS["gauss_seidel"]), BatchPlan(1, keeps_warm_starts=True, reuses=True))


def test_evaluate_at_the_same_point_reuses_contributions(batches):
    result, starts = batches.evaluate(at(POINT), batches.cold_starts())
    assert sum(part.actions for part in result.contributions) == result.actions
    changed = [part._replace(actions=2.0**index) for index, part in enumerate(result.contributions)]
    again, left = batches.evaluate(at(POINT), starts, known=changed)
    assert again.actions == 31
    np.testing.assert_array_equal(again.gradient.model, result.gradient.model)
    assert all(one is other for one, other in zip(left, starts, strict=True))
    elsewhere, _ = batches.evaluate(at(POINT + 1e-9), starts, known=changed)
    assert elsewhere.actions == pytest.approx(result.actions, rel=1e-6)


def test_evaluate_solves_only_batches_that_change(batches, one_batch):
    """One parameter is moved so that one task's contribution changes by a nat, and others hardly."""
    result, starts = batches.evaluate(at(POINT), batches.cold_starts())
    gradients = np.abs([part.gradient.model for part in result.contributions])
    rest = gradients.sum(axis=0) - gradients.max(axis=0)
    cell = np.argmin(np.where(gradients.max(axis=0) > 1e-3, rest / gradients.max(axis=0), np.inf))
    move = 1 / gradients[:, cell].max()
    moved = POINT.at[cell].add(move)
    concerned = gradients[:, cell] * move >= 0.1
    assert 0 < concerned.sum() < 5
    again, _ = batches.evaluate(at(moved), starts, known=result.contributions, reuse_below=0.1)
    kept = [now is before for now, before in zip(again.contributions, result.contributions, strict=True)]
    np.testing.assert_array_equal(kept, ~concerned)
    exact, _ = one_batch.evaluate(at(moved), one_batch.cold_starts())
    assert abs(exact.actions - result.actions) > 0.5
    assert again.actions == pytest.approx(exact.actions, abs=0.1)


def test_evaluate_counts_changes_from_where_a_contribution_was_computed(batches):
    """A contribution that is reused twice does not drift by a negligible amount each time."""
    result, starts = batches.evaluate(at(POINT), batches.cold_starts())
    first = result.contributions[0]
    direction = 0.06 * np.sign(first.gradient.model) / np.abs(first.gradient.model).sum()
    once, starts = batches.evaluate(at(POINT + direction), starts, known=result.contributions, reuse_below=0.1)
    assert once.contributions[0] is first
    twice, _ = batches.evaluate(at(POINT + 2 * direction), starts, known=once.contributions, reuse_below=0.1)
    assert twice.contributions[0] is not first


def test_evaluate_after_small_changes_solves_only_states_that_mattered(batches, one_batch):
    result, starts = batches.evaluate(at(POINT), batches.cold_starts())
    moved = at(POINT + 1e-3 * STEP)
    changes = [np.abs(part.gradient.model * 1e-3 * STEP).sum() / abs(part.actions) for part in result.contributions]
    little = float(np.mean(np.sort(changes)[1:3]))
    exact, _ = one_batch.evaluate(moved, one_batch.cold_starts())
    batches.calls.clear()
    again, _ = batches.evaluate(moved, starts, known=result.contributions, partial_below=little)
    assert batches.calls == [not change < little for change in changes]
    assert set(batches.calls) == {False, True}
    np.testing.assert_allclose(again[:4], exact[:4], rtol=1e-8)
    batches.calls.clear()
    batches.evaluate(moved, starts, known=result.contributions)
    batches.evaluate(moved, starts, partial_below=little)
    assert batches.calls == [True] * 10


def test_evaluate_solves_states_that_come_to_matter(batches, one_batch):
    """If the states that mattered do not give a gradient, all states are solved."""
    result, starts = batches.evaluate(at(POINT), batches.cold_starts())
    moved = at(POINT + 0.1 * STEP)
    exact, _ = one_batch.evaluate(moved, one_batch.cold_starts())
    wrong_starts = [start._replace(adjoint=jnp.zeros_like(start.adjoint).at[:, 12].set(1.0)) for start in starts]
    batches.calls.clear()
    again, left = batches.evaluate(moved, wrong_starts, known=result.contributions, partial_below=np.inf)
    assert batches.calls == [False, True] * 5
    np.testing.assert_allclose(again[:4], exact[:4], rtol=1e-8)
    np.testing.assert_allclose(again.gradient.model, exact.gradient.model, rtol=1e-7, atol=1e-7)
    assert all(np.isfinite(start.adjoint).all() for start in left)


def test_evaluate_does_not_repeat_solves_that_fail(batches):
    """All states would not help. After them, contributions are NaN, and all states are solved."""
    result, starts = batches.evaluate(at(POINT), batches.cold_starts())
    hasty = Watched(problem_of(GaussSeidel(max_sweeps=1)), BatchPlan(1, keeps_warm_starts=True, reuses=True))
    again, _ = hasty.evaluate(at(POINT + STEP), starts, known=result.contributions, partial_below=np.inf)
    assert np.isnan(again.objective)
    assert hasty.calls == [False] * 5
    batches.calls.clear()
    batches.evaluate(at(POINT), starts, known=again.contributions, partial_below=np.inf)
    assert batches.calls == [True] * 5


def test_plan_batches_for_reuse_on_a_large_map_has_a_task_per_core():
    large, small = (ObstacleGrid(Grid.unknown(100, columns), 0.0) for columns in (100, 99))
    tasks = 2 * cores()
    assert plan_batches(large, GaussSeidel(), tasks, reuse=True) == (cores(), True, True)
    for model, solver, devices, reuse in (
        (small, GaussSeidel(), 1, True),
        (large, Jacobi(), 1, True),
        (large, GaussSeidel(), 2, True),
        (large, GaussSeidel(), 1, False),
    ):
        assert plan_batches(model, solver, tasks, devices=devices, reuse=reuse) == (tasks, True, False)


def test_plan_batches_with_little_memory_drops_contributions_before_warm_starts():
    """In a `TabularModel`, which has a parameter per outcome, they are larger than warm starts."""
    graph = grid_graph(Grid.unknown(100, 100))
    model = TabularModel(graph, jnp.zeros(graph.successors.shape))
    kept = [
        plan_batches(model, GaussSeidel(), 100, memory=memory, reuse=True)[1:] for memory in (2.0**32, 2.0**27, 2.0**22)
    ]
    assert kept == [(True, True), (True, False), (False, False)]


def test_objective_of_transitions_alone_has_no_batches():
    problem = problem_of(terms=("transitions",))
    objective = Objective(problem)
    assert (objective.batches, objective.cold_starts()) == ([], [])
    result, starts = objective.evaluate(at(POINT), [])
    transitions = log_likelihood(MODEL.with_parameters(POINT), problem.demonstrations, BEHAVIOR).transitions
    assert (result.actions, result.solves, starts) == (0.0, [], [])
    assert result.transitions == pytest.approx(float(transitions), rel=1e-12)
    assert result.objective == result.transitions + result.prior


@pytest.mark.slow
def test_evaluate_in_32_bits_stays_in_32_bits():
    model = ObstacleGrid(BLANK, jnp.full(STATES, -2.0, jnp.float32))
    objective = Objective(problem_of(model=model))
    parameters = POINT.astype(jnp.float32)
    result, starts = objective.evaluate(at(parameters), objective.cold_starts())
    assert result.gradient.model.dtype == starts[0].values.dtype == starts[0].adjoint.dtype == np.float32
    parts, gradient = directly(problem_of(), POINT)
    np.testing.assert_allclose([result.actions, result.transitions, result.prior], parts, rtol=1e-4)
    np.testing.assert_allclose(result.gradient.model, gradient, atol=1e-3 * np.abs(gradient).max())


@pytest.mark.slow
def test_evaluate_with_a_failed_solve_is_nan():
    objective = Objective(problem_of(Jacobi(max_sweeps=2)))
    result, _ = objective.evaluate(at(POINT), objective.cold_starts())
    assert np.isnan(result.objective)
    assert not np.asarray(result.solves[0].converged)[:TASKS].any()


def test_padding_of_a_batch_contributes_nothing():
    """Two batches of three tasks, of which there are five: the sixth is padding."""
    objective = objective_of(46 * ONE_TASK)
    result, _ = objective.evaluate(at(POINT), objective.cold_starts())
    last = result.solves[-1]
    assert (len(objective.batches), len(last.converged)) == (2, 3)
    assert np.asarray(objective.batches[-1].tasks.terminal)[-1].all()
    assert np.asarray(last.converged).all()
    assert not np.asarray(last.unreachable).any()
