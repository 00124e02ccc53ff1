"""Fits in continuous worlds: they find what is known in closed form, go on where they stopped, and refuse the rest."""

import sys
from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from helpers.families import Drift, Gusts, LaplaceDrift, vector
from sidestep.continuous.demonstrations import gather
from sidestep.continuous.dynamics import LinearGaussian
from sidestep.continuous.fit import Schedule, fit
from sidestep.continuous.likelihood import FitProgress
from sidestep.continuous.obstacles import ObstacleMotion, Walls
from sidestep.continuous.planner import Planner
from sidestep.continuous.policies import FinitePolicy, Scaled, finite_policy, gaussian_policy
from sidestep.continuous.tasks import QuadraticTask, reach, stack
from sidestep.errors import InputError, NotConverged
from sidestep.inference.checkpoints import Saver
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.demonstrations import Trajectory

pytestmark = pytest.mark.usefixtures("unoptimised")

# On a line people walk by −1, 0 or 1 and look two moves ahead, to stay near 0: R(s, a) = −s². Boltzmann-averaging
# people then value Q(s, a) = −s² − γ E(s + a + θ + noise)², whatever they do next.
WAYS, DISCOUNT, NOISE, TRUTH, MOVES = np.array([-1.0, 0.0, 1.0]), 0.9, 0.4, 0.6, 90
NEAR = QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.zeros((1, 1)), jnp.asarray(DISCOUNT))
PEOPLE, PRIOR = Behavior(BoltzmannAverage(), 1.5), Normal(0.0, 50.0)
POLICY = finite_policy(jax.random.key(1), vector(*WAYS)[:, None], jnp.linspace(-2, 2, 9)[:, None], width=4, depth=1)
PLANNER = Planner(horizon=2, places=8, samples=2, learning_rate=0.03, critic_width=4)
BEGINNING = Drift(vector(-0.5), vector(NOISE))


def choosing(drift, states):
    """The logarithm of the probability of every way."""
    values = -1.5 * DISCOUNT * (states[:, None] + WAYS + drift) ** 2
    return values - np.log(np.exp(values).sum(axis=1, keepdims=True))


def walks(seed=0):
    """States, choices, and where these led, of people who know the drift."""
    random = np.random.default_rng(seed)
    states = random.uniform(-2, 2, MOVES)
    choices = np.array([random.choice(3, p=np.exp(row)) for row in choosing(TRUTH, states)])
    return states, choices, states + WAYS[choices] + TRUTH + NOISE * random.normal(size=MOVES)


def demonstrated(states, actions, following, tasks=(NEAR,)):
    moves = zip(states, actions, following, strict=True)
    return gather([Trajectory(np.stack(np.atleast_2d(s, t)).reshape(2, -1), a[None], 0) for s, a, t in moves], tasks)


STATES, CHOICES, FOLLOWING = walks()
DEMONSTRATIONS = demonstrated(STATES, CHOICES, FOLLOWING)
learn = partial(fit, BEGINNING, DEMONSTRATIONS, PEOPLE, POLICY, PLANNER, prior=PRIOR)
SHORT = Schedule(iterations=16, rehearsals=0, moves=30, learning_rate=0.2)
BOTH = partial(learn, estimator="pathwise", schedule=SHORT)


@cache
def fitted(seed=0):
    """A short fit, and all that it reported."""
    reports = []
    return BOTH(seed=seed, report=lambda *report: reports.append(report)), reports


# What is learned


def test_from_transitions_alone_linear_dynamics_are_learned_by_least_squares():
    seen = np.column_stack([STATES, WAYS[CHOICES]])
    following = seen @ [0.7, 0.5] + 0.3 * np.random.default_rng(0).normal(size=MOVES)
    expected = np.linalg.lstsq(seen, following, rcond=None)[0]
    begin = LinearGaussian(jnp.zeros((1, 1)), jnp.zeros((1, 1)), vector(0.3))
    found = fit(
        begin, demonstrated(STATES, CHOICES, following), PEOPLE, POLICY, PLANNER,
        prior=Normal(0.0, 5e5), terms=("transitions",),
        schedule=Schedule(iterations=300, moves=MOVES, learning_rate=0.05),
    )  # fmt: skip
    learned = [float(found.dynamics.parameters[name][0, 0]) for name in ("state", "action")]
    np.testing.assert_allclose(learned, expected, atol=2e-3)
    assert found.history[0].transitions == pytest.approx(norm.logpdf(following, 0, 0.3).sum())
    assert {progress.actions for progress in found.history} == {0}
    assert (found.converged, found.lag) == (True, 0)


