"""Gymnasium's tabular environments: their values here are those of their own tables, and a lake's slip is learned."""

import gymnasium
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.priors import Normal
from sidestep.io.gymnasium import collect, from_gymnasium, slip_of, slippery
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.planning import plan

DISCOUNT = 0.97
TAXI = max(name for name in gymnasium.registry if name.startswith("Taxi-"))
LAKES = ("FrozenLake-v1", {}), ("FrozenLake-v1", {"map_name": "8x8"}), ("FrozenLake-v1", {"is_slippery": False})


def plain_values(table):
    """V by value iteration on Gymnasium's own table, in which what an episode's end pays is paid at once."""
    values = np.zeros(len(table))
    for _ in range(2000):
        values = np.array(
            [
                max(sum(p * (r + DISCOUNT * values[t] * (not ends)) for p, t, r, ends in table[s][a]) for a in table[s])
                for s in range(len(table))
            ]
        )
    return values


@pytest.mark.parametrize(("name", "given"), [*LAKES, ("CliffWalking-v1", {}), (TAXI, {})], ids=str)
def test_values_are_those_of_the_table(name, given):
    env = gymnasium.make(name, **given)
    world = from_gymnasium(env, DISCOUNT)
    found = plan(world.model, world.task)
    expected = plain_values(env.get_wrapper_attr("P"))
    acting = ~np.asarray(world.task.terminal)[: len(expected)]
    values = np.asarray(found.solution.values)[: len(expected)]
    np.testing.assert_allclose(values[acting], expected[acting], atol=1e-6)
    assert len(world.task.terminal) == len(expected) + len(world.ends)


class Table:
    """An environment that is nothing but a table."""

    def __init__(self, table):
        self.unwrapped = self
        self.P = table


def test_an_end_is_paid_beyond_what_an_action_costs():
    """Every action costs 1; ending in state 1 pays 5 more, beside two outcomes that go on and cost 1 or 3."""
    table = {
        0: {0: [(0.5, 0, -1.0, False), (0.5, 1, 4.0, True)], 1: [(0.25, 0, -1.0, False), (0.75, 0, -3.0, False)]},
        1: {0: [(1.0, 1, 0.0, True)], 1: [(1.0, 1, 0.0, True)]},
    }
    task = from_gymnasium(Table(table), 0.5).task
    np.testing.assert_allclose(task.reward[0], [-1.0, -2.5])
    np.testing.assert_allclose(task.terminal_reward[1], 5.0 / 0.5)
    assert task.terminal.tolist() == [False, True]
    table[0][1] = [(0.5, 0, -1.0, False), (0.5, 1, 6.0, True)]
    with pytest.raises(InputError, match=r"state 1 pays 7 beyond one action and 5 beyond another"):
        from_gymnasium(Table(table), 0.5)


def test_environments_without_a_table_are_refused():
    with pytest.raises(InputError, match="transition table"):
        from_gymnasium(gymnasium.make("CartPole-v1"))
    with pytest.raises(InputError, match="expected three outcomes an action, found 1"):
        slippery(from_gymnasium(gymnasium.make("CliffWalking-v1")))


def lake(seed, episodes=200):
    """A frozen lake, and episodes of people who know how slippery it is."""
    env = gymnasium.make("FrozenLake-v1")
    world, people = from_gymnasium(env, DISCOUNT), Behavior(BoltzmannAverage(), 30.0)
    policy = np.asarray(plan(world.model, world.task, people).policy)
    walked = collect(env, world, lambda state, random: random.choice(4, p=policy[state]), episodes, seed=seed)
    return world, people, gather(walked, [world.task])


@pytest.mark.parametrize(("terms", "within"), [(("actions", "transitions"), 0.03), (("actions",), 0.08)])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_slip_of_a_lake_is_found(seed, terms, within):
    world, people, demos = lake(seed)
    found = fit(slippery(world, -3.0), demos, people, prior=Normal(0.0, 5.0), terms=terms)
    assert found.converged
    assert slip_of(found.model) == pytest.approx(2 / 3, abs=within)


def test_episodes_are_walked_as_the_seed_says():
    env = gymnasium.make("FrozenLake-v1")
    world = from_gymnasium(env)
    first, again, other = (
        collect(env, world, lambda _, draw: int(draw.integers(4)), 5, seed=seed) for seed in (0, 0, 1)
    )
    assert all(np.array_equal(one.states, same.states) for one, same in zip(first, again, strict=True))
    assert any(not np.array_equal(one.states, same.states) for one, same in zip(first, other, strict=True))
    ends = world.task.terminal
    assert all(ends[each.states[-1]] or len(each.actions) == 100 for each in first)
    assert not any(ends[each.states[:-1]].any() for each in first)


def test_a_taxi_s_trip_ends_in_a_state_of_its_own():
    env = gymnasium.make(TAXI)
    world = from_gymnasium(env, DISCOUNT)
    policy = np.asarray(plan(world.model, world.task).policy)
    trips = collect(env, world, lambda state, _: int(policy[state].argmax()), 10)
    assert {int(trip.states[-1]) for trip in trips} <= set(world.ends.values())
    gather(trips, [world.task])
