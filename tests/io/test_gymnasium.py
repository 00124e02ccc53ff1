"""Gymnasium's tabular environments: their values here are those of their own tables, and a lake's slip is learned."""

import equinox as eqx
import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.spaces import Dict, Discrete
from hypothesis import given, settings
from hypothesis import strategies as st

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.priors import Normal
from sidestep.io.episodes import collect
from sidestep.io.gymnasium import from_gymnasium, slip_of, slippery
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.planning import plan

pytestmark = pytest.mark.slow

DISCOUNT = 0.97
TAXI = max(name for name in gymnasium.registry if name.startswith("Taxi-"))
TABLES = (
    *[
        ("FrozenLake-v1", {"map_name": size, "is_slippery": slips})
        for size in ("4x4", "8x8")
        for slips in (True, False)
    ],
    *[("CliffWalking-v1", {"is_slippery": slips}) for slips in (True, False)],
    *[(TAXI, {"is_rainy": rains}) for rains in (True, False)],
)


def plain_values(table, discount=DISCOUNT):
    """V by value iteration on Gymnasium's own table, with the reward of an episode's end received at once."""
    width = max(len(outcomes) for row in table.values() for outcomes in row.values())
    padding, unavailable = [(0.0, 0, 0.0, True)], [(1.0, 0, -np.inf, True)]
    actions = range(1 + max(action for row in table.values() for action in row))
    rows = [[table[s].get(a, unavailable) for a in actions] for s in sorted(table)]
    padded = [[each + padding * (width - len(each)) for each in row] for row in rows]
    p, following, rewards, ends = np.moveaxis(np.array(padded, dtype=float), -1, 0)
    values = np.zeros(len(table))
    for _ in range(700):
        paid = np.where(p > 0, p * (rewards + discount * np.where(ends, 0.0, values[following.astype(int)])), 0.0)
        values = paid.sum(axis=-1).max(axis=-1)
    return values


@pytest.mark.parametrize(("name", "options"), TABLES, ids=str)
def test_from_gymnasium_values_equal_those_of_the_table(name, options):
    env = gymnasium.make(name, **options)
    world = from_gymnasium(env, DISCOUNT)
    solution = plan(world.model, world.task).solution
    assert solution.converged
    expected = plain_values(env.get_wrapper_attr("P"))
    acting = ~np.asarray(world.task.terminal)[: len(expected)]
    values = np.asarray(solution.values)[: len(expected)]
    np.testing.assert_allclose(values[acting], expected[acting], atol=1e-6)
    assert len(world.task.terminal) == len(expected) + len(world.ends)


class Table:
    """An environment that is nothing but a table."""

    def __init__(self, table, **spaces):
        self.unwrapped = self
        self.P = table
        vars(self).update(spaces)


STAYS = [(1.0, 1, 0.0, True)]
"""What the actions of a terminal state 1 do."""


def test_from_gymnasium_pays_every_outcome_its_own_reward():
    """State 0 goes on with reward −1 or −3, or ends in 1 with 4 or, after the other action, 6."""
    table = {
        0: {0: [(0.5, 0, -1.0, False), (0.5, 1, 4.0, True)], 1: [(0.25, 0, -3.0, False), (0.75, 1, 6.0, True)]},
        1: {0: STAYS, 1: STAYS},
    }
    world = from_gymnasium(Table(table), 0.5)
    rewards = world.task.outcome_reward
    assert rewards is not None
    np.testing.assert_allclose(rewards[0], [[-1.0, 4.0], [-3.0, 6.0]])
    assert world.task.terminal.tolist() == [False, True]
    assert not np.asarray(world.task.terminal_reward).any()
    # V = ¼(−3 + ½V) + ¾ 6
    assert plan(world.model, world.task).solution.values[0] == pytest.approx(3.75 / 0.875)