def test_from_actions_alone_a_drift_is_learned():
    """As near to where the likelihood of Q(s, a) above is largest as roll-outs can tell."""

    def loss(drift):
        return -choosing(drift, STATES)[np.arange(MOVES), CHOICES].sum() + drift**2 / 100

    schedule = Schedule(iterations=100, rehearsals=0, moves=MOVES, learning_rate=0.1)
    found = learn(terms=("actions",), schedule=schedule)
    learned, best = float(found.dynamics.parameters[0]), minimize_scalar(loss)
    assert learned == pytest.approx(best.x, abs=0.1)  # pyright: ignore[reportAttributeAccessIssue]
    assert abs(learned - TRUTH) < 0.25
    assert {progress.transitions for progress in found.history} == {0}
    assert found.history[0].prior == pytest.approx(-(0.5**2) / 100)


def test_from_vectors_that_people_chose_a_drift_is_learned():
    """People with R(s, a) = −s² − a² choose from a normal distribution, which Riccati's equation gives."""
    beta, discount, count = 4.0, 0.6, 300
    task = QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(discount))
    curve = 1.0  # V(s) = −curve s² − 2 tilt s, whatever else
    for _ in range(100):
        curve = 1 + discount * curve / (1 + discount * curve)
    steepness = 1 + discount * curve
    tilt = discount * curve * TRUTH / (steepness - discount)
    random = np.random.default_rng(2)
    states, spread = random.uniform(-2, 2, count), 1 / np.sqrt(2 * beta * steepness)
    means = -discount * (curve * (states + TRUTH) + tilt) / steepness
    actions = means + spread * random.normal(size=count)
    demos = demonstrated(states, actions[:, None], states + actions + TRUTH, (task,))
    found = fit(
        BEGINNING, demos, Behavior(LogSumExp(), beta),
        gaussian_policy(jax.random.key(0), 1, demos.states, depth=0, spread=0.3),
        Planner(horizon=8, places=16, samples=2, options=8, learning_rate=0.03, critic_width=4),
        prior=PRIOR, terms=("actions",), estimator="pathwise",
        schedule=Schedule(iterations=200, rehearsals=60, moves=30, learning_rate=0.02),
    )  # fmt: skip
    assert found.converged
    assert float(found.dynamics.parameters[0]) == pytest.approx(TRUTH, abs=0.1)
    likelihood = norm.logpdf(actions, means, spread).sum() / count
    assert np.mean([progress.actions for progress in found.history[-30:]]) / count == pytest.approx(likelihood, abs=0.1)


def test_people_know_the_first_model_before_it_moves(monkeypatch):
    """Their policy is found for so many steps; without the actions' term it is of no use."""

    def planned(dynamics, *_, steps, warm, **__):
        assert (dynamics, steps, warm.policy) == (BEGINNING, 3, POLICY)
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules[fit.__module__], "plan", planned)
    with pytest.raises(KeyboardInterrupt):
        learn(schedule=Schedule(rehearsals=3))
    schedule = Schedule(iterations=8, rehearsals=3, moves=MOVES, learning_rate=0.1, drift=0.5)
    assert learn(terms=("transitions",), schedule=schedule).lag == 0


def test_both_terms_add_up():
    found, _ = fitted()
    for progress in found.history:
        assert progress.actions < 0
        assert progress.transitions < 0
        assert progress.objective == pytest.approx(progress.actions + progress.transitions + progress.prior)
        assert progress.gradient > 0
    assert abs(float(found.dynamics.parameters[0]) - TRUTH) < 0.25


def test_any_family_with_a_density_can_be_fitted_and_some_moves_stand_for_all():
    """Laplace's drift is most probable at the median; at the start it is as improbable as all moves together."""
    found = fit(
        LaplaceDrift(vector(0.1)), DEMONSTRATIONS, PEOPLE, POLICY, PLANNER,
        prior=PRIOR, terms=("transitions",), schedule=Schedule(iterations=150, moves=30, learning_rate=0.02),
    )  # fmt: skip
    drifts = FOLLOWING - STATES - WAYS[CHOICES]
    assert float(found.dynamics.parameters[0]) == pytest.approx(np.median(drifts), abs=0.05)
    scaled = np.mean([progress.transitions for progress in found.history[-50:]])
    learned = np.abs(drifts - float(found.dynamics.parameters[0]))
    assert scaled == pytest.approx(-learned.sum() - MOVES * np.log(2), rel=0.02)


