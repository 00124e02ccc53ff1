"""Fits in continuous worlds: closed forms, checkpoints, and refusals."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, Gusts, LaplaceDrift, vector
from sidestep.continuous.fit import problem_fingerprint
from sidestep.continuous.policies import ScaledNetwork

# Agents on a line move by −1, 0 or 1 and look two moves ahead, to stay near 0: R(s, a) = −s². With the Boltzmann
# average, Q(s, a) = −s² − γ E(s + a + θ + noise)², for every later choice.
WAYS, DISCOUNT, NOISE, TRUTH, MOVES = np.array([-1.0, 0.0, 1.0]), 0.9, 0.4, 0.6, 90
NEAR = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.zeros((1, 1)), jnp.asarray(DISCOUNT))
BEHAVIOR, PRIOR = ss.Behavior(ss.BoltzmannAverage(), 1.5), ss.Normal(0.0, 50.0)
POLICY = sc.finite_policy(jax.random.key(1), vector(*WAYS)[:, None], jnp.linspace(-2, 2, 9)[:, None], width=4, depth=1)
PLANNER = sc.Planner(horizon=2, batch_size=8, samples=2, learning_rate=0.03, critic_width=4)
INITIAL = Drift(vector(-0.5), vector(NOISE))


def log_policy(drift, states):
    """The log-probability of every action."""
    values = -1.5 * DISCOUNT * (states[:, None] + WAYS + drift) ** 2
    return values - np.log(np.exp(values).sum(axis=1, keepdims=True))


def walks(seed=0):
    """States, choices and next states of agents that know the drift."""
    random = np.random.default_rng(seed)
    states = random.uniform(-2, 2, MOVES)
    choices = np.array([random.choice(3, p=np.exp(row)) for row in log_policy(TRUTH, states)])
    return states, choices, states + WAYS[choices] + TRUTH + NOISE * random.normal(size=MOVES)


def demonstrations_of(states, actions, following, tasks=(NEAR,)):
    moves = zip(np.stack([states, following], axis=1).reshape(len(states), 2, -1), actions, strict=True)
    return sc.gather_trajectories([ss.Trajectory(places, action[None], 0) for places, action in moves], tasks)


STATES, CHOICES, FOLLOWING = walks()
DEMONSTRATIONS = demonstrations_of(STATES, CHOICES, FOLLOWING)
AGENTS = BEHAVIOR, POLICY, PLANNER
learn = partial(sc.fit_dynamics, INITIAL, DEMONSTRATIONS, *AGENTS, prior=PRIOR)
SHORT = sc.Schedule(iterations=16, policy_warmup=2, batch_size=30, learning_rate=0.2)
LONG = sc.Schedule(iterations=100, policy_warmup=0, batch_size=MOVES, learning_rate=0.1)
BOTH = partial(learn, estimator="pathwise", schedule=SHORT)


@cache
def fitted(seed=0):
    """A short fit, and all its reports."""
    reports = []
    return BOTH(seed=seed, report=lambda *report: reports.append(report)), reports


# Results


def test_fit_dynamics_transitions_alone_give_least_squares():
    seen = np.column_stack([STATES, WAYS[CHOICES]])
    following = seen @ [0.7, 0.5] + 0.3 * np.random.default_rng(0).normal(size=MOVES)
    expected = np.linalg.lstsq(seen, following, rcond=None)[0]
    begin = sc.LinearGaussian(jnp.zeros((1, 1)), jnp.zeros((1, 1)), vector(0.3))
    result = sc.fit_dynamics(
        begin, demonstrations_of(STATES, CHOICES, following), *AGENTS,
        prior=ss.Normal(0.0, 5e5), terms=("transitions",),
        schedule=sc.Schedule(iterations=300, batch_size=MOVES, learning_rate=0.05),
    )  # fmt: skip
    learned = [float(result.dynamics.parameters[name][0, 0]) for name in ("state", "action")]
    np.testing.assert_allclose(learned, expected, atol=1e-6)
    assert result.history[0].transitions == pytest.approx(norm.logpdf(following, 0, 0.3).sum())
    assert {progress.actions for progress in result.history} == {0}
    assert (result.converged, result.verification.policy_gap, result.verification.samples) == (True, 0, 0)


@pytest.mark.slow
def test_fit_dynamics_actions_alone_give_the_maximum_likelihood():
    """The tolerance allows for the noise of rollouts."""

    def loss(drift):
        return -log_policy(drift, STATES)[np.arange(MOVES), CHOICES].sum() + drift**2 / 100

    result = learn(terms=("actions",), schedule=LONG)
    learned, best = float(result.dynamics.parameters[0]), minimize_scalar(loss)
    assert learned == pytest.approx(best.x, abs=0.1)  # pyright: ignore[reportAttributeAccessIssue]
    assert abs(learned - TRUTH) < 0.25
    assert {progress.transitions for progress in result.history} == {0}
    assert result.history[0].prior == pytest.approx(-(0.5**2) / 100)


@pytest.mark.slow
def test_fit_dynamics_vector_actions_give_the_true_drift():
    """With R(s, a) = −s² − a² the policy is normal, by Riccati's equation."""
    beta, discount, count = 4.0, 0.6, 300
    task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(discount))
    curve = 1.0  # V(s) = −curve s² − 2 tilt s, whatever else
    for _ in range(100):
        curve = 1 + discount * curve / (1 + discount * curve)
    steepness = 1 + discount * curve
    tilt = discount * curve * TRUTH / (steepness - discount)
    random = np.random.default_rng(2)
    states, spread = random.uniform(-2, 2, count), 1 / np.sqrt(2 * beta * steepness)
    means = -discount * (curve * (states + TRUTH) + tilt) / steepness
    actions = means + spread * random.normal(size=count)
    demos = demonstrations_of(states, actions[:, None], states + actions + TRUTH, (task,))
    result = sc.fit_dynamics(
        INITIAL, demos, ss.Behavior(ss.LogSumExp(), beta),
        sc.gaussian_policy(jax.random.key(0), 1, demos.states, depth=0, spread=0.3),
        sc.Planner(horizon=8, batch_size=16, samples=2, candidates=8, learning_rate=0.03, critic_width=4),
        prior=PRIOR, terms=("actions",), estimator="pathwise",
        schedule=sc.Schedule(iterations=200, policy_warmup=60, batch_size=30, learning_rate=0.02),
    )  # fmt: skip
    assert result.converged
    assert float(result.dynamics.parameters[0]) == pytest.approx(TRUTH, abs=0.1)
    likelihood = norm.logpdf(actions, means, spread).sum() / count
    learned = np.mean([progress.actions for progress in result.history[-30:]]) / count
    assert learned == pytest.approx(likelihood, abs=0.1)


