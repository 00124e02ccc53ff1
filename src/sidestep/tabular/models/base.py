"""Transition models: T_θ(s, a, s′) as probabilities of a graph's outcomes.

A model is a graph and parameters θ; it turns θ into `probabilities[s, a, k]`. Nothing else in the library knows what
θ means: solvers, likelihood and planner read the graph and the probabilities alone.
"""

import abc
from typing import TypeVar

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from sidestep.tabular.graph import Graph

_Model = TypeVar("_Model", bound="TransitionModel")


class TransitionModel(eqx.Module):
    """Probabilities T_θ on a graph.

    - `graph`: where each action can lead.
    - `parameters`: θ, a pytree of floating-point arrays, all of which are learned.

    A new family is a subclass with `probabilities`.
    """

    graph: eqx.AbstractVar[Graph]
    parameters: eqx.AbstractVar[PyTree[Float[Array, "..."]]]

    @abc.abstractmethod
    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """T_θ(s, a, s′) for each outcome s′ = `graph.successors[s, a, k]`; sums to one over k."""

    def with_parameters(self: _Model, parameters: PyTree[Float[Array, "..."]]) -> _Model:
        """The same family at another θ."""
        return eqx.tree_at(lambda model: model.parameters, self, parameters)