# What a fit says of itself


def test_a_fit_is_the_mean_of_its_last_quarter():
    """And it tells how far it still moved, and how far the policy was behind."""
    found, reports = fitted()
    drifts = np.array([float(dynamics.parameters[0]) for _, dynamics in reports])
    assert float(found.dynamics.parameters[0]) == pytest.approx(drifts[12:].mean())
    # a cosine from 0.2 to a twentieth of it
    rates = 0.2 * (0.05 + 0.95 * (1 + np.cos(np.pi * np.arange(16) / 16)) / 2)
    gone = np.cumsum(rates)
    possible = gone[14:].mean() - gone[12:14].mean()
    assert found.drift == pytest.approx(abs(drifts[14:].mean() - drifts[12:14].mean()) / possible, rel=1e-6)
    assert found.lag == pytest.approx(np.mean([progress.lag for progress in found.history[12:]]))
    assert [progress for progress, _ in reports] == list(found.history)
    assert [progress.iteration for progress in found.history] == list(range(16))


def test_a_policy_that_lags_behind_is_not_found_yet():
    found, _ = fitted()
    assert 0 < found.drift < 1
    assert found.lag > 0.1
    assert not found.converged
    assert found.message == (
        f"over the last quarter parameters drifted by up to {found.drift:.2g} of what their steps allow (asked: 0.5), "
        f"and the policy lagged {found.lag:.2g} behind the model (asked: 0.1)"
    )


def test_a_lag_too_noisy_to_tell_is_none_that_is_small():
    """Two roll-outs an option tell so little at this β that their noise is more than what it is taken from."""
    sharp = Behavior(BoltzmannAverage(), 40.0)
    found = fit(BEGINNING, DEMONSTRATIONS, sharp, POLICY, PLANNER, prior=PRIOR, schedule=SHORT)
    assert abs(found.lag) > 0.1
    assert not found.converged


@pytest.mark.parametrize(("asked", "converged"), [(1.0, True), (1e-6, False)])
def test_parameters_that_still_drift_are_not_found_yet(asked, converged):
    schedule = Schedule(iterations=8, rehearsals=3, moves=MOVES, learning_rate=0.1, drift=asked)
    found = learn(terms=("transitions",), schedule=schedule)
    assert 1e-6 < found.drift < 1
    assert found.converged == converged
    assert f"(asked: {asked:g}), and the policy lagged 0 behind" in found.message


def test_parameters_that_go_one_way_drift_as_far_as_they_can():
    """A prior far away is a slope that does not change, and Adam then takes whole steps."""
    schedule = Schedule(iterations=40, moves=MOVES, learning_rate=0.01)
    found = learn(terms=("transitions",), schedule=schedule, prior=Normal(1e4, 5e2))
    assert found.drift == pytest.approx(1, rel=0.05)
    assert not found.converged


def test_the_same_seed_gives_the_same_result_and_another_another():
    again, other = BOTH(), fitted(1)[0]
    assert again.history == fitted()[0].history
    np.testing.assert_array_equal(again.dynamics.parameters, fitted()[0].dynamics.parameters)
    assert other.history[0] != again.history[0]
    assert not np.array_equal(other.dynamics.parameters, again.dynamics.parameters)


# Checkpoints


@pytest.fixture
def checkpoint(tmp_path, monkeypatch):
    """A file that is saved at every iteration."""
    monkeypatch.setattr(Saver, "pause", lambda *_: 0.0)
    return tmp_path / "fit.checkpoint"


def interrupted_at(iteration):
    def report(progress: FitProgress, _):
        if progress.iteration == iteration:
            raise KeyboardInterrupt

    return report


def leaves(found):
    return [np.asarray(leaf) for leaf in jax.tree.leaves((found.dynamics, found.planning)) if eqx.is_array(leaf)]