@pytest.mark.slow
def test_fit_dynamics_policy_warmup_plans_for_the_first_model():
    """Without the actions' term there is no policy to plan."""
    by_both, by_transitions = fitted()[0], BOTH(terms=("transitions",))
    # before each verification, the policy has as many steps as a quarter of the iterations
    assert by_both.planner_state.policy_moments[0].count - (2 + 16) in (4, 8, 12, 16)
    assert by_transitions.planner_state.policy_moments[0].count == 0


def test_fit_dynamics_objective_is_the_sum_of_its_terms():
    result, _ = fitted()
    for progress in result.history:
        assert progress.actions < 0
        assert progress.transitions < 0
        assert progress.objective == pytest.approx(progress.actions + progress.transitions + progress.prior)
        assert progress.gradient > 0
    assert abs(float(result.dynamics.parameters[0]) - TRUTH) < 0.25


def test_fit_dynamics_batches_of_a_laplace_family_give_the_median():
    """The batch log-likelihood is scaled up to all moves."""
    result = sc.fit_dynamics(
        LaplaceDrift(vector(0.1)), DEMONSTRATIONS, *AGENTS,
        prior=PRIOR, terms=("transitions",), schedule=sc.Schedule(iterations=150, batch_size=30, learning_rate=0.02),
    )  # fmt: skip
    drifts = FOLLOWING - STATES - WAYS[CHOICES]
    assert float(result.dynamics.parameters[0]) == pytest.approx(np.median(drifts), abs=0.05)
    scaled = np.mean([progress.transitions for progress in result.history[-50:]])
    learned = np.abs(drifts - float(result.dynamics.parameters[0]))
    assert scaled == pytest.approx(-learned.sum() - MOVES * np.log(2), rel=0.02)


