"""Transition models: T_θ(s, a, s′) as probabilities of a graph's outcomes.

A model is a graph and parameters θ; it turns θ into `probabilities[s, a, k]`. Only models know what θ means: solvers,
likelihood and planner read the graph and the probabilities.
"""

import abc
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._repr import short_repr
from sidestep._typing import FloatTree
from sidestep.errors import check
from sidestep.tabular.graph import Graph

_Model = TypeVar("_Model", bound="TransitionModel")


@short_repr()
class TransitionModel(eqx.Module):
    """Probabilities T_θ on a graph; a new family of models is a subclass with `probabilities`.

    Attributes:
        graph: The states that each action can lead to.
        parameters: θ, a pytree of floating-point arrays, all of which are learned.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> isinstance(ObstacleGrid(Grid.unknown(2, 3)), TransitionModel)
        True
    """

    graph: eqx.AbstractVar[Graph]
    parameters: eqx.AbstractVar[FloatTree]

    @abc.abstractmethod
    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return T_θ(s, a, s′) of each outcome s′ = `graph.successors[s, a, k]`; it sums to one over k."""

    def with_parameters(self: _Model, parameters: FloatTree) -> _Model:
        """Return the same model with other parameters.

        Args:
            parameters: θ, of the same structure and shapes.

        Raises:
            InputError: For another structure or other shapes.
        """
        own, shapes = (jax.tree.map(jnp.shape, each) for each in (self.parameters, parameters))
        check(own == shapes, f"expected parameters of shapes {own}, found {shapes}", field="parameters")
        return eqx.tree_at(lambda model: model.parameters, self, parameters)
