"""Which tasks at discount 1 have values: at the boundary of what actions may cost, and where a task has ended."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import ImproperTask
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.graph import graph
from sidestep.tabular.proper import check_proper
from sidestep.tabular.tasks import Task, stack_tasks, task, with_outcome_reward

WORLD = graph(np.array([[[0, 1], [1, 2]], [[2, 2], [0, 2]], [[2, 2], [0, 1]]]))
"""Action 0 of state 1 surely leads to state 2; what may lead there as well may also go on."""
ENDS = np.arange(3) == 2
HARD, SOFT = Behavior("max"), Behavior("logsumexp", 0.7)
BONUS = np.log(2) / SOFT.beta


def paying(rewards) -> Task:
    """A task of discount 1 with R(s, a)."""
    return task(np.asarray(rewards, float), 1.0, ENDS)


def paying_outcomes(outcome, reward) -> Task:
    """A task in which every action costs 1, but for one outcome's reward."""
    of_outcomes = np.zeros((3, 2, 2))
    of_outcomes[outcome] = 1 + reward
    return with_outcome_reward(paying(np.full((3, 2), -1.0)), of_outcomes)


@pytest.mark.parametrize("action", [(0, 0), (0, 1), (1, 1)])
def test_check_proper_of_an_action_without_cost_raises(action):
    rewards = np.full((3, 2), -1.0)
    rewards[action] = -1e-9
    check_proper(paying(rewards), HARD, WORLD)
    rewards[action] = 0
    with pytest.raises(ImproperTask, match=f"an action of state {action[0]} is worth 0;"):
        check_proper(paying(rewards), HARD, WORLD)


@pytest.mark.parametrize("outcome", [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 1, 0)])
def test_check_proper_of_an_outcome_without_cost_that_goes_on_raises(outcome):
    check_proper(paying_outcomes(outcome, -1e-9), HARD, WORLD)
    with pytest.raises(ImproperTask, match=f"an action of state {outcome[0]} is worth 0;"):
        check_proper(paying_outcomes(outcome, 0), HARD, WORLD)


def test_check_proper_of_a_cost_that_equals_the_entropy_bonus_raises():
    """log(2)/β is what a choice between two is worth."""
    rewards = np.full((3, 2), -2 * BONUS)
    rewards[0, 1] = -BONUS * (1 + 1e-9)
    check_proper(paying(rewards), SOFT, WORLD)
    rewards[0, 1] = -BONUS
    check_proper(paying(rewards), HARD, WORLD)
    with pytest.raises(ImproperTask, match="an action of state 0 costs less"):
        check_proper(paying(rewards), SOFT, WORLD)


@pytest.mark.parametrize("behavior", [HARD, SOFT], ids=["hard max", "log-sum-exp"])
def test_check_proper_of_rewards_that_end_or_follow_the_end_accepts(behavior):
    """They are paid once or never: those of an action that surely ends, of a terminal state, of what it leads to."""
    for reward in (5.0, 0.0, -BONUS / 2):
        for action in ((1, 0), (2, 0), (2, 1)):
            rewards = np.full((3, 2), -1.0)
            rewards[action] = reward
            check_proper(paying(rewards), behavior, WORLD)
        for outcome in ((0, 1, 1), (1, 0, 0), (1, 0, 1), (1, 1, 1), (2, 0, 0), (2, 1, 0), (2, 1, 1)):
            check_proper(paying_outcomes(outcome, reward), behavior, WORLD)
    check_proper(task(np.array([-1.0, -1.0, 5.0]), 1.0, ENDS), behavior, WORLD)


def test_check_proper_of_persons_checks_the_beta_of_each():
    """A move costs .5: the entropy bonus log(2)/β of the second person is larger."""
    tasks = stack_tasks([paying(np.full((3, 2), -0.5))] * 2)
    agents = behavior_model(Behavior("logsumexp", 2.0), person=np.array([0, 1]))
    for betas, proper in (([8.0, 0.5], False), ([0.5, 8.0], False), ([8.0, 1.5], True)):
        own = eqx.tree_at(lambda each: each.parameters.log_beta, agents, jnp.log(jnp.asarray(betas)))
        if proper:
            check_proper(tasks, own, WORLD)
        else:
            with pytest.raises(ImproperTask, match=r"a log-sum-exp agent with β = 0\.5 gains"):
                check_proper(tasks, own, WORLD)
