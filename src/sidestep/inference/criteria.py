"""Akaike's and the Bayesian information criterion of a fit.

    AIC = 2 k − 2 log L,        BIC = k ln n − 2 log L,

with k the number of learned parameters that the likelihood determines, and n the number of observations: the sum of the
weights of walks or moves, so that one of weight 2 counts as two. Both are
derived at the maximum of the likelihood. A fit has a prior and is at the maximum of the posterior, where log L is a
little lower; with wide priors the difference is small.

k is the rank of the expected information of the visited states (Fisher's): a softmax over m outcomes has m − 1
parameters, not m, and logits of states that no agent reaches have none.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from sidestep.errors import check, check_count, check_instance
from sidestep.inference.fit import Fit
from sidestep.inference.objective import Parameters
from sidestep.inference.pointwise import Unit, moves_log_likelihood, pointwise_log_likelihood
from sidestep.inference.tabular_information import TabularInformation
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS

_MOST = 500
"""The most parameters for which the rank is computed."""


class InformationCriteria(NamedTuple):
    """The information criteria of a fit, by `information_criteria`; smaller is better.

    Attributes:
        log_likelihood: log L in nats, of the terms that the fit has.
        parameters: k.
        observations: n, the sum of the weights of walks or moves.
        aic: 2 k − 2 log L.
        bic: k ln n − 2 log L.

    Example:
        >>> InformationCriteria(-10.0, parameters=2, observations=5, aic=24.0, bic=23.2).aic
        24.0
    """

    log_likelihood: float
    parameters: int
    observations: float
    aic: float
    bic: float


def information_criteria(fit: Fit[Any], *, unit: Unit = "walk", parameters: int | None = None) -> InformationCriteria:
    """Return AIC and BIC of a fit.

    Args:
        fit: The fit, of the whole likelihood (`tempering` 1).
        unit: What BIC counts as one observation: "walk" or "move".
        parameters: k; by default the number of parameters that the likelihood determines, for at most 500 learned ones.

    Returns:
        The criteria, with what they are made of.

    Raises:
        InputError: For anything but a fit, for one that did not converge or with tempering, for weights that sum to
            less than one walk or move, and, where k is not given, for too many parameters, the fixed-policy gradient or
            a deadline.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [ss.reach(grid, 2)])
        >>> learned = ss.fit(ss.ObstacleGrid(grid, 0.0), shown, ss.Behavior(ss.HardMax()), terms=("transitions",))
        >>> information_criteria(learned).parameters  # two cells were entered
        2

    References:
        Akaike, "A new look at the statistical model identification" (1974). Schwarz, "Estimating the dimension of a
        model" (1978).
    """
    check_instance(fit, Fit, "fit")
    check(fit.converged, f"expected a fit that converged: {fit.message}", source="information_criteria", field="fit")
    tempering = float(fit.problem.tempering)
    message = f"expected a likelihood that counts in full, found {tempering}"
    check(tempering == 1, message, source="information_criteria", field="tempering")
    if parameters is None:
        parameters = identified_parameters(fit)
    check_count(parameters, 0, "parameters")
    each = pointwise_log_likelihood(fit)
    log_likelihood, n = float(each.of(unit).sum()), float(each.weights_of(unit).sum())
    message = f"expected weights that sum to at least one {unit}, found {n:.3g}"
    check(n >= 1 - 1e-6, message, source="information_criteria", field="weights")
    aic, bic = (penalty * parameters - 2 * log_likelihood for penalty in (2.0, float(np.log(n))))
    return InformationCriteria(log_likelihood, parameters, n, aic, bic)


def identified_parameters(fit: Fit[Any]) -> int:
    """Return the number of learned parameters that the likelihood determines: the rank of the expected information.

    Args:
        fit: The fit, with the exact gradient and at most 500 parameters.

    Raises:
        InputError: For more parameters, for the fixed-policy gradient, and for agents with a deadline.
    """
    learned = Parameters(fit.model.parameters, fit.behavior.parameters)
    count = ravel_pytree(learned)[0].size
    message = f"expected at most {_MOST} learned parameters, or their number by parameters=…; found {count}"
    check(count <= _MOST, message, source="information_criteria", field="parameters")
    if count == 0:
        return 0
    # the moves that are expected have no time, on which policies depend before a deadline
    message = "expected options without a deadline, or the number of parameters by parameters=…; found a deadline"
    check(not fit.problem.options.deadline, message, source="information_criteria", field="options")
    expected = _expected_moves(fit, learned)
    information = TabularInformation(replace(fit.problem, demonstrations=expected, tempering=1.0), learned)
    of_likelihood = information.dense() - _symmetric(information.of_prior(np.eye(count)))
    return _rank(of_likelihood, float(jnp.finfo(ravel_pytree(learned)[0].dtype).eps))


def _expected_moves(fit: Fit[Any], learned: Parameters) -> Demonstrations:
    """Return every move from the visited states, weighted by visits and probability.

    The negative Hessian of their log-likelihood at θ is the expected information. Without the actions' term, only
    actions that were taken count.
    """
    demos, graph = fit.problem.demonstrations, fit.problem.model.graph
    task, states, actions, weights = (
        np.asarray(each) for each in (demos.task, demos.states, demos.actions, demos.weights)
    )
    if "actions" in fit.problem.terms:
        task, states, weights = (np.repeat(each, graph.actions) for each in (task, states, weights))
        actions = np.tile(np.arange(graph.actions), len(demos))
    visits, which = np.unique(np.stack([task, states, actions]), axis=1, return_inverse=True)
    counts = np.bincount(which.ravel(), weights)
    outcomes = graph.successors.shape[2]
    task, states, actions = np.repeat(visits, outcomes, axis=1)
    after = np.asarray(graph.successors)[visits[1], visits[2]].ravel()
    # a state may follow by several outcomes: one move for each
    distinct, first = np.unique(np.stack([task, states, actions, after]), axis=1, return_index=True)
    integers = (to_jax(part, np.int32) for part in (states[first], actions[first], after[first], task[first]))
    states, actions, after, task = integers
    trajectory = to_jax(np.zeros(distinct.shape[1]), np.int32)
    moves = Demonstrations(states, actions, after, task, trajectory, demos.tasks)
    terms = ALL_TERMS if "actions" in fit.problem.terms else fit.problem.terms
    each = moves_log_likelihood(replace(fit.problem, demonstrations=moves, terms=terms), learned)
    weights = np.exp(each.total) * np.repeat(counts, outcomes)[first]
    return eqx.tree_at(lambda each: each.weights, moves, to_jax(weights.astype(demos.weights.dtype)))


def _symmetric(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return (matrix + matrix.T) / 2


def _rank(information: Float[np.ndarray, "n n"], eps: float) -> int:
    """Return the rank of a positive semidefinite matrix, of which entries have rounding errors."""
    diagonal = np.diag(information)
    some = diagonal > eps**0.6 * diagonal.max()
    scale = 1 / np.sqrt(diagonal[some])
    eigenvalues = np.linalg.eigvalsh(information[np.ix_(some, some)] * np.outer(scale, scale))
    return int((eigenvalues > eps**0.4).sum())
