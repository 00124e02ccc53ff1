"""Samples as ArviZ's `InferenceData`: one variable for each learned number, with chains and draws."""

import warnings
from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from sidestep.errors import check
from sidestep.inference.natural_scale import NaturalScale

if TYPE_CHECKING:
    from arviz import InferenceData

    from sidestep.inference.pointwise import PointwiseLogLikelihood, Unit


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
) -> "InferenceData":
    """Return draws as `InferenceData`.

    Args:
        draws: Each leaf with leading axes of chains and draws.
        statistics: Of the sampler, with the same axes, by ArviZ's names.
        pointwise: The log-likelihood of each move, with the same axes.
        unit: What the group `log_likelihood` has an entry for.
    """
    require("arviz", "to_arviz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # that its next version will be another one
        import arviz

    names: dict[str, np.ndarray] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(draws)[0]:
        names[jax.tree_util.keystr(path).removeprefix(".")] = np.asarray(leaf)
    others: dict[str, Any] = {}
    if statistics is not None:
        others["sample_stats"] = dict(statistics)
    if pointwise is not None:
        others["log_likelihood"] = {f"{unit}s": pointwise.of(unit)}
        others["dims"], others["coords"] = {f"{unit}s": [unit]}, {unit: pointwise.numbers_of(unit)}
    return arviz.from_dict(posterior=names, **others)
