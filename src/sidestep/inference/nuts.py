"""Samples from the posterior of what a fit has learned, by the No-U-Turn sampler, for small problems.

The sampler is blackjax's: Hamiltonian Monte Carlo that chooses the length of its paths (Hoffman and Gelman 2014), after
a warm-up in windows as Stan's. It differs from common use in one thing: it works in the coordinates of Laplace's
approximation, in which the posterior is about a standard normal distribution, and chains start at samples of that.

Every gradient is exact and solves all tasks again, so this serves models of a few hundred states and parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sidestep._arguments import to_key
from sidestep._repr import short_repr
from sidestep._typing import Tree
from sidestep.errors import check_count, check_instance
from sidestep.inference.arviz_data import inference_data, require
from sidestep.inference.batching import Batch
from sidestep.inference.diagnostics import effective_sizes, split_rhat
from sidestep.inference.fit import Fit
from sidestep.inference.laplace import laplace
from sidestep.inference.natural_scale import natural_scale
from sidestep.inference.objective import Parameters, Problem, actions_log_likelihood, transitions_and_prior
from sidestep.inference.pointwise import Unit, pointwise_log_likelihood
from sidestep.inference.tabular_information import TabularInformation
from sidestep.tabular.likelihood import Arrivals
from sidestep.tabular.solvers.base import WarmStart

if TYPE_CHECKING:
    from arviz import InferenceData

    from sidestep.tabular.demonstration_tables import Labels

_Data = tuple[list[Batch], list[WarmStart], Arrivals | None]


@short_repr()
@dataclass(frozen=True, eq=False)
class Draws:
    """Samples of a posterior, by `sample`.

    Attributes:
        parameters: Unconstrained, each with leading axes of chains and draws; `natural_scale` maps them.
        rhat: Split-R̂ of each number: above about 1.01, chains have not mixed.
        effective_sizes: The number of independent draws that all chains' are worth, of each number.
        divergent: Whether the path to each draw diverged: where some do, the draws may miss a part of the posterior.
        acceptance: The mean acceptance rate of each path.
    """

    parameters: Parameters
    rhat: Parameters
    effective_sizes: Parameters
    divergent: Bool[np.ndarray, "chains draws"]
    acceptance: Float[np.ndarray, "chains draws"]

    def to_arviz(
        self, fit: Fit[Any] | None = None, *, unit: Unit = "walk", labels: "Labels | None" = None
    ) -> "InferenceData":
        """Return the samples as ArviZ's `InferenceData`, on their natural scales.

        β has the dimension `person`, costs of states have `state`, and reward weights `feature`.

        Args:
            fit: The fit that was sampled, for a group `log_likelihood`, which `arviz.loo` and `arviz.waic` need.
            unit: What that group has an entry for, and `loo` leaves out: "walk" or "move".
            labels: The names of persons and states, as coordinates; numbers by default.

        Raises:
            InputError: Where ArviZ is not installed, for another fit, and for another number of labels.
            NotConverged: If the values of a draw do not converge.
        """
        statistics = {"diverging": self.divergent, "acceptance_rate": self.acceptance}
        pointwise = None if fit is None else pointwise_log_likelihood(fit, self.parameters)
        return inference_data(natural_scale(self.parameters), statistics, pointwise, unit, labels)


def sample(fit: Fit[Any], key: PRNGKeyArray, n: int = 1_000, *, chains: int = 4, warmup: int = 500) -> Draws:
    """Return samples from the posterior of what a fit has learned, by the No-U-Turn sampler.

    It needs `pip install 'sidestep[samplers]'`, and is for small problems. The posterior is that of the parameters of
    the model and of behavior with their priors, as `fit` maximizes it.

    Args:
        fit: The fit, with the exact gradient.
        key: Of the random numbers.
        n: The number of draws of each chain, at least 4.
        chains: Their number, at least 1.
        warmup: The number of steps before the first draw, in which step sizes are adapted, at least 1.

    Returns:
        The samples, with R̂ and effective sizes.

    Raises:
        InputError: Where blackjax is not installed, for counts that are too small, and as `laplace` does.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [ss.reach(grid, 2)])
        >>> learned = ss.fit(ss.ObstacleGrid(grid, 0.0), shown, ss.Behavior(ss.HardMax()), terms=("transitions",))
        >>> draws = sample(learned, jax.random.key(0), 10, chains=2, warmup=20)
        >>> draws.parameters.model.shape
        (2, 10, 3)

    References:
        Hoffman and Gelman, "The No-U-Turn sampler" (2014). Cabezas et al., "BlackJAX: composable Bayesian inference in
        JAX" (2024). Vehtari et al., "Rank-normalization, folding, and localization: an improved R̂" (2021), for
        splitting chains.
    """
    check_instance(fit, Fit, "fit")
    to_key(key)
    require("blackjax", "sample")
    for count, least, field in ((n, 4, "n"), (chains, 1, "chains"), (warmup, 1, "warmup")):
        check_count(count, least, field)
    normal = laplace(fit)
    information = TabularInformation(fit.problem, normal.parameters)
    objective = information.objective
    data = objective.batches, information.starts, objective.arrivals
    flat, unravel = ravel_pytree(normal.parameters)
    inner = (normal.vectors * (1 / np.sqrt(normal.eigenvalues) - 1)) @ normal.vectors.T
    factor = jnp.asarray(normal.scale[:, None] * (np.eye(len(flat)) + inner), flat.dtype)
    positions, divergent, acceptance = _run(
        objective.constants, data, normal.parameters, factor, key, n, chains, warmup
    )
    parameters = jax.vmap(jax.vmap(unravel))(flat + positions @ factor.T)
    rhat, sizes = _of_each(split_rhat, parameters), _of_each(effective_sizes, parameters)
    return Draws(parameters, rhat, sizes, np.asarray(divergent), np.asarray(acceptance))


@eqx.filter_jit
def _run(
    problem: Problem,
    data: _Data,
    mode: Parameters,
    factor: Float[Array, "parameters parameters"],
    key: PRNGKeyArray,
    n: int,
    chains: int,
    warmup: int,
) -> tuple[Array, Array, Array]:
    """Return positions, whether paths diverged, and acceptance rates, with axes of chains and draws."""
    blackjax: Any = import_module("blackjax")  # its types are not those of its functions
    flat, unravel = ravel_pytree(mode)

    def log_density(position: Float[Array, " parameters"]) -> Array:
        return _log_posterior(problem, data, unravel(flat + factor @ position))

    def chain(key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        begin, adapt, move = jax.random.split(key, 3)
        position = jax.random.normal(begin, flat.shape, flat.dtype)
        adaptation = blackjax.window_adaptation(blackjax.nuts, log_density)
        (state, settings), _ = adaptation.run(adapt, position, num_steps=warmup)
        step = blackjax.nuts(log_density, **settings).step

        def draw(state: Tree, key: PRNGKeyArray) -> tuple[Tree, tuple[Array, Array, Array]]:
            state, info = step(key, state)
            return state, (state.position, info.is_divergent, info.acceptance_rate)

        return jax.lax.scan(draw, state, jax.random.split(move, n))[1]

    return jax.vmap(chain)(jax.random.split(key, chains))


def _log_posterior(problem: Problem, data: _Data, parameters: Parameters) -> Array:
    """Return log L(θ) + log p(θ); NaN, which the sampler rejects, where values do not converge."""
    batches, starts, arrivals = data
    total = sum(transitions_and_prior(problem.prior, problem.model, problem.behavior, arrivals, parameters))
    for batch, start in zip(batches, starts, strict=True):
        everywhere = jnp.ones(start.values.shape, bool)
        total = total + actions_log_likelihood(problem, parameters, batch, start, everywhere)[0]
    return jnp.asarray(total)


def _of_each(measure: Callable[[np.ndarray], np.ndarray], parameters: Parameters) -> Parameters:
    """Return a diagnostic of each number, from draws with axes of chains and draws."""

    def of_leaf(leaf: Array) -> np.ndarray:
        draws = np.asarray(leaf, np.float64)
        return measure(draws.reshape(*draws.shape[:2], -1)).reshape(draws.shape[2:])

    return jax.tree.map(of_leaf, parameters)
