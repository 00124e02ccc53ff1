"""Samples as ArviZ's `InferenceData`: one variable for each learned number, with chains and draws."""

import warnings
from collections.abc import Hashable, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from sidestep.errors import check
from sidestep.inference.natural_scale import NaturalScale

if TYPE_CHECKING:
    from arviz import InferenceData

    from sidestep.inference.pointwise import PointwiseLogLikelihood, Unit
    from sidestep.tabular.demonstration_tables import Labels


def require(package: str, what: str) -> None:
    """Raise `InputError` unless an optional package is installed.

    Args:
        package: Its name.
        what: What needs it.
    """
    message = f"needs {package}, which is not installed: expected pip install 'sidestep[samplers]' to have run"
    check(find_spec(package) is not None, message, source=what)


def inference_data(
    draws: NaturalScale,
    statistics: Mapping[str, np.ndarray] | None = None,
    pointwise: "PointwiseLogLikelihood | None" = None,
    unit: "Unit" = "walk",
    labels: "Labels | None" = None,
) -> "InferenceData":
    """Return draws as `InferenceData`, in which β has the dimension `person`, costs `state`, reward weights `feature`.

    Args:
        draws: Each leaf with leading axes of chains and draws.
        statistics: Of the sampler, with the same axes, by ArviZ's names.
        pointwise: The log-likelihood of each move, with the same axes.
        unit: What the group `log_likelihood` has an entry for.
        labels: The names of persons and states; numbers by default.

    Raises:
        InputError: Where ArviZ is not installed, and for another number of labels.
    """
    require("arviz", "to_arviz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # that its next version will be another one
        import arviz

    names: dict[str, np.ndarray] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(draws)[0]:
        names[jax.tree_util.keystr(path).removeprefix(".")] = np.asarray(leaf)
    dims, coords = _dimensions(draws, labels)
    others: dict[str, Any] = {"dims": dims, "coords": coords}
    if statistics is not None:
        others["sample_stats"] = dict(statistics)
    if pointwise is not None:
        others["log_likelihood"] = {f"{unit}s": pointwise.of(unit)}
        dims[f"{unit}s"], coords[unit] = [unit], pointwise.numbers_of(unit)
    return arviz.from_dict(posterior=names, **others)


def _dimensions(draws: NaturalScale, labels: "Labels | None") -> tuple[dict[str, list[str]], dict[str, Any]]:
    """Return the names of the dimensions after chains and draws, and their coordinates."""
    persons, states = (labels.persons, labels.states) if labels is not None else ((), ())
    if draws.beta is not None and np.shape(draws.beta)[-1] == 1 != len(persons):
        persons = ()  # one β for all persons
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {}
    each = ("beta", "person", persons), ("reward_weights", "feature", ()), ("costs", "state", states)
    for field, dimension, names in each:
        numbers = getattr(draws, field)
        if numbers is not None:
            dims[field] = [dimension]
            coords[dimension] = _coordinates(names, np.shape(numbers)[-1], dimension)
    return dims, coords


def _coordinates(names: Sequence[Hashable], count: int, field: str) -> list[Hashable]:
    """Return names, or numbers where there are none."""
    message = f"expected {count} labels, found {len(names)}"
    check(len(names) in (0, count), message, source="labels", field=f"{field}s")
    return list(names) if len(names) else list(range(count))