def test_fit_dynamics_of_some_walks_ends_where_the_fit_of_these_alone_does():
    """A move of weight 0 may even be impossible."""
    some = np.arange(MOVES) % 3 == 0
    alone = demonstrations_of(STATES[some], CHOICES[some], FOLLOWING[some])
    far = demonstrations_of(STATES, CHOICES, np.where(some, FOLLOWING, 1e200)).with_only(some)
    far = replace(far, person=jnp.zeros(MOVES, int))
    fits = [
        sc.fit_dynamics(INITIAL, demos, *AGENTS, prior=PRIOR, terms=("transitions",), schedule=SHORT)
        for demos in (alone, DEMONSTRATIONS.with_only(some), far)
    ]
    for each in fits[1:]:
        assert each.converged
        np.testing.assert_allclose(each.dynamics.parameters, fits[0].dynamics.parameters, rtol=1e-6)
        np.testing.assert_allclose(each.verification.covariance, fits[0].verification.covariance, rtol=1e-6)


# Diagnostics


def test_fit_dynamics_newton_steps_end_at_the_maximum_of_transitions():
    """The objective is quadratic in θ, so that one step is exact."""
    result = learn(terms=("transitions",), schedule=SHORT)
    precision = MOVES / NOISE**2 + 1 / 50
    mode = np.sum(FOLLOWING - STATES - WAYS[CHOICES]) / NOISE**2 / precision
    np.testing.assert_allclose(result.dynamics.parameters, [mode], atol=1e-9)
    np.testing.assert_allclose(result.verification.covariance, [[1 / precision]])
    assert (result.verification.noise, result.verification.samples, result.converged) == (0, 0, True)


@pytest.mark.slow
def test_verification_gradient_agrees_with_the_likelihood_within_its_standard_error():
    result = learn(terms=("actions",), schedule=replace(LONG, iterations=20))
    at, step, found = float(result.dynamics.parameters[0]), 1e-4, result.verification
    ends = [
        log_policy(each, STATES)[np.arange(MOVES), CHOICES].sum() - each**2 / 100 for each in (at - step, at + step)
    ]
    error = found.gradient[0] - (ends[1] - ends[0]) / (2 * step)
    assert abs(error) < 3 * found.standard_errors[0]
    assert found.standard_errors[0] * np.sqrt(found.covariance[0, 0]) == pytest.approx(found.noise)
    assert found.noise <= result.problem.schedule.noise_tolerance


def test_fit_dynamics_reports_are_its_history():
    result, reports = fitted()
    assert [progress for progress, _ in reports] == list(result.history)
    assert [progress.iteration for progress in result.history] == list(range(16))


def test_fit_dynamics_large_policy_gap_is_not_converged():
    result, _ = fitted()
    assert result.verification.policy_gap > 0.1
    assert not result.converged
    assert f"the policy gap is {result.verification.policy_gap:.2g} (tolerance 0.1)" in result.message


def test_fit_dynamics_few_iterations_are_not_converged():
    """Newton steps of at most two standard deviations do not lead to a maximum that is a hundred away."""
    begin = Drift(vector(-4.0), vector(NOISE))
    schedule = sc.Schedule(2, batch_size=MOVES, learning_rate=0.01)
    result = sc.fit_dynamics(begin, DEMONSTRATIONS, *AGENTS, prior=PRIOR, terms=("transitions",), schedule=schedule)
    away = (np.mean(FOLLOWING - STATES - WAYS[CHOICES]) - float(result.dynamics.parameters[0])) * MOVES**0.5 / NOISE
    assert result.verification.distance == pytest.approx(away, rel=1e-3)
    assert not result.converged
    assert f"the maximum is {result.verification.distance:.2g} posterior standard deviations away" in result.message