def test_resumed_to_the_last_bit(checkpoint, monkeypatch):
    whole = partial(BOTH, schedule=replace(SHORT, rehearsals=2), checkpoint=checkpoint)
    expected = whole()
    checkpoint.unlink()
    for iteration in (2, 3, 9):
        with pytest.raises(KeyboardInterrupt):
            whole(report=interrupted_at(iteration), resume=True)
        # what has been rehearsed is in the checkpoint
        monkeypatch.setattr(sys.modules[fit.__module__], "plan", None)
    went_on_at = []
    found = whole(report=lambda progress, _: went_on_at.append(progress.iteration), resume=True)
    assert went_on_at == list(range(10, 16))
    assert found.history == expected.history
    assert all(map(np.array_equal, leaves(found), leaves(expected)))
    assert (found.drift, found.lag, found.message) == (expected.drift, expected.lag, expected.message)


def test_without_resume_a_fit_starts_again(checkpoint):
    iterations = []
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            BOTH(report=interrupted_at(2), checkpoint=checkpoint)
    BOTH(report=lambda progress, _: iterations.append(progress.iteration), checkpoint=checkpoint)
    assert iterations[0] == 0


def test_a_fit_with_other_settings_or_data_does_not_go_on(checkpoint):
    with pytest.raises(KeyboardInterrupt):
        BOTH(report=interrupted_at(2), checkpoint=checkpoint)
    before = checkpoint.read_bytes()
    others = {
        "seed": partial(BOTH, seed=1),
        "prior": partial(BOTH, prior=Normal(0.0, 2.0)),
        "terms": partial(BOTH, terms=("actions",)),
        "data": partial(fit, BEGINNING, demonstrated(*walks(1)), PEOPLE, POLICY, PLANNER, schedule=SHORT),
    }
    for other in others.values():
        with pytest.raises(InputError, match="belongs to a fit of other data or with other settings"):
            other(checkpoint=checkpoint, resume=True)
    assert checkpoint.read_bytes() == before
    with pytest.raises(InputError, match="'resume': expected a checkpoint to resume from"):
        BOTH(resume=True)


def test_another_process_can_go_on(monkeypatch):
    """There the functions in a policy lie elsewhere in memory, as those of a policy that is made anew do here."""

    def policy(offset):
        network = eqx.nn.MLP(1, 3, 4, 1, activation=lambda x: jnp.tanh(x + offset), key=jax.random.key(0))
        return FinitePolicy(Scaled(network, jnp.zeros(1), jnp.ones(1)), POLICY.actions)

    def seen(_, __, key):
        keys.append(key)
        raise KeyboardInterrupt

    keys = []
    monkeypatch.setattr(Saver, "__init__", seen)
    for same in (policy(0), policy(0)):
        assert "0x" in str(jax.tree.leaves(same))
        with pytest.raises(KeyboardInterrupt):
            fit(BEGINNING, DEMONSTRATIONS, PEOPLE, same, PLANNER, schedule=SHORT, checkpoint="any")
    assert keys[0] == keys[1]


# Refusals


def changed(**fields):
    """The demonstrations with other arrays in them."""
    names, values = fields.keys(), tuple(fields.values())
    return eqx.tree_at(lambda demos: [getattr(demos, name) for name in names], DEMONSTRATIONS, list(values))


VECTORS = changed(actions=vector(*WAYS[CHOICES])[:, None])
GAUSSIAN = gaussian_policy(jax.random.key(0), 1, vector(0, 1)[:, None], width=2, depth=1)
NAN = DEMONSTRATIONS.states.at[4, 0].set(jnp.nan)


class Broken(Drift):
    """A family with a mistake in it: where a walker steps back, the density is that of nothing, or not a number."""

    density: float = eqx.field(static=True, default=jnp.nan)

    def log_prob(self, state, action, next_state):
        return jnp.where(action[0] < 0, self.density, super().log_prob(state, action, next_state))


