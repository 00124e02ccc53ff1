"""Fits in continuous worlds of data or with settings that cannot be."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.drift_fits import (
    AGENTS,
    BEHAVIOR,
    CHOICES,
    DEMONSTRATIONS,
    INITIAL,
    LONG,
    MOVES,
    NEAR,
    NOISE,
    PLANNER,
    POLICY,
    PRIOR,
    SHORT,
    WAYS,
)
from helpers.families import Drift, Gusts, vector


def changed(**fields):
    """The demonstrations with other arrays in them."""
    names, values = fields.keys(), tuple(fields.values())
    return eqx.tree_at(lambda demos: [getattr(demos, name) for name in names], DEMONSTRATIONS, list(values))


def with_tasks(task):
    return changed(tasks=sc.batch_tasks([task]))


VECTORS = changed(actions=vector(*WAYS[CHOICES])[:, None])
GAUSSIAN = sc.gaussian_policy(jax.random.key(0), 1, vector(0, 1)[:, None], width=2, depth=1)
NAN = DEMONSTRATIONS.states.at[4, 0].set(jnp.nan)


class Broken(Drift):
    """A faulty family: the density of a step back is 0 or NaN."""

    density: float = eqx.field(static=True, default=jnp.nan)

    def log_prob(self, state, action, next_state):
        return jnp.where(action[0] < 0, self.density, super().log_prob(state, action, next_state))


def broken(density):
    return Broken(vector(0), vector(NOISE), density)


WALL = sc.Walls(low=jnp.ones((1, 1)), high=jnp.ones((1, 1)))
FIRST_BACK = int(np.argmax(CHOICES == 0)) + 1


@pytest.mark.parametrize(("change", "match"), [
    ({"demonstrations": changed(actions=jnp.asarray(CHOICES).at[5].set(3))},
     "trajectory 6, field 'actions': expected the index of an action, 0…2, found 3"),
    ({"demonstrations": changed(actions=jnp.asarray(CHOICES).at[0].set(-1))},
     "trajectory 1, field 'actions': expected the index of an action, 0…2, found -1"),
    ({"demonstrations": VECTORS}, r"'actions': expected the index of an action, 0…2, found \["),
    ({"demonstrations": changed(actions=vector(*CHOICES))}, r"expected the index of an action, 0…2, found \d\.0"),
    ({"policy": GAUSSIAN}, "'actions': expected vectors, as the policy's actions are"),
    ({"policy": GAUSSIAN, "demonstrations": changed(actions=jnp.zeros((MOVES, 2)))},
     r"'actions': expected vectors of 1, found shape \(2,\)"),
    ({"demonstrations": changed(states=NAN)}, "states, row 5: expected finite numbers"),
    ({"demonstrations": changed(task=DEMONSTRATIONS.task.at[1].set(1))}, r"'task': expected tasks in 0…0"),
    ({"demonstrations": with_tasks(eqx.tree_at(lambda task: task.discount, NEAR, jnp.asarray(0.0)))},
     "'discount': expected a finite number above 0 and at most 1, found 0"),
    ({"dynamics": broken(jnp.nan)}, f"trajectory {FIRST_BACK}, field 'log_prob': .* found the logarithm nan"),
    ({"dynamics": broken(-jnp.inf)}, "'log_prob': expected a density above 0 .* found the logarithm -inf"),
    ({"dynamics": Drift(vector(jnp.nan), vector(NOISE))}, "'parameters': expected finite numbers"),
    ({"dynamics": sc.ObstacleMotion(WALL, vector(-9), vector(9), vector(1))},
     "'dynamics': expected parameters to learn, found none"),
    ({"terms": ()}, r"'terms': expected one or both of .*, found \(\)"),
    ({"demonstrations": changed(next_states=NAN)}, "'next_states': expected finite numbers"),
    ({"demonstrations": with_tasks(sc.reach_region((0.0,), 9.0))}, "states, row 1: .*has not ended"),
    ({"dynamics": sc.LinearGaussian(jnp.eye(2), jnp.ones((2, 1)), vector(1, 1))},
     r"'demonstrations': expected states and actions that the dynamics can take, found shapes \(1,\)"),
    ({"estimator": "pathwise", "dynamics": Gusts(vector(0, 0, 0))},
     "'estimator': these dynamics jump, .*: expected 'score'"),
    ({"estimator": "pathwise", "demonstrations": with_tasks(sc.reach_region((9.0,), 0.1))},
     "'estimator': the returns of these tasks jump, .*: expected 'score'"),
    *(({"policy": GAUSSIAN, "demonstrations": VECTORS, "behavior": ss.Behavior(backup)},
       "'behavior': over vectors of actions the policy is known for the log-sum-exp only")
      for backup in (ss.BoltzmannAverage(), ss.HardMax(), ss.Mellowmax())),
])  # fmt: skip
def test_fit_dynamics_bad_input_is_refused(change, match):
    settings = {
        "dynamics": INITIAL, "demonstrations": DEMONSTRATIONS, "behavior": BEHAVIOR, "policy": POLICY,
        "planner": PLANNER, "schedule": SHORT,
    }  # fmt: skip
    with pytest.raises(ss.InputError, match=match):
        sc.fit_dynamics(**{**settings, **change})


@pytest.mark.parametrize(("setting", "expected"), [
    ({"iterations": 1}, "at least 2, found 1"),
    ({"policy_warmup": -1}, "at least 0, found -1"),
    ({"batch_size": 0}, "at least 1, found 0"),
    ({"policy_steps": 0}, "at least 1, found 0"),
    ({"learning_rate": 0.0}, "a finite number above 0, found 0"),
    ({"distance_tolerance": np.nan}, "a finite number above 0, found nan"),
    ({"verification_samples": 7}, "at least 8, found 7"),
    ({"policy_gap_tolerance": np.inf}, "a finite number above 0, found inf"),
])  # fmt: skip
def test_schedule_refuses_settings_out_of_range(setting, expected):
    with pytest.raises(ss.InputError, match=f"'{next(iter(setting))}': expected {expected}"):
        sc.Schedule(**setting)


def test_fit_dynamics_no_moves_are_refused():
    nothing = jax.tree.map(lambda leaf: leaf[:0], eqx.tree_at(lambda demos: demos.tasks, DEMONSTRATIONS, None))
    nothing = eqx.tree_at(lambda demos: demos.tasks, nothing, DEMONSTRATIONS.tasks, is_leaf=lambda leaf: leaf is None)
    for demos, count in ((nothing, 0), (DEMONSTRATIONS.with_only(np.zeros(MOVES, bool)), MOVES)):
        with pytest.raises(ss.InputError, match=f"expected moves with a weight above 0, found none of {count}"):
            sc.fit_dynamics(INITIAL, demos, *AGENTS)


def test_fit_dynamics_infinite_rewards_raise():
    demos = with_tasks(eqx.tree_at(lambda task: task.state_cost, NEAR, 1e308 * jnp.eye(1)))
    with pytest.raises(
        ss.NotConverged, match="ceased to be finite at step 0: the first rollouts have features or returns"
    ):
        sc.fit_dynamics(INITIAL, demos, *AGENTS, prior=PRIOR, terms=("actions",), schedule=LONG)