class SechDrift(LaplaceDrift):
    """A drift with steps of a density in proportion to sech(s′ − s − a − θ)."""

    def log_prob(self, state, action, next_state):
        away = (next_state - state - action - self.parameters).sum()
        return -jnp.logaddexp(away, -away)


def test_fit_dynamics_newton_step_too_far_is_taken_back():
    """Two away from a single move, Newton's step ends far beyond the maximum; half of it ends near."""
    demos = demonstrations_of(np.zeros(1), np.ones(1, int), np.zeros(1))
    schedule = sc.Schedule(2, batch_size=1, learning_rate=1e-6)
    prior = ss.Normal(0.0, 1e6)
    result = sc.fit_dynamics(
        SechDrift(vector(2.0)), demos, *AGENTS, prior=prior, terms=("transitions",), schedule=schedule
    )
    at = float(result.dynamics.parameters[0])
    assert result.verification.distance == pytest.approx(abs(np.sinh(at)), abs=1e-3)
    assert abs(at) < 0.6
    assert result.converged


@pytest.mark.slow
def test_fit_dynamics_noise_above_its_tolerance_is_not_converged():
    schedule = sc.Schedule(16, policy_warmup=0, batch_size=30, distance_tolerance=0.01, verification_samples=8)
    result = learn(terms=("actions",), schedule=schedule)
    assert result.verification.noise > schedule.noise_tolerance
    assert not result.converged


@pytest.mark.slow
@pytest.mark.parametrize(("horizon", "short"), [(2, True), (30, False)])
def test_fit_dynamics_horizon_before_the_goal_is_seen(horizon, short):
    """Agents are four to six moves away from their goal."""
    task, states = sc.reach_region((5.0,), 0.6, discount=0.9, step_cost=1.0), np.linspace(-1, 1, 20)
    demos = demonstrations_of(states, np.full(20, 2), states + 1, (task,))
    policy = sc.finite_policy(jax.random.key(0), POLICY.actions, sc.task_features(
        sc.task_at(demos.tasks, demos.task), demos.states), width=8)  # fmt: skip
    schedule = sc.Schedule(4, policy_warmup=60, batch_size=20, learning_rate=1e-3, verification_samples=8)
    planner = sc.Planner(horizon=horizon, samples=2, learning_rate=0.05, critic_width=8)
    soft = ss.Behavior(ss.LogSumExp(), 2.0)
    known = Drift(vector(0.0), vector(NOISE))
    result = sc.fit_dynamics(known, demos, soft, policy, planner, terms=("actions",), schedule=schedule)
    assert (result.verification.unfinished > 0.1) == short
    assert ("do not end their task within it" in result.message) == short
    assert not (short and result.converged)


@pytest.mark.slow
def test_fit_dynamics_horizon_with_values_beyond_it_is_not_converged():
    """Agents look two moves ahead, and what follows would change their choices."""
    result = sc.fit_dynamics(
        INITIAL, DEMONSTRATIONS, ss.Behavior(ss.LogSumExp(), 1.5), POLICY, PLANNER,
        prior=PRIOR, terms=("actions",), schedule=replace(LONG, policy_gap_tolerance=0.02),
    )  # fmt: skip
    assert result.verification.beyond_horizon > 0.02
    assert "the horizon is too short: values at its end would move the policy by" in result.message
    assert not result.converged


@pytest.mark.slow
def test_fit_dynamics_of_one_move_sees_the_values_after_it():
    """Rewards are paid in the next state: one move looks at none, and its choices would change with them."""
    schedule = sc.Schedule(4, policy_warmup=40, batch_size=MOVES, learning_rate=1e-3, verification_samples=8)
    soft, myopic = ss.Behavior(ss.LogSumExp(), 1.5), sc.Planner(horizon=1, samples=2, critic_width=4)
    settings = {"prior": PRIOR, "terms": ("actions",), "schedule": schedule}
    result = sc.fit_dynamics(INITIAL, DEMONSTRATIONS, soft, POLICY, myopic, **settings)
    # β γ Q differs between actions by the squares of where they lead
    expected = log_policy(-0.5, STATES) - log_policy(-0.5, STATES).mean(axis=1, keepdims=True)
    assert result.verification.beyond_horizon == pytest.approx(np.mean(expected**2) / 2, rel=0.2)
    assert "the horizon is too short: values at its end would move the policy by" in result.message
    assert not result.converged