def test_from_gymnasium_pays_nothing_else_for_impossible_outcomes():
    """State 0 stays with reward −1, or goes to 1 or stays; what has probability 0 may be anything."""
    table = {0: {0: [(1.0, 0, -1.0, False)], 1: [(0.5, 1, 4.0, True), (0.5, 0, 2.0, False)]}, 1: {}}
    world = from_gymnasium(Table(table))
    assert world.task.outcome_reward is not None
    assert world.task.outcome_reward[0].tolist() == [[-1.0, -1.0], [4.0, 2.0]]
    assert world.model.graph.successors[0].tolist() == [[0, 0], [1, 0]]
    turned = {0: {0: [(0.0, 1, 4.0, True), (1.0, 0, -1.0, False), (0.0, 9, np.inf, True)], 1: table[0][1]}, 1: {}}
    assert eqx.tree_equal(from_gymnasium(Table(turned)), world)


def test_from_gymnasium_of_equal_rewards_has_rewards_of_actions():
    world = from_gymnasium(Table({0: {0: [(0.5, 0, -2.0, False), (0.5, 1, -2.0, True)]}, 1: {0: STAYS}}))
    assert world.task.outcome_reward is None
    assert world.task.reward.tolist() == [[-2.0], [0.0]]


def test_fit_of_rewards_on_outcomes_learns_the_closed_form():
    """A risk pays 1 with p, else 0; what is sure pays .6. β(p − .6) = ln(risked / not), so p is known exactly."""
    win, lose, sure = (1.0, 1, 1.0, True), (1.0, 2, 0.0, True), [(1.0, 3, 0.6, True)]
    table = {0: {0: [(0.5, *win[1:]), (0.5, *lose[1:])], 1: sure}, **{s: {} for s in (1, 2, 3)}}
    world = from_gymnasium(Table(table))
    risked, beta = 163, 5.0
    walks = [Trajectory(np.array([0, 1 if n < risked else 3]), np.array([int(n >= risked)]), 0) for n in range(200)]
    behavior = Behavior(BoltzmannAverage(), beta)
    result = fit(world.model, gather(walks, [world.task]), behavior, prior=Normal(0.0, 1e6), terms=("actions",))
    assert result.converged
    expected = 0.6 + np.log(risked / (200 - risked)) / beta
    assert float(result.model.probabilities()[0, 0, 0]) == pytest.approx(expected, abs=1e-4)


def test_from_gymnasium_numbers_states_and_actions_by_their_keys():
    """The same table with its keys in another order, and with spaces that start at other numbers."""
    table = {
        0: {0: [(1.0, 1, -1.0, False)], 2: [(0.5, 0, -2.0, False), (0.5, 2, 5.0, True)]},
        1: {1: [(1.0, 0, -3.0, False)], 0: [(1.0, 2, 7.0, True)]},
        2: {},
    }
    world = from_gymnasium(Table(table), 0.9)
    assert world.model.graph.available.tolist() == [[True, False, True], [True, True, False], [True, True, True]]
    assert world.model.graph.successors[1, 1, 0] == 0
    np.testing.assert_allclose(world.model.probabilities()[0, 2], [0.5, 0.5])
    turned = {s: dict(reversed(row.items())) for s, row in reversed(table.items())}
    shifted = {
        s + 5: {a + 1: [(p, after + 5, *paid) for p, after, *paid in each] for a, each in row.items()}
        for s, row in table.items()
    }
    spaces = {"observation_space": Discrete(3, start=5), "action_space": Discrete(3, start=1)}
    for other in (Table(turned), Table(shifted, **spaces)):
        assert eqx.tree_equal(from_gymnasium(other, 0.9), world)
    np.testing.assert_allclose(plan(world.model, world.task).solution.values[:2], plain_values(table, 0.9)[:2])


def test_from_gymnasium_of_a_list_equals_that_of_a_dict():
    rows = [[[(1.0, 0, 1.0, False)], [(1.0, 1, 2.0, True)]], [STAYS, STAYS]]
    as_dict = {s: dict(enumerate(row)) for s, row in enumerate(rows)}
    assert eqx.tree_equal(from_gymnasium(Table(rows)), from_gymnasium(Table(as_dict)))