def broken(density):
    return Broken(vector(0), vector(NOISE), density)


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
    ({"demonstrations": changed(task=DEMONSTRATIONS.task.at[1].set(-1))}, r"'task': expected tasks in 0…0"),
    ({"demonstrations": changed(tasks=stack([eqx.tree_at(lambda task: task.discount, NEAR, jnp.asarray(0.0))]))},
     "'discount': expected a number above 0 and at most 1, found 0"),
    ({"dynamics": broken(jnp.nan)}, f"trajectory {FIRST_BACK}, field 'log_prob': .* found the logarithm nan"),
    ({"dynamics": broken(-jnp.inf)}, "'log_prob': expected a density above 0 .* found the logarithm -inf"),
    ({"dynamics": Drift(vector(jnp.nan), vector(NOISE))}, "'parameters': expected finite numbers"),
    ({"dynamics": ObstacleMotion(Walls(low=jnp.ones((1, 1)), high=jnp.ones((1, 1))), vector(-9), vector(9), vector(1))},
     "'dynamics': expected parameters to learn, found none"),
    ({"planner": Planner(horizon=0)}, "'horizon': expected at least 1, found 0"),
    ({"planner": Planner(horizon=2, samples=1)}, "'samples': expected at least 2, found 1"),
    ({"planner": Planner(horizon=2, places=0)}, "'places': expected at least 1, found 0"),
    ({"planner": Planner(horizon=2, learning_rate=0.0)}, "'learning_rate': expected a finite number above 0, found 0"),
    ({"terms": ()}, r"'terms': expected one or both of .*, found \(\)"),
    ({"schedule": Schedule(iterations=0)}, "'iterations': expected at least 2, found 0"),
    ({"schedule": Schedule(moves=0)}, "'moves': expected at least 1, found 0"),
    ({"schedule": Schedule(policy_steps=0)}, "'policy_steps': expected at least 1, found 0"),
    ({"schedule": Schedule(rehearsals=-1)}, "'rehearsals': expected at least 0, found -1"),
    ({"schedule": Schedule(learning_rate=0.0)}, "'learning_rate': expected a finite number above 0, found 0"),
    ({"schedule": Schedule(learning_rate=jnp.inf)}, "'learning_rate': expected a finite number above 0, found inf"),
    ({"schedule": Schedule(drift=jnp.nan)}, "'drift': expected a finite number above 0, found nan"),
    ({"demonstrations": changed(next_states=NAN)}, "'next_states': expected finite numbers"),
    ({"demonstrations": changed(tasks=stack([reach((0.0,), 9.0)]))}, "states, row 1: .*has not ended"),
    ({"dynamics": LinearGaussian(jnp.eye(2), jnp.ones((2, 1)), vector(1, 1))},
     r"'demonstrations': expected states and actions that the dynamics can take, found shapes \(1,\)"),
    ({"estimator": "pathwise", "dynamics": Gusts(vector(0, 0, 0))},
     "'estimator': these dynamics jump, .*: expected 'score'"),
    ({"estimator": "pathwise", "demonstrations": changed(tasks=stack([reach((9.0,), 0.1)]))},
     "'estimator': the returns of these tasks jump, .*: expected 'score'"),
    *(({"policy": GAUSSIAN, "demonstrations": VECTORS, "behavior": Behavior(backup)},
       "'behavior': over vectors of actions people's policy is known for the log-sum-exp only")
      for backup in (BoltzmannAverage(), HardMax(), Mellowmax())),
])  # fmt: skip
def test_fits_refuse(change, match):
    settings = {
        "dynamics": BEGINNING, "demonstrations": DEMONSTRATIONS, "behavior": PEOPLE, "policy": POLICY,
        "planner": PLANNER, "schedule": SHORT,
    }  # fmt: skip
    with pytest.raises(InputError, match=match):
        fit(**{**settings, **change})


def test_no_moves_are_no_demonstrations():
    nothing = jax.tree.map(lambda leaf: leaf[:0], eqx.tree_at(lambda demos: demos.tasks, DEMONSTRATIONS, None))
    nothing = eqx.tree_at(lambda demos: demos.tasks, nothing, DEMONSTRATIONS.tasks, is_leaf=lambda leaf: leaf is None)
    with pytest.raises(InputError, match="'states': expected places and a task for each, found 0"):
        fit(BEGINNING, nothing, PEOPLE, POLICY, PLANNER)


def test_rewards_beyond_all_numbers_end_a_fit():
    """They overflow, and what is infinite less what is infinite is not a number."""
    tasks = stack([eqx.tree_at(lambda task: task.state_cost, NEAR, 1e308 * jnp.eye(1))])
    with pytest.raises(NotConverged, match="the figures ceased to be finite at iteration 0: dynamics or rewards"):
        fit(BEGINNING, changed(tasks=tasks), PEOPLE, POLICY, PLANNER, prior=PRIOR, estimator="pathwise", schedule=SHORT)
