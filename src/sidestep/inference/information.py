"""The information of a posterior at the end of a fit: what `laplace` needs of every kind of fit."""

import abc
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from sidestep.inference.normal_posterior import Laplace
from sidestep.inference.objective import Parameters

Vectors = Float[np.ndarray, "vectors parameters"]


class Simulation(NamedTuple):
    """The errors that rollouts bring into a normal distribution.

    Attributes:
        errors: The largest error of a standard error (itself a standard error), as a fraction of it.
        squared_distance: What noise in the gradient adds to the squared distance from the maximum, in standard errors.
    """

    errors: float
    squared_distance: float


class Information(abc.ABC):
    """The information of a posterior at the end of a fit, and the gradient of the objective there.

    Vectors have the entries of `ravel_pytree(parameters)`.

    Attributes:
        parameters: θ.
        gradient: That of the objective at θ; NaN where a solve failed.
        message: How the fit ended.
        farthest: The most standard errors that the fit may end from the maximum.
    """

    parameters: Parameters
    gradient: Float[np.ndarray, " parameters"]
    message: str
    farthest: ClassVar[float] = 0.1

    @property
    def size(self) -> int:
        """The number of parameters."""
        return len(self.gradient)

    @abc.abstractmethod
    def products(self, vectors: Vectors) -> Vectors:
        """Return H v of each vector.

        Args:
            vectors: One a row.
        """

    @abc.abstractmethod
    def of_prior(self, vectors: Vectors) -> Vectors:
        """Return the products with the prior's part of H alone.

        Args:
            vectors: One a row.
        """

    def dense(self) -> Float[np.ndarray, "parameters parameters"]:
        """Return H."""
        products = self.products(np.eye(self.size))
        return (products + products.T) / 2

    def simulation(self, normal: Laplace) -> Simulation:
        """Return the errors by rollouts; none, unless a kind of information is simulated.

        Args:
            normal: The normal distribution with this information.
        """
        return Simulation(0.0, 0.0)


@runtime_checkable
class HasInformation(Protocol):
    """A fit of any kind."""

    def information(self) -> Information:
        """Return the information at the end of the fit."""
        ...
