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

pytestmark = pytest.mark.slow

DISCOUNT = 0.97
TAXI = max(name for name in gymnasium.registry if name.startswith("Taxi-"))
LAKES = ("FrozenLake-v1", {}), ("FrozenLake-v1", {"map_name": "8x8"}), ("FrozenLake-v1", {"is_slippery": False})


def plain_values(table):
    """V by value iteration on Gymnasium's own table, with the reward of an episode's end received at once."""
    width = max(len(table[s][a]) for s in table for a in table[s])
    padding = [(0.0, 0, 0.0, True)]
    rows = [[table[s][a] + padding * (width - len(table[s][a])) for a in sorted(table[s])] for s in sorted(table)]
    p, following, rewards, ends = np.moveaxis(np.array(rows, dtype=float), -1, 0)
    values = np.zeros(len(table))
    for _ in range(2000):
        values = (p * (rewards + DISCOUNT * values[following.astype(int)] * (1 - ends))).sum(axis=-1).max(axis=-1)
    return values


@pytest.mark.parametrize(("name", "options"), [*LAKES, ("CliffWalking-v1", {}), (TAXI, {})], ids=str)
def test_from_gymnasium_values_equal_those_of_the_table(name, options):
    env = gymnasium.make(name, **options)
    world = from_gymnasium(env, DISCOUNT)
    solution = plan(world.model, world.task).solution
    expected = plain_values(env.get_wrapper_attr("P"))
    acting = ~np.asarray(world.task.terminal)[: len(expected)]
    values = np.asarray(solution.values)[: len(expected)]
    np.testing.assert_allclose(values[acting], expected[acting], atol=1e-6)
    assert len(world.task.terminal) == len(expected) + len(world.ends)


class Table:
    """An environment that is nothing but a table."""

    def __init__(self, table):
        self.unwrapped = self
        self.P = table


def test_from_gymnasium_separates_terminal_rewards_from_action_costs():
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


def test_from_gymnasium_without_a_table_raises():
    with pytest.raises(InputError, match="transition table"):
        from_gymnasium(gymnasium.make("CartPole-v1"))
    with pytest.raises(InputError, match="expected three outcomes an action, found 1"):
        slippery(from_gymnasium(gymnasium.make("CliffWalking-v1")))


def lake(seed, episodes=200):
    """A frozen lake, and episodes of agents that know the probability of slipping."""
    env = gymnasium.make("FrozenLake-v1")
    world, behavior = from_gymnasium(env, DISCOUNT), Behavior(BoltzmannAverage(), 30.0)
    policy = np.asarray(plan(world.model, world.task, behavior).policy)
    episodes_seen = collect(env, world, lambda state, random: random.choice(4, p=policy[state]), episodes, seed=seed)
    return world, behavior, gather(episodes_seen, [world.task])


@pytest.mark.parametrize(("terms", "within"), [(("actions", "transitions"), 0.03), (("actions",), 0.08)])
def test_fit_learns_the_slip_of_a_lake(terms, within):
    world, behavior, demos = lake(seed=0)
    result = fit(slippery(world, -3.0), demos, behavior, prior=Normal(0.0, 5.0), terms=terms)
    assert result.converged
    assert slip_of(result.model) == pytest.approx(2 / 3, abs=within)


def test_collect_is_determined_by_the_seed():
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


def test_collect_maps_ends_of_a_taxi_to_separate_states():
    env = gymnasium.make(TAXI)
    world = from_gymnasium(env, DISCOUNT)
    policy = np.asarray(plan(world.model, world.task).policy)
    trips = collect(env, world, lambda state, _: int(policy[state].argmax()), 10)
    assert {int(trip.states[-1]) for trip in trips} <= set(world.ends.values())
    gather(trips, [world.task])
