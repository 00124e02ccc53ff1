"""Fits of continuous dynamics to demonstrations, where values need rollouts.

The gradient of the objective (`likelihood`) needs the agent's policy, and that policy is itself found by gradients
(`policy_gradient`). Both take one step at a time, as in actor–critic methods: one batch of rollouts, from the states of
some demonstrated moves, gives a step of the policy, of its critic and of the model. The policy is therefore always a
little behind the model; `policy_gap` measures by how much.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._repr import short_repr
from sidestep._typing import FloatTree, Tree
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.estimators import Estimator
from sidestep.continuous.likelihood import FitProblem, FitProgress, Schedule
from sidestep.continuous.planner import Planner, PlannerState, plan_policy
from sidestep.continuous.policies import Agent, SomePolicy
from sidestep.continuous.refinement import Visit, refine
from sidestep.continuous.tasks import task_at
from sidestep.continuous.verification import Verification, verify
from sidestep.errors import NotConverged, check, check_function, check_instance, to_count
from sidestep.inference.checkpoints import Checkpoint, Saver, fingerprint
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term

if TYPE_CHECKING:
    from sidestep.continuous.information import RolloutInformation

Family = TypeVar("Family", bound=Dynamics)
_FOLLOWING_RATE = 0.5
"""Where the policy's rate begins before each verification, as a fraction of the first iteration's."""


@short_repr("dynamics", "planner_state", "problem", "message", "converged")
class ContinuousFit(eqx.Module, Generic[Family, SomePolicy]):
    """The result of a fit.

    Attributes:
        dynamics: The family at the learned θ.
        planner_state: The agent's policy, its critic and their optimizers.
        problem: What was maximized: demonstrations, prior, settings; with the dynamics and policy at the start.
        history: A `FitProgress` an iteration.
        verification: How far θ is from the maximum, by independent rollouts.
        converged: Whether the verification's figures are within the tolerances of the schedule.
        message: These figures.
    """

    dynamics: Family
    planner_state: PlannerState[SomePolicy]
    problem: FitProblem
    history: tuple[FitProgress, ...] = eqx.field(static=True)
    verification: Verification
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)

    def information(self, samples: int = 64, seed: int = 0) -> "RolloutInformation":
        """Return the information at the end of the fit, as `sidestep.laplace` needs it.

        Args:
            samples: Rollouts of each candidate action, 2 or more; the more, the smaller `Laplace.simulated`.
            seed: Draws everything random.

        Raises:
            InputError: For a fit that did not converge, an agent with another gradient than its likelihood's, or too
                few samples.
        """
        from sidestep.continuous.information import RolloutInformation

        check(self.converged, f"expected a fit that converged: {self.message}", source="laplace", field="fit")
        return RolloutInformation(
            self.problem, self.dynamics, self.planner_state, samples=samples, seed=seed, message=self.message
        )


class _State(eqx.Module):
    """The state that a fit carries from iteration to iteration.

    `total` is the sum of θ over the last quarter of the iterations.
    """

    parameters: FloatTree
    moments: Tree
    planner_state: Tree
    total: Float[Array, " parameters"]


def fit_dynamics(
    dynamics: Family,
    demonstrations: Demonstrations,
    behavior: Behavior,
    policy: SomePolicy,
    planner: Planner,
    *,
    prior: Prior | None = None,
    terms: tuple[Term, ...] = ALL_TERMS,
    estimator: Estimator = "score",
    schedule: Schedule | None = None,
    seed: int = 0,
    report: Callable[[FitProgress, Family], None] | None = None,
    checkpoint: str | Path | Checkpoint | None = None,
    resume: bool = False,
) -> ContinuousFit[Family, SomePolicy]:
    """Find the parameters of a family of dynamics that maximize the posterior of demonstrations.

    Args:
        dynamics: The family at the initial parameters.
        demonstrations: From `gather_trajectories`; moves of weight 0 are left out.
        behavior: The agent's backup and β.
        policy: The initial policy of the agent.
        planner: Settings of rollouts and of the policy's optimizers.
        prior: Over all parameters, `Normal()` by default.
        terms: "actions", "transitions" or both.
        estimator: "score" (eq. 11), or "pathwise" for reparameterized dynamics and smooth rewards.
        schedule: Length and steps of the fit.
        seed: Draws everything random.
        report: Called with the figures and the present dynamics after every iteration.
        checkpoint: A file that is kept up to date.
        resume: Whether to go on from the checkpoint; the result is that of an uninterrupted fit, bit for bit.

    Returns:
        The learned dynamics, the policy with its critic, and how the fit went.

    Raises:
        InputError: For data or settings that cannot be used.
        NotConverged: For figures that cease to be finite.

    References:
        Eqs. 6, 11 and 12 of the paper.
    """
    agent, schedule = Agent(dynamics, policy, behavior), Schedule() if schedule is None else schedule
    seed = to_count(seed, "seed", 0)
    if report is not None:
        check_function(report, "report")
    demonstrations, prior = moves_that_count(demonstrations), Normal() if prior is None else prior
    problem = FitProblem(agent, demonstrations, prior, planner, schedule, terms, estimator)
    prior.check_parameters(dynamics.parameters)
    saver = Saver(checkpoint, problem_fingerprint((problem, seed)) if checkpoint is not None else "")
    warmup_key, key = jax.random.split(jax.random.key(seed))
    initial_key, warmup_key = jax.random.split(warmup_key)
    state, history = _initialize(problem, initial_key), []
    if resume:
        arrays, records, _ = saver.load(eqx.filter(state, eqx.is_array))
        state = eqx.combine(arrays, state)
        history = [FitProgress(int(record[0]), *record[1:]) for record in records]
    steps = schedule.policy_warmup if "actions" in terms else 0
    if steps and not history:
        starts = demonstrations.tasks, demonstrations.states, demonstrations.task
        plan_seed = int(jax.random.randint(warmup_key, (), 0, 2**31 - 1))
        plan = plan_policy(agent, *starts, planner, steps=steps, seed=plan_seed, warm_start=state.planner_state)
        state = replace(state, planner_state=plan.planner_state)
    for iteration in range(len(history), schedule.iterations):
        state, numbers = _step(problem, state, jax.random.fold_in(key, iteration), jnp.asarray(iteration))
        history.append(FitProgress(iteration, *(float(number) for number in numbers[1:])))
        if not np.isfinite(history[-1]).all():
            reason = "dynamics or rewards that return NaN, or too high a learning rate"
            raise NotConverged(f"the figures ceased to be finite at iteration {iteration}: {reason}")
        saver.save(eqx.filter(state, eqx.is_array), history)
        if report:
            report(history[-1], dynamics.with_parameters(state.parameters))
    return _refined(problem, state, history, jax.random.fold_in(key, schedule.iterations))


def moves_that_count(demonstrations: Demonstrations) -> Demonstrations:
    """Return the moves with a weight above 0: the others may be impossible.

    Args:
        demonstrations: The moves.

    Raises:
        InputError: For anything else, and for no such move.
    """
    check_instance(demonstrations, Demonstrations, "demonstrations")
    counts = np.asarray(demonstrations.weights) > 0
    if counts.all() and len(counts):
        return demonstrations
    check(counts.any(), f"expected moves with a weight above 0, found none of {len(counts)}", field="demonstrations")
    of_moves = ("states", "actions", "next_states", "task", "trajectory", "weights", "truncated", "person")
    arrays = {name: getattr(demonstrations, name) for name in of_moves}
    return replace(
        demonstrations,
        **{name: to_jax(np.asarray(each)[counts]) for name, each in arrays.items() if each is not None},
    )


def problem_fingerprint(problem: Tree) -> str:
    """Return a digest of a problem; functions count by name, because their addresses differ between processes.

    Args:
        problem: Any pytree.

    Returns:
        A hexadecimal digest.
    """
    numbers, rest = eqx.partition(problem, eqx.is_array_like)
    text = f"{jax.tree.structure(problem)} {jax.tree.leaves(rest)}"
    return fingerprint((jax.tree.leaves(numbers), re.sub(r" at 0x[0-9a-f]+", "", text)))


def _initialize(problem: FitProblem, key: PRNGKeyArray) -> _State:
    demos, parameters = problem.demonstrations, problem.agent.dynamics.parameters
    planner_state = problem.planner.initialize(key, problem.agent, task_at(demos.tasks, demos.task), demos.states)
    flat = jax.eval_shape(lambda: ravel_pytree(parameters)[0])
    total = jax.device_put(np.zeros(flat.shape, flat.dtype))
    return _State(parameters, problem.schedule.adam().init(parameters), planner_state, total)


@eqx.filter_jit
def _step(problem: FitProblem, state: _State, key: PRNGKeyArray, iteration: Array) -> tuple[_State, FitProgress]:
    """Make one step of the policy, its critic and the model."""
    schedule, planner_state = problem.schedule, state.planner_state
    model_key, *policy_keys = jax.random.split(key, schedule.policy_steps)
    fraction = schedule.fraction(iteration)
    if "actions" in problem.terms:
        for policy_key in policy_keys:
            planner_state = problem.improve_policy(state.parameters, planner_state, policy_key, fraction)
    planner_state, slope, numbers = problem.objective_gradient(state.parameters, planner_state, model_key, fraction)
    step, moments = schedule.adam().update(slope, state.moments)
    parameters = optax.apply_updates(state.parameters, step)
    late = iteration >= schedule.iterations - _last_quarter(schedule)
    total = state.total + late * ravel_pytree(parameters)[0]
    return _State(parameters, moments, planner_state, total), numbers


def _last_quarter(schedule: Schedule) -> int:
    """Return the number of the iterations in the last quarter."""
    return max(1, schedule.iterations // 4)


def _refined(problem: FitProblem, state: _State, history: list[FitProgress], key: PRNGKeyArray) -> ContinuousFit:
    """Return the result, refined from the mean of θ over the last quarter of the iterations."""
    schedule, keys = problem.schedule, (jax.random.fold_in(key, step) for step in count())
    to_parameters = ravel_pytree(state.parameters)[1]

    def family(flat: np.ndarray) -> Dynamics:
        return problem.agent.dynamics.with_parameters(to_parameters(jnp.asarray(flat, state.total.dtype)))

    def visit(flat: np.ndarray, planner_state: PlannerState[Any], noise: float) -> Visit:
        dynamics, (policy_key, rollout_key) = family(flat), jax.random.split(next(keys))
        if "actions" in problem.terms:
            planner_state = _followed(problem, dynamics.parameters, planner_state, policy_key)
        return Visit(flat, planner_state, verify(problem, dynamics, planner_state, rollout_key, noise=noise))

    mean = np.asarray(state.total, np.float64) / _last_quarter(schedule)
    last = refine(visit(mean, state.planner_state, schedule.step_noise), visit, schedule)
    converged, message = last.verification.passes(schedule), last.verification.message(schedule)
    result = problem, tuple(history), last.verification, converged, message
    return ContinuousFit(family(last.flat), last.planner_state, *result)


def _followed(problem: FitProblem, parameters: FloatTree, state: Tree, key: PRNGKeyArray) -> Tree:
    """Return the policy and its critic after a twelfth of the iterations at one θ, with rates that fall."""
    steps = max(1, problem.schedule.iterations // 12)
    for step, fraction in enumerate(np.geomspace(_FOLLOWING_RATE, _FOLLOWING_RATE / 10, steps).astype(np.float32)):
        state = problem.improve_policy(parameters, state, jax.random.fold_in(key, step), jnp.asarray(fraction))
    return state
