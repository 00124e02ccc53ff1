"""Short texts of records, in consoles and in notebooks."""

from typing import Any, NamedTuple
from xml.etree import ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
from sidestep._repr import short_repr


@short_repr()
class Pair(NamedTuple):
    first: Any
    second: Any = None


@short_repr("size", "first")
class Box(eqx.Module):
    first: Any

    @property
    def size(self):
        return len(self.first)


class Trunk(Box):
    second: int


@pytest.mark.parametrize(("value", "text"), [
    (1, "1"),
    (0.1 + 0.2, "0.3"),
    (True, "True"),
    ("ab", "'ab'"),
    (ss.Cell.FREE, "FREE"),
    (ss.Status.MIXED, "MIXED"),
    ((1, "a"), "(1, 'a')"),
    ((ss.Estimate(1.0, None),) * 19, "19 × Estimate"),
    ({"a": 1, "b": np.zeros(9)}, "{a, b}"),
    (np.array([1, 2, 3]), "[1, 2, 3]"),
    (np.arange(6), "int64[6], 0 … 5"),
    (np.full((2, 3), 7.0), "float64[2, 3], all 7"),
    (np.array([[1.0, np.nan], [np.inf, 2.0]]), "float64[2, 2], 1 … 2, 2 not finite"),
    (np.full((2, 2), np.nan), "float64[2, 2], 4 not finite"),
    (np.array([True, False, True]), "bool[3], 2 true"),
    (np.zeros((0, 3)), "float64[0, 3]"),
    (jnp.asarray(2.5), "2.5"),
    (jnp.asarray(True), "True"),
    (jax.ShapeDtypeStruct((3,), jnp.float32), "float32[3]"),
    (Pair(1), "Pair(first=1)"),
    (Pair("x" * 90), "Pair(…)"),
])  # fmt: skip
def test_short_repr_of_a_part_tells_what_it_is(value, text):
    assert repr(Pair(value)) == f"Pair(first={text})"


def test_short_repr_of_a_traced_array_has_its_shape():
    texts = []

    def traced(x):
        texts.append(repr(Pair(x)))
        return x

    jax.jit(traced)(jnp.zeros((2, 3)))
    assert texts == ["Pair(first=float64[2, 3])"]


def test_short_repr_with_names_shows_these_in_subclasses_too():
    assert repr(Trunk([1, 2], 3)) == "Trunk(size=2, first=(1, 2))"


def test_short_repr_of_an_attribute_without_a_value_does_not_raise():
    assert repr(Box(None)) == "Box(size=…)"
    assert repr(jax.tree.map(lambda _: None, Box(np.zeros(3)))) == "Box(size=…)"


def test_repr_html_is_a_table_with_escaped_cells():
    pair: Any = Pair("<b>&", np.zeros(9))
    table = ElementTree.fromstring(pair._repr_html_())
    assert table.tag == "table"
    rows = [(row.findtext("th"), row.findtext("td")) for row in table.iter("tr")]
    assert rows == [("first", "'<b>&'"), ("second", "float64[9], all 0")]


def test_repr_of_a_fit_and_of_what_it_has_is_short():
    grid = ss.Grid.unknown(rows=5, columns=5)
    walk = ss.Trajectory(np.array([0, 1, 2, 3, 4]), np.array([3, 3, 3, 3]), task=0)
    shown = ss.gather([walk, walk], [ss.reach(grid, 4)])
    unknown = ss.behavior_model(ss.Behavior(ss.BoltzmannAverage(), 7.0), ["beta"])
    fit = ss.fit(ss.ObstacleGrid(grid), shown, unknown, terms=("actions",))
    normal, behavior = ss.laplace(fit), fit.behavior.behavior_of()
    plan = ss.plan(fit.model, ss.reach(grid, 4), behavior)
    parts: list[Any] = [fit.model, fit.behavior, fit.problem, fit.problem.prior, shown, shown.tasks, grid, normal, plan]
    for record in [fit, *parts]:
        text, kind = repr(record), type(record).__name__
        assert text.count("\n") < 10
        assert max(map(len, text.splitlines())) <= 120
        assert text.startswith(kind)
        assert ElementTree.fromstring(record._repr_html_()).findtext("caption") == kind
    assert f"objective {fit.final.objective:.4f} after {fit.final.iteration} iterations" in repr(fit)
    assert repr(shown).startswith("Demonstrations(\n    trajectories=2,\n    states=int32[8], 0 … 3,")