def test_fit_dynamics_repeats_by_seed():
    again, other = BOTH(), fitted(1)[0]
    assert again.history == fitted()[0].history
    np.testing.assert_array_equal(again.dynamics.parameters, fitted()[0].dynamics.parameters)
    assert other.history[0] != again.history[0]
    assert not np.array_equal(other.dynamics.parameters, again.dynamics.parameters)


# Checkpoints


@pytest.fixture
def checkpoint(tmp_path):
    """A file that is saved at every iteration."""
    return ss.Checkpoint(tmp_path / "fit.checkpoint", min_interval=0.0, max_fraction=1.0)


def interrupted_at(iteration):
    def report(progress: sc.FitProgress, _):
        if progress.iteration == iteration:
            raise KeyboardInterrupt

    return report


def leaves(result):
    return [np.asarray(leaf) for leaf in jax.tree.leaves((result.dynamics, result.planner_state)) if eqx.is_array(leaf)]


@pytest.mark.slow
def test_fit_dynamics_resumed_is_identical(checkpoint):
    whole = partial(BOTH, checkpoint=checkpoint)
    expected = whole()
    Path(checkpoint.path).unlink()
    for iteration in (2, 3, 9):
        with pytest.raises(KeyboardInterrupt):
            whole(report=interrupted_at(iteration), resume=True)
    went_on_at = []
    result = whole(report=lambda progress, _: went_on_at.append(progress.iteration), resume=True)
    assert went_on_at == list(range(10, 16))
    assert result.history == expected.history
    assert all(map(np.array_equal, leaves(result), leaves(expected)))
    assert (result.message, result.converged) == (expected.message, expected.converged)


def test_fit_dynamics_without_resume_starts_again(checkpoint):
    iterations = []
    with pytest.raises(KeyboardInterrupt):
        BOTH(report=interrupted_at(2), checkpoint=checkpoint)
    BOTH(report=lambda progress, _: iterations.append(progress.iteration), checkpoint=checkpoint)
    assert iterations[0] == 0


def test_fit_dynamics_checkpoint_of_another_problem_is_refused(checkpoint):
    with pytest.raises(KeyboardInterrupt):
        BOTH(report=interrupted_at(2), checkpoint=checkpoint)
    before = Path(checkpoint.path).read_bytes()
    others = {
        "seed": partial(BOTH, seed=1),
        "prior": partial(BOTH, prior=ss.Normal(0.0, 2.0)),
        "terms": partial(BOTH, terms=("actions",)),
        "data": partial(sc.fit_dynamics, INITIAL, demonstrations_of(*walks(1)), *AGENTS, schedule=SHORT),
    }
    for other in others.values():
        with pytest.raises(ss.InputError, match="belongs to a fit of other data or with other settings"):
            other(checkpoint=checkpoint, resume=True)
    assert Path(checkpoint.path).read_bytes() == before
    with pytest.raises(ss.InputError, match="'resume': expected a checkpoint to resume from"):
        BOTH(resume=True)


def test_problem_fingerprint_ignores_addresses_of_functions():
    def policy(offset):
        network = eqx.nn.MLP(1, 3, 4, 1, activation=lambda x: jnp.tanh(x + offset), key=jax.random.key(0))
        return sc.FinitePolicy(ScaledNetwork(network, jnp.zeros(1), jnp.ones(1)), POLICY.actions)

    first, second = policy(0), policy(0)
    assert str(jax.tree.leaves(first)) != str(jax.tree.leaves(second))
    assert problem_fingerprint(first) == problem_fingerprint(second)


# Refusals


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
