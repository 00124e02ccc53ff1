"""Laplace's approximation of a posterior: a normal distribution around its mode, and the standard errors that it gives.

    θ ~ N(θ̂, H⁻¹),        H = −∇² [log L(θ) + log p(θ)] at θ̂

Each kind of fit has its own H, by products with vectors (`Information`); all else is the same for all of them.
"""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from sidestep.errors import InputError, SidestepError, check, check_count, describe
from sidestep.inference.decomposition import low_rank, whole
from sidestep.inference.fit import Estimate, Fit
from sidestep.inference.information import HasInformation, Information
from sidestep.inference.normal_posterior import Laplace
from sidestep.inference.objective import Parameters

_BOUND = 1e-6
"""The least distance of a learned lapse or discount from 0 and 1."""
_NAMED = 3
"""The number of parameters that an error message names."""
_SMALL = 200_000
"""The most parameters × states × tasks up to which a summary has standard errors: they take about a second."""


def laplace(fit: HasInformation | Information, *, dense: int = 500, rank: int = 200) -> Laplace:
    """Return Laplace's approximation of the posterior of what a fit has learned.

    Args:
        fit: The fit, of a transition model or of continuous dynamics, or its `information()`. It must have converged,
            with the exact gradient.
        dense: The number of parameters up to which the information is computed as a whole.
        rank: With more of them, the number of directions in which demonstrations count.

    Returns:
        The normal distribution, with standard errors, intervals and samples.

    Raises:
        InputError: For a fit with nothing to learn, that did not converge (its values, or its policy), or that ended
            before the maximum or at a bound; for too few rollouts; and where the posterior does not determine some
            direction, with the names of parameters.
        NotConverged: If the iterations for many parameters do not converge.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [ss.reach(grid, 2)])
        >>> learned = ss.fit(ss.ObstacleGrid(grid, 0.0), shown, ss.Behavior(ss.HardMax()), terms=("transitions",))
        >>> [round(float(error), 2) for error in laplace(learned).standard_errors.model]  # √2 where no one went
        [1.41, 1.3, 1.3]

    References:
        Tierney and Kadane, "Accurate approximations for posterior moments and marginal densities" (1986). Bui-Thanh,
        Ghattas, Martin and Stadler, "A computational framework for infinite-dimensional Bayesian inverse problems"
        (2013), for the low rank.
    """
    check_count(rank, 1, "rank")
    check_count(dense, 0, "dense")
    if isinstance(fit, type) or not isinstance(fit, Information | HasInformation):
        raise InputError(f"expected a fit, or its information, found {describe(fit)}", field="fit")
    information = fit if isinstance(fit, Information) else fit.information()
    message = "expected a fit of at least one parameter, found one with nothing to learn"
    check(information.size > 0, message, source="laplace", field="fit")
    _check_bounds(information.parameters)
    finite = np.isfinite(information.gradient).all()
    check(finite, "expected a finite gradient at the learned parameters", source="laplace", field="fit")
    parts = whole(information) if information.size <= dense else low_rank(information, rank)
    result = Laplace(information.parameters, *parts)
    _check_determined(result)
    return _at_maximum(result, information)


def behavior_estimates(fit: Fit[Any]) -> dict[str, Estimate]:
    """Return β (of a typical person), lapse and discount where they were learned, with standard errors.

    Args:
        fit: The fit.

    Returns:
        The estimates by name. They have no error where the problem is not small, by the product of its parameters,
        states and tasks, and where the posterior has no normal approximation.
    """
    parameters = Parameters(fit.model.parameters, fit.behavior.parameters)
    values, count = jax.jit(_typical)(parameters), sum(leaf.size for leaf in jax.tree.leaves(parameters))
    # a compiled function returns them by the alphabet
    numbers = {name: values[name] for name in ("beta", "lapse", "discount") if name in values}
    errors: list[float | None] = [None] * len(numbers)
    if numbers and count * fit.problem.demonstrations.tasks.terminal.size <= _SMALL:
        with suppress(SidestepError):
            normal = laplace(fit, dense=count)
            errors = normal.error_of(lambda point: jnp.stack([*_typical(point).values()])).tolist()
    return {name: Estimate(float(numbers[name]), error) for name, error in zip(numbers, errors, strict=True)}


def _typical(parameters: Parameters) -> dict[str, Array]:
    """Return the learned numbers of a typical person's behavior."""
    own, numbers = parameters.behavior, {}
    if own.log_beta is not None:
        numbers["beta"] = jnp.exp(own.log_beta.mean())
    if own.logit_lapse is not None:
        numbers["lapse"] = jax.nn.sigmoid(own.logit_lapse)
    if own.logit_discount is not None:
        numbers["discount"] = jax.nn.sigmoid(own.logit_discount)
    return numbers


def _check_bounds(parameters: Parameters) -> None:
    own = parameters.behavior
    for name, logit in (("lapse", own.logit_lapse), ("discount", own.logit_discount)):
        at = 0.5 if logit is None else float(jax.nn.sigmoid(logit))
        message = f"expected one between its bounds, found {at:.3g}: there is no normal approximation there"
        check(_BOUND < at < 1 - _BOUND, message, source="laplace", field=name)


def _check_determined(result: Laplace) -> None:
    """Raise unless the information is positive definite, up to the rounding of its products."""
    flat, _ = ravel_pytree(result.parameters)
    worst = int(result.eigenvalues.argmin())
    if result.eigenvalues[worst] > np.sqrt(jnp.finfo(flat.dtype).eps):
        return
    direction = result.vectors[:, worst] * result.scale
    largest = np.argsort(-np.abs(direction))[:_NAMED]
    weights = direction[largest] / np.abs(direction).max()
    named = zip(weights, _names(result.parameters, largest), strict=True)
    of_them = " ".join(f"{weight:+.2g} {name}" for weight, name in named)
    raise InputError(
        f"the demonstrations and the prior do not determine the direction {of_them} (information "
        f"{result.eigenvalues[worst]:.2g} of its scale): expected more demonstrations or a narrower prior",
        source="laplace",
    )


def _at_maximum(result: Laplace, information: Information) -> Laplace:
    """Return the distribution with its distance from the maximum; raise if a Newton step would be long."""
    simulation, gradient = information.simulation(result), information.gradient
    noise = float(np.sqrt(simulation.squared_distance))
    message = (
        f"expected a gradient without much noise of rollouts, found one of {noise:.2g} standard errors: take more "
        "samples with laplace(fit.information(samples=…))"
    )
    check(noise <= information.farthest, message, source="laplace", field="samples")
    squared = gradient @ result.covariance_products(gradient[None])[0] - simulation.squared_distance
    distance = float(np.sqrt(max(squared, 0.0)))
    message = (
        f"expected a fit that ends at its maximum, found one that ends {distance:.2g} standard errors from it "
        f"({information.message})"
    )
    check(distance <= information.farthest, message, source="laplace", field="fit")
    return replace(result, distance=distance, simulated=simulation.errors)


def _names(parameters: Parameters, indices: np.ndarray) -> list[str]:
    """Return names of entries of the vector of parameters."""
    leaves, names = jax.tree_util.tree_flatten_with_path(parameters)[0], []
    ends = np.cumsum([leaf.size for _, leaf in leaves])
    for index in indices:
        which = int(np.searchsorted(ends, index, side="right"))
        path, leaf = leaves[which]
        at = np.unravel_index(int(index - ends[which] + leaf.size), leaf.shape)
        names.append(jax.tree_util.keystr(path).removeprefix(".") + (str([*map(int, at)]) if leaf.ndim else ""))
    return names