def test_from_gymnasium_separates_ends_where_episodes_pass():
    """Episodes end in 1 and pass it, and so they pass 2, which follows 1 alone; in 3 they only end."""
    table = {
        0: {0: [(0.5, 1, 1.0, True), (0.5, 1, 2.0, False)], 1: [(1.0, 2, 3.0, True)]},
        1: {0: [(1.0, 2, 4.0, False)], 1: [(1.0, 0, 5.0, False)]},
        2: {0: [(1.0, 3, 6.0, True)], 1: [(1.0, 0, -6.0, False)]},
        3: {0: [(1.0, 0, 100.0, False)], 1: [(1.0, 3, 0.0, True)]},
    }
    world = from_gymnasium(Table(table), 0.9)
    assert (world.ends, world.task.terminal.tolist()) == ({1: 4, 2: 5}, [False] * 3 + [True] * 3)
    np.testing.assert_allclose(plan(world.model, world.task).solution.values[:3], plain_values(table, 0.9)[:3])
    started = Table(table, initial_state_distrib=np.array([0.5, 0.0, 0.0, 0.5]))
    assert from_gymnasium(started, 0.9).ends == {1: 4, 2: 5, 3: 6}


def spoiled(**entries):
    """A table of which row 0 is replaced; the parts of each outcome are replaced by name."""
    outcome = {"probability": 1.0, "after": 1, "reward": 0.0, "ends": True, **entries}
    return {0: {0: [tuple(outcome.values())]}, 1: {0: STAYS}}


def chances(*values):
    return {0: {0: [(1.0, 1, 0.0, True)], 3: [(each, 1, 0.0, True) for each in values]}, 1: {}}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (chances(0.5), r"^state 0, action 3: expected probabilities that sum to 1, found a sum of 0.5"),
        (chances(0.75, 0.75), "^state 0, action 3: expected probabilities that sum to 1, found a sum of 1.5"),
        (chances(1.5, -0.5), r"^state 0, action 3: expected probabilities of at least 0, found \[-0.5\]"),
        (chances(1.0, np.nan), r"^state 0, action 3: expected probabilities of at least 0, found \[nan\]"),
        (chances(np.inf), r"^state 0, action 3: expected probabilities of at least 0, found \[inf\]"),
        (chances(), "^state 0, action 3: expected probabilities that sum to 1, found a sum of 0"),
        (chances("1"), r"^state 0, action 3: expected \(probability, .*found \('1', 1, 0.0, True\)"),
        (spoiled(after=0.5), "^state 0, action 0: expected a next state in 0…1, found 0.5"),
        (spoiled(after=2), "^state 0, action 0: expected a next state in 0…1, found 2"),
        (spoiled(after=-1), "^state 0, action 0: expected a next state in 0…1, found -1"),
        (spoiled(reward=np.inf), "^state 0, action 0: expected a finite reward, found inf"),
        (spoiled(ends="no"), r"^state 0, action 0: expected \(probability"),
        (spoiled(ends=0.5), "^state 0, action 0: expected whether the episode ends, found 0.5"),
        (spoiled(more=1), r"^state 0, action 0: expected \(probability, .*found \(1.0, 1, 0.0, True, 1\)"),
        ({0: {0: [(1.0, 0, 0.0)]}}, r"^state 0, action 0: expected \(probability"),
        ({0: {0: [3]}}, r"^state 0, action 0: expected \(probability, .*found 3"),
        ({0: {0: 3}}, "^state 0, action 0: expected a list of outcomes, found int"),
        ({0: 3}, "^state 0: expected a dict or list of actions, found int"),
        (3, "^P: expected a dict or list of states, found int"),
        ({}, "'P': expected a row for each"),
        ({0: {0: STAYS}, 2: {0: STAYS}}, r"'P': expected a row for each of the states 0…1, found none for \[1\]"),
        ({0: {}, 1: {0: STAYS}}, "^state 0: expected an action, found none, and no episode ends there"),
        ({0: {}, 1: {}}, "'P': expected at least one action, found none"),
        ({0: {-1: STAYS}, 1: {0: STAYS}}, r"^state 0: expected actions in 0…0, found \[-1\]"),
        ({0: {"left": STAYS}, 1: {0: STAYS}}, "^state 0: expected whole numbers as keys, found 'left'"),
        ({0.5: {0: STAYS}, 1: {0: STAYS}}, "^P: expected whole numbers as keys, found 0.5"),
    ],
)
def test_from_gymnasium_of_a_malformed_table_raises(table, message):
    with pytest.raises(InputError, match=message):
        from_gymnasium(Table(table))


