"""The exact posterior of few barriers, by the likelihood of every map: the standard that samplers are compared with."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._repr import short_repr
from sidestep.errors import NotConverged, check, to_count
from sidestep.inference.arguments import check_evidence
from sidestep.inference.chain_evidence import PASSING, crossed_barriers
from sidestep.inference.chains import check_possible, check_prior
from sidestep.inference.hierarchical import HierarchicalMRF, as_hierarchical, evidence_normalizers
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel, as_behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import (
    ALL_TERMS,
    Arrivals,
    Choices,
    Terms,
    arrival_log_likelihood,
    arrivals_of,
    choice_log_likelihood,
    choices_of,
)
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.models.barriers import barriers_of
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solve import SolveOptions, default_solver
from sidestep.tabular.tasks import Task

MAX_BARRIERS = 16
"""The most unknown barriers; each doubles the number of maps."""
_BATCH = 128
"""The number of maps that are evaluated at once."""


@short_repr()
class ExactPosterior(NamedTuple):
    """The exact posterior of barriers.

    Attributes:
        closed: P(closed) of each barrier; exactly 0 or 1 where it is known or was crossed.
        log_evidence: ln Σ L(z) p(z), with the prior up to its constant, and the actions' part of L to the power κ.
    """

    closed: Float[np.ndarray, " barriers"]
    log_evidence: float


def enumerate_barriers(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    prior: BinaryMRF | HierarchicalMRF,
    *,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
    seed: int = 0,
) -> ExactPosterior:
    """Return the exact posterior of at most 16 unknown barriers, from the likelihood of each of the 2ⁿ maps.

    Args:
        model: The transition model; see `barriers_of`.
        demonstrations: The moves and tasks.
        behavior: The behavior of the agents, or a fitted `BehaviorModel`; it stays as it is.
        prior: The prior of the barriers; the density and strength of a `HierarchicalMRF` are summed over.
        tempering: κ, the weight of the actions' log-likelihood.
        terms: The parts of the likelihood that count.
        seed: The seed of the chains that find log Z of a `HierarchicalMRF`, as for `sample_barriers`.

    Returns:
        P(closed) of each barrier, and the evidence.

    Raises:
        InputError: For more than 16 barriers that are unknown and that no walk crossed, a prior of others, and actions
            that no map gives a probability.
        ImproperTask: For tasks without finite values.
        NotConverged: Where the values of a map do not converge, as those of Boltzmann averages at a small β may not.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(1, 3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1]), np.array([3]), task=0)], [ss.reach(grid, 1)])
        >>> model, behavior = ss.ObstacleGrid(grid), ss.Behavior(ss.BoltzmannAverage())
        >>> exact = enumerate_barriers(model, shown, behavior, BinaryMRF(np.zeros(3), (1, 3)))
        >>> exact.closed.round(2).tolist()  # the walk says nothing of the third cell
        [0.0, 0.0, 0.5]
    """
    check_evidence(model, demonstrations, behavior, tempering, ALL_TERMS if terms == () else terms)
    to_count(seed, "seed", 0)
    agents, barriers = as_behavior_model(behavior), barriers_of(model)
    check_prior(barriers, prior)
    tasks = agents.tasks_of(demonstrations.tasks)
    check_proper(demonstrations.tasks, agents, model.graph)
    crossed = crossed_barriers(barriers, demonstrations, terms)
    free = np.flatnonzero((barriers.known == Cell.UNKNOWN) & ~crossed)
    message = f"expected at most {MAX_BARRIERS} unknown barriers to enumerate, found {len(free)}"
    check(len(free) <= MAX_BARRIERS, message, field="model")
    maps = np.zeros((2 ** len(free), len(barriers.known)), dtype=np.int64)
    maps[:, free] = np.arange(len(maps))[:, None] >> np.arange(len(free)) & 1
    maps[:, barriers.known == Cell.OCCUPIED] = 1
    choices = choices_of(demonstrations) if "actions" in terms else None
    arrivals = arrivals_of(demonstrations) if "transitions" in terms else None
    evidence = tasks, choices, arrivals, agents
    # whole batches, so that one compiled function serves any number of maps
    batches = np.resize(maps, (-(-len(maps) // _BATCH), _BATCH, maps.shape[1]))
    parts = np.concatenate([_log_likelihoods(model, to_jax(batch), *evidence) for batch in batches])[: len(maps)]
    if np.isnan(parts).any():
        missing = int(np.isnan(parts).any(axis=1).sum())
        raise NotConverged(f"expected values in each of {len(maps)} maps; in {missing} of them they did not converge")
    check_possible(parts)
    hierarchical = as_hierarchical(prior)
    log_normalizers = evidence_normalizers(hierarchical, barriers.known, free, seed)
    densities = hierarchical.log_densities(maps) - log_normalizers
    log_priors = np.logaddexp.reduce(densities.reshape(len(maps), -1), axis=1)
    log_posterior = parts @ np.array([tempering, 1.0]) + log_priors
    log_evidence = np.logaddexp.reduce(log_posterior)
    closed = np.minimum(np.exp(log_posterior - log_evidence) @ maps, 1.0)  # sums of rounded numbers
    return ExactPosterior(np.where(maps.all(axis=0), 1.0, closed), float(log_evidence))


@eqx.filter_jit
def _log_likelihoods(
    model: TransitionModel,
    maps: Int[Array, "maps barriers"],
    tasks: Task,
    choices: Choices | None,
    arrivals: Arrivals | None,
    agents: BehaviorModel,
) -> Float[Array, "maps 2"]:
    """Return the log-likelihoods of actions and transitions in each map; 0 for what does not count."""
    dtype, states = jax.eval_shape(model.probabilities).dtype, model.graph.states
    behavior, betas = agents.behavior_of(), agents.betas(len(tasks.terminal))
    # the solver of large problems: `Jacobi` sweeps over all maps until the slowest one has converged
    solver = default_solver(behavior.backup, states * len(maps))
    start, options = solver.cold_start(states, dtype), SolveOptions(solver=solver)
    log_odds = np.log(PASSING[0]) - np.log(PASSING[1])

    def of_map(closed: Array) -> Array:
        parameters = model.parameters.at[: len(closed)].set(log_odds * (2.0 * closed - 1))
        actions, transitions, world = jnp.zeros((), dtype), jnp.zeros((), dtype), model.with_parameters(parameters)
        if choices is not None:

            def of_task(task: Task, own: Choices, beta: Array) -> Array:
                agent = Behavior(behavior.backup, beta, behavior.lapse)
                return choice_log_likelihood(world, task, own, agent, start, options=options)[0]

            actions = jax.vmap(of_task)(tasks, choices, betas).sum()
        if arrivals is not None:
            transitions = arrival_log_likelihood(world, arrivals)
        return jnp.stack([actions, transitions])

    return jax.vmap(of_map)(maps)