def test_from_gymnasium_names_states_as_the_environment_does():
    spaces = {"observation_space": Discrete(2, start=5), "action_space": Discrete(2, start=1)}
    rows = {6: {1: [(1.0, 6, 0.0, True)]}, 5: {1: [(1.0, 6, 0.0, True)], 2: [(0.5, 6, 0.0, True)]}}
    with pytest.raises(InputError, match=r"^state 5, action 2: expected probabilities that sum to 1"):
        from_gymnasium(Table(rows, **spaces))
    with pytest.raises(InputError, match=r"expected a row for each of the states 5…6, found also \[7\]"):
        from_gymnasium(Table({**rows, 7: {}}, **spaces))


def test_from_gymnasium_without_a_table_raises():
    with pytest.raises(InputError, match="transition table"):
        from_gymnasium(gymnasium.make("CartPole-v1"))
    with pytest.raises(InputError, match="transition table"):
        from_gymnasium(gymnasium.make("Blackjack-v1"))
    with pytest.raises(InputError, match="expected three outcomes an action, found 1"):
        slippery(from_gymnasium(gymnasium.make("CliffWalking-v1")))


def test_slippery_of_two_outcomes_raises():
    rows = {0: {0: [(1 / 3, each, 0.0, False) for each in range(3)], 1: [(0.5, each, 0.0, False) for each in (0, 1)]}}
    table = rows | {each: {0: [(1.0, each, 0.0, False)]} for each in (1, 2)}
    with pytest.raises(InputError, match="expected one or three outcomes of every action, found two"):
        slippery(from_gymnasium(Table(table)))


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (lambda env: wrappers.TransformReward(env, lambda reward: -float(reward)), "TransformReward"),
        (lambda env: wrappers.TimeLimit(wrappers.ClipReward(env, 0.0, 0.5), 9), "ClipReward"),
        (lambda env: wrappers.StickyAction(env, 0.5), "StickyAction"),
        (wrappers.FlattenObservation, "FlattenObservation"),
    ],
)
def test_from_gymnasium_under_a_wrapper_raises(wrap, name):
    with pytest.raises(
        InputError, match=f"found the wrapper {name}, which may change rewards, observations or actions"
    ):
        from_gymnasium(wrap(gymnasium.make("FrozenLake-v1")))


def test_from_gymnasium_under_a_wrapper_of_the_same_name_raises():
    class TimeLimit(gymnasium.Wrapper):
        pass

    with pytest.raises(InputError, match="found the wrapper TimeLimit"):
        from_gymnasium(TimeLimit(gymnasium.make("FrozenLake-v1")))


def test_from_gymnasium_under_a_time_limit_is_the_table():
    plain = from_gymnasium(gymnasium.make("FrozenLake-v1").unwrapped)
    limited = wrappers.RecordEpisodeStatistics(gymnasium.make("FrozenLake-v1", max_episode_steps=3))
    assert eqx.tree_equal(from_gymnasium(limited), plain)


def test_from_gymnasium_of_several_agents_raises():
    several = Table({0: {0: STAYS}}, possible_agents=["first", "second"])
    with pytest.raises(InputError, match="found one of several agents"):
        from_gymnasium(several)
    vector = gymnasium.make_vec("FrozenLake-v1", num_envs=2, vectorization_mode="sync")
    with pytest.raises(InputError, match="found a vector of them"):
        from_gymnasium(vector)
    vector.close()


def test_from_gymnasium_of_a_fickle_taxi_raises():
    with pytest.raises(InputError, match="fickle passengers"):
        from_gymnasium(gymnasium.make(TAXI, fickle_passenger=True))


@st.composite
def tables(draw):
    """A table of five states and three actions, whatever its rewards, ends and sets of actions are."""
    random, states = np.random.default_rng(draw(st.integers(0, 2**32))), 5
    ending, kinds = draw(st.sampled_from([0.0, 0.2, 1.0])), draw(st.sampled_from(["actions", "outcomes"]))
    table = {}
    for state in random.permutation(states).tolist():
        table[state] = {}
        for action in random.permutation(3)[: random.integers(1, 4)].tolist():
            chance, paid = random.dirichlet(np.ones(3)), random.normal(size=3)
            after, ends = random.integers(states, size=3), random.uniform(size=3) < ending * random.uniform()
            paid = paid if kinds == "outcomes" else np.full(3, paid[0])
            table[state][action] = list(zip(*(each.tolist() for each in (chance, after, paid, ends)), strict=True))
    return table


@settings(max_examples=15)
@given(tables(), st.sampled_from([0.5, 0.9]))
def test_from_gymnasium_of_random_tables_has_their_values(table, discount):
    world = from_gymnasium(Table(table), discount)
    acting = ~np.asarray(world.task.terminal)[: len(table)]
    values = np.asarray(plan(world.model, world.task).solution.values)[: len(table)]
    np.testing.assert_allclose(values[acting], plain_values(table, discount)[acting], atol=1e-6)


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


class Shifted(gymnasium.Env):
    """States 1, 2, 3 and actions 5, 6: the second one goes on to the next state, and the third state ends."""

    observation_space, action_space = Discrete(3, start=1), Discrete(2, start=5)
    P = {s: {5: [(1.0, s, -1.0, False)], 6: [(1.0, s + 1, -1.0, s == 2)]} for s in (1, 2)} | {3: {}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = 1
        return self.state, {}

    def step(self, action):
        ((_, self.state, reward, ends),) = self.P[self.state][action]
        return self.state, reward, ends, False, {}


def test_collect_shifts_spaces_that_start_at_another_number():
    env = Shifted()
    world = from_gymnasium(env)
    actions = iter([np.int64(0), 1, np.uint8(0), np.array(1)])
    (walk,) = collect(env, world, lambda *_: next(actions), 1)
    assert (walk.states.tolist(), walk.actions.tolist()) == ([0, 0, 1, 1, 2], [0, 1, 0, 1])
    successors = np.asarray(world.model.graph.successors)
    assert successors[walk.states[:-1], walk.actions, 0].tolist() == walk.states[1:].tolist()
    gather([walk], [world.task])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (1.9, "expected a whole number as action, found 1.9"),
        (1.0, "expected a whole number as action, found 1.0"),
        (np.nan, "expected a whole number as action, found nan"),
        (np.array([1]), "expected a whole number as action, found array"),
        (None, "expected a whole number as action, found None"),
        (2, r"expected one of the actions \[0, 1\] of state 0, found 2"),
        (-1, r"expected one of the actions \[0, 1\] of state 0, found -1"),
    ],
)
def test_collect_of_an_action_that_is_none_raises(action, message):
    env = Shifted()
    with pytest.raises(InputError, match=f"^episode 0, move 0: {message}"):
        collect(env, from_gymnasium(env), lambda *_: action, 1)


def test_collect_of_an_action_that_is_not_available_raises():
    class Less(Shifted):
        P = Shifted.P | {2: {6: Shifted.P[2][6]}}

    with pytest.raises(InputError, match=r"^episode 0, move 1: expected one of the actions \[1\] of state 1, found 0"):
        collect(Less(), from_gymnasium(Less()), lambda state, _: 1 - state, 1)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"observation_space": Dict({"s": Discrete(3)})}, r"'observation_space': .*Discrete\(3\), found Dict"),
        ({"observation_space": Discrete(4, start=1)}, r"'observation_space': .*Discrete\(3\), found Discrete\(4"),
        (
            {"action_space": Discrete(3)},
            r"'action_space': expected Discrete\(2\), as the model has, found Discrete\(3\)",
        ),
        ({"observation_space": None, "reset": lambda **_: ({"s": 1}, {})}, "move 0: expected a whole number as obs"),
        ({"reset": lambda **_: (0, {})}, "^episode 0, move 0: expected a state in 1…3, found 0"),
        ({"num_envs": 2}, "found a vector of them"),
        ({"possible_agents": ["first"]}, "found one of several agents"),
    ],
)
def test_collect_in_another_environment_raises(attributes, message):
    world, env = from_gymnasium(Shifted()), Shifted()
    vars(env).update(attributes)
    with pytest.raises(InputError, match=message):
        collect(env, world, lambda *_: 1, 1)
