"""Roll-outs: how fast they are, what an update of a model takes, and how noisy the estimators of eq. 11 are.

    python -m benchmarks rollouts --part noise --horizons 5 10 20 40 80 --problems "pendulum, upright"

Speed. The room and the pendulum of `sidestep experiment`, with the experiments' own planners and batches; the walks are
made up, since their content does not change the time. An *update* is an iteration of `fit`, from one report to the
next: one step of the model, the policy and its critic. Its parts are compiled and timed by themselves: the roll-outs;
the model's gradient (`value_gradient`, less the roll-outs); the policy's; the critic's. The whole computes once what
the parts share, so the parts need not add up to it. Steps are those of single roll-outs. With `--quick` the compiler
hardly optimizes, so times mean nothing.

Noise. One roll-out gives one estimate of ∇_θ Q^π(s, a): by score, by score with a critic, along the path (with a critic
for the draws of the policy, as in a fit). Shown are the standard deviation of one estimate (a norm over parameters, the
root of the mean square over 16 places), its ratio to the pathwise one, how many roll-outs bring the standard deviation
of their mean to a tenth of the gradient's norm, the time for one, and how far the mean of all is from that of the least
noisy estimator, in standard errors (the largest over parameters). All are unbiased, so that is hardly above 3, unless
few rare roll-outs make up the mean. Problems: linear dynamics that turn by 0.3 and shrink to 0.9 or grow to 1.05 a
move, with a Gaussian policy (six parameters); a pendulum held where it hangs, or upright, with five torques (the
logarithm of gravity). The policy is that of agents who look as far ahead as the longest roll-outs, so it is the same
for all lengths; each length has a critic of its own for it.

Records: `part`, `name`, `horizon`; for speed `estimator`, `roll_outs` (a batch), `steps_per_second`, and `..._seconds`
of `update`, `roll_outs`, `model`, `policy`, `critic`; for noise `problem`, `deviation`, `relative`, `gradient`,
`roll_outs_needed`, `seconds`, `errors_from_best`.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PRNGKeyArray, PyTree

from benchmarks import Record, in_turns, median, note, option, print_table, seconds_of
from sidestep import continuous as ct
from sidestep.continuous.estimators import Estimator
from sidestep.experiments.pendulum import PendulumConfig
from sidestep.experiments.room import RoomConfig
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Demonstrations, Trajectory
from sidestep.worlds.continuous_room import random_starts, room

CASES = ("room, score", "pendulum, score", "pendulum, pathwise")
WALKERS, WIDTH = 25, 48
AGENTS, DISCOUNT = Behavior(LogSumExp(), 2.0), 0.95
ESTIMATORS = ("score", "score and critic", "pathwise")
PROBLEMS = ("linear, stable", "linear, unstable", "pendulum, hanging", "pendulum, upright")
PLACES, STARTS, UNMOVED = 16, 128, 1e-30
PLANNER = ct.Planner(
    horizon=1, batch_size=16, samples=2, candidates=4, learning_rate=0.02, critic_rate=0.01, critic_width=32
)


@dataclass
class Options:
    """The options of this benchmark."""

    part: str = option("both", "one of the two only", choices=("both", "speed", "noise"))
    cases: list[str] = option(list(CASES), "fits", quick=[CASES[-1]], choices=CASES)
    iterations: int = option(20, "updates a turn", quick=1)
    turns: int = option(5, "how often everything is timed", quick=1)
    problems: list[str] = option(list(PROBLEMS), "problems of the noise", quick=[PROBLEMS[0]], choices=PROBLEMS)
    horizons: list[int] = option([5, 10, 20, 40], "lengths of roll-outs", quick=[10])
    samples: int = option(256, "roll-outs from each of 16 places, a turn", quick=64)
    steps: int = option(300, "of the policy and the critic", quick=10)
    hardly_optimized: bool = option(False, "compile fast", quick=True)


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each fit, and for each problem, horizon and estimator."""
    if options.hardly_optimized:
        jax.config.update("jax_disable_most_optimizations", True)
    for name in options.cases if options.part != "noise" else ():
        yield speed(name, options)
    for name in options.problems if options.part != "speed" else ():
        yield from noise(name, options)


# ---------------------------------------------------------------------------------------------------- speed


class Case(NamedTuple):
    """A fit: its agent, demonstrations, planner, moves in a batch and estimator."""

    agent: ct.Agent[ct.FinitePolicy]
    demonstrations: Demonstrations
    planner: ct.Planner
    moves: int
    estimator: Estimator


class Batch(eqx.Module):
    """What one update looks at."""

    starts: ct.Starts
    chosen: Array
    weights: Array


def case_of(name: str) -> Case:
    """Return the fit of that name."""
    world, estimator = name.split(", ")
    random, config = np.random.default_rng(0), RoomConfig() if world == "room" else PendulumConfig()
    if isinstance(config, RoomConfig):
        rooms = room(config.lattice_points)
        tasks, actions, begins = rooms.tasks, rooms.actions, random_starts(rooms, WALKERS, random)
        dynamics = rooms.with_field(config.radial_field(rooms))
    else:
        dynamics, tasks, actions = ct.Pendulum(noise=config.noise), config.tasks, config.actions
        begins = [np.array([goal, 0.0]) + random.uniform(-1, 1, (WALKERS, 2)) for goal in config.goals]
    states, task = jnp.asarray(np.concatenate(begins)), jnp.repeat(jnp.arange(len(tasks)), WALKERS)
    features = ct.task_features(ct.task_at(ct.batch_tasks(tasks), task), states)
    policy = ct.finite_policy(jax.random.key(0), actions, features, width=WIDTH)
    trajectories = [
        Trajectory(np.stack([state, state + random.normal(0, 0.1, 2)]), random.integers(len(actions), size=1), index)
        for state, index in zip(np.asarray(states), task.tolist(), strict=True)
    ]
    by: Estimator = "pathwise" if estimator == "pathwise" else "score"
    demonstrations, moves = ct.gather_trajectories(trajectories, tasks), config.schedule.batch_size
    return Case(ct.Agent(dynamics, policy, config.behavior), demonstrations, config.planner, moves, by)


def speed(name: str, options: Options) -> Record:
    """Return the record of one fit: medians over turns, in each of which a fit goes on for some iterations."""
    case, key = case_of(name), jax.random.key(2)
    planner, demos = case.planner, case.demonstrations
    drawn = jax.random.choice(key, len(demos), (case.moves,), replace=False)
    tasks, states = ct.task_at(demos.tasks, demos.task[drawn]), demos.states[drawn]
    note(f"{name}: compiling")
    planning, _ = _fitted(case, options.iterations)
    choices, weights = planner.candidate_actions(key, case.agent.policy, tasks, states)
    batch = Batch(ct.Starts(tasks, states, choices), demos.actions[drawn], weights)
    rolled = _roll(case, batch, key)

    def timed(function: Callable, *inputs: object) -> Callable[[], float]:
        return lambda: seconds_of(lambda: jax.block_until_ready(function(case, *inputs)))

    calls = {
        "update": lambda: _fitted(case, options.iterations)[1],
        "roll_outs": timed(_roll, batch, key),
        "both": timed(_model_gradient, planning, batch, key),
        "policy": timed(_policy_step, planning, batch, rolled),
        "critic": timed(_critic_step, planning, batch, rolled),
    }
    for part in ("both", "policy", "critic"):  # the others are compiled by now
        calls[part]()
    note(f"{name}: timing")
    seconds = {part: median(taken) or 0.0 for part, taken in in_turns(calls, options.turns).items()}
    seconds["model"] = seconds.pop("both") - seconds["roll_outs"]
    return {
        "part": "speed",
        "name": name.split(", ")[0],
        "estimator": case.estimator,
        "roll_outs": int(np.prod(rolled.acting.shape[:-1])),
        "horizon": planner.horizon,
        "steps_per_second": rolled.acting.size / seconds["roll_outs"],
        **{f"{part}_seconds": value for part, value in seconds.items()},
    }


def _fitted(case: Case, iterations: int) -> tuple[ct.PlannerState[ct.FinitePolicy], float]:
    """Return what a fit knows in the end, and the median time between reports (the first comes after compiling)."""
    reported: list[float] = []
    result = ct.fit_dynamics(
        case.agent.dynamics,
        case.demonstrations,
        case.agent.behavior,
        case.agent.policy,
        case.planner,
        estimator=case.estimator,
        schedule=ct.Schedule(iterations=1 + iterations, policy_warmup=0, batch_size=case.moves),
        report=lambda *_: reported.append(time.perf_counter()),
    )
    return result.planner_state, float(np.median(np.diff(reported)))


@eqx.filter_jit
def _roll(case: Case, batch: Batch, key: PRNGKeyArray) -> ct.Rollout:
    return ct.sample_rollouts(case.agent, batch.starts, key, case.planner.horizon, case.planner.samples)


@eqx.filter_jit
def _model_gradient(case: Case, planning: ct.PlannerState[ct.FinitePolicy], batch: Batch, key: PRNGKeyArray) -> PyTree:
    """Return ∇ of the actions' log-likelihood, with the roll-outs that it takes."""
    agent, planner = replace(case.agent, policy=planning.policy), case.planner
    behavior = agent.behavior

    def weigh(q: Array) -> Array:
        return behavior.beta * (jax.nn.one_hot(batch.chosen, q.shape[1]) - jnp.exp(behavior.log_policy(q)))

    keywords = {"critic": planning.critic, "estimator": case.estimator}
    size = {"horizon": planner.horizon, "samples": planner.samples}
    return ct.value_gradient(agent, batch.starts, key, weigh, **size, **keywords)[0]


@eqx.filter_jit
def _policy_step(case: Case, planning: ct.PlannerState, batch: Batch, rolled: ct.Rollout) -> PyTree:
    """Return the policy after a step; the compiler leaves out the critic's."""
    return case.planner.update(planning, case.agent.behavior, rolled, batch.weights)[0].policy


@eqx.filter_jit
def _critic_step(case: Case, planning: ct.PlannerState, batch: Batch, rolled: ct.Rollout) -> ct.Critic:
    """Return the critic after a step; the compiler leaves out the policy's."""
    return case.planner.update(planning, case.agent.behavior, rolled, batch.weights)[0].critic


# ---------------------------------------------------------------------------------------------------- noise


class Problem(eqx.Module):
    """An agent in dynamics with a gradient to estimate, a task, and states where roll-outs may start."""

    agent: ct.Agent
    task: ct.ContinuousTask
    states: Array


class Noise(NamedTuple):
    """What many estimates of the same gradients show.

    Attributes:
        mean: Over all of them, for each parameter.
        error: Its standard error.
        deviation: The standard deviation of one estimate, as a norm over parameters.
        square: The squared norm of the gradient, the mean over places.
        seconds: For one roll-out and its gradient, the median over turns.
    """

    mean: np.ndarray
    error: np.ndarray
    deviation: float
    square: float
    seconds: float

    def errors_from(self, other: "Noise") -> float:
        """Return how far two means differ, in standard errors, at most over parameters; 0 of a mean and itself."""
        error = np.sqrt(self.error**2 + other.error**2)
        return float(np.max(np.abs(self.mean - other.mean) / np.where(error > 0, error, 1.0)))


def problem_of(name: str) -> Problem:
    """Return the problem of that name, its policy as it begins."""
    kind, place = name.split(", ")
    random, discount = np.random.default_rng(0), jnp.asarray(DISCOUNT)
    if kind == "linear":
        growth = 0.9 if place == "stable" else 1.05
        turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
        dynamics = ct.LinearGaussian(jnp.asarray(growth * turn), jnp.array([[0.0], [0.5]]), jnp.full(2, 0.1))
        task = ct.QuadraticTask(jnp.zeros(2), jnp.eye(2), 0.1 * jnp.eye(1), discount)
        states = jnp.asarray(random.uniform(-1, 1, (STARTS, 2)))
        examples = jax.vmap(task.features)(states)
        policy = ct.gaussian_policy(jax.random.key(1), 1, examples, spread=0.5, depth=0)
        return Problem(ct.Agent(dynamics, policy, AGENTS), task, states)
    angle = np.pi if place == "hanging" else 0.0
    task = ct.PendulumTask(jnp.asarray(angle), discount)
    states = jnp.asarray(np.array([angle, 0.0]) + random.uniform(-0.4, 0.4, (STARTS, 2)))
    examples, torques = jax.vmap(task.features)(states), jnp.linspace(-2.0, 2.0, 5)[:, None]
    policy = ct.finite_policy(jax.random.key(1), torques, examples, width=32)
    return Problem(ct.Agent(ct.Pendulum(), policy, AGENTS), task, states)


def planned(problem: Problem, horizon: int, steps: int, *, moving: bool = True) -> tuple[ct.Policy, ct.Critic]:
    """Return a policy for the problem and a critic for the policy; unless `moving`, the policy stays as it is."""
    planner = replace(PLANNER, horizon=horizon, learning_rate=PLANNER.learning_rate if moving else UNMOVED)
    tasks, task = ct.batch_tasks([problem.task]), jnp.zeros(STARTS, jnp.int32)
    result = ct.plan_policy(problem.agent, tasks, problem.states, task, planner, steps=steps)
    return result.policy, result.planner_state.critic


def noise(name: str, options: Options) -> Iterator[Record]:
    """Yield the records of one problem."""
    problem, longest = problem_of(name), max(options.horizons)
    note(f"{name}: computing a policy")
    policy, critic = planned(problem, longest, options.steps)
    problem = replace(problem, agent=replace(problem.agent, policy=policy))
    for horizon in options.horizons:
        note(f"{name}: horizon {horizon}")
        own = critic if horizon == longest else planned(problem, horizon, options.steps, moving=False)[1]
        yield from noise_records(name, horizon, measured(problem, own, horizon, options))


def noise_records(name: str, horizon: int, noise: dict[str, Noise]) -> Iterator[Record]:
    """Yield the records of all estimators at one horizon; the gradient's norm is by the least noisy of them."""
    best = min(noise.values(), key=lambda each: each.deviation)
    for estimator, own in noise.items():
        yield {
            "part": "noise",
            "name": estimator,
            "problem": name,
            "horizon": horizon,
            "deviation": own.deviation,
            "relative": own.deviation / noise["pathwise"].deviation,
            "gradient": float(np.sqrt(best.square)) if best.square > 0 else None,
            "roll_outs_needed": 100 * own.deviation**2 / best.square if best.square > 0 else None,
            "seconds": own.seconds,
            "errors_from_best": own.errors_from(best),
        }


def measured(problem: Problem, critic: ct.Critic, horizon: int, options: Options) -> dict[str, Noise]:
    """Return what each of the estimators shows, all with the same random numbers."""
    gradients: dict[str, list[np.ndarray]] = {name: [] for name in ESTIMATORS}
    keys = jax.random.key(2)
    drawing = jax.random.split(jax.random.fold_in(keys, 0), PLACES)
    choices = jax.vmap(problem.agent.policy.sample)(drawing, jax.vmap(problem.task.features)(problem.states[:PLACES]))

    def call(name: str) -> float:
        key = jax.random.fold_in(keys, 1 + len(gradients[name]))
        own, estimator = (None if name == "score" else critic), ("pathwise" if name == "pathwise" else "score")
        started = time.perf_counter()
        gradients[name].append(np.asarray(_estimates(problem, own, estimator, key, choices, horizon, options.samples)))
        return (time.perf_counter() - started) / (options.samples * PLACES)

    taken = in_turns({name: lambda name=name: call(name) for name in ESTIMATORS}, 1 + options.turns)
    # the first call of each was compiled in
    return {name: noise_of(np.concatenate(gradients[name], axis=1), median(taken[name][1:])) for name in ESTIMATORS}


@eqx.filter_jit
def _estimates(
    problem: Problem,
    critic: ct.Critic | None,
    by: Estimator,
    key: PRNGKeyArray,
    choices: Array,
    horizon: int,
    samples: int,
) -> Array:
    """Return the gradient that each roll-out gives by itself: places × samples × parameters."""
    tasks = ct.batch_tasks([problem.task])

    def one(state: Array, choice: Array, key: PRNGKeyArray) -> Array:
        inputs = (problem.agent, ct.Starts(tasks, state[None], choice[None, None]), key, jnp.ones_like)
        return ravel_pytree(ct.value_gradient(*inputs, horizon=horizon, samples=1, critic=critic, estimator=by)[0])[0]

    keys = jax.random.split(key, (PLACES, samples))
    return jax.vmap(jax.vmap(one, (None, None, 0)))(problem.states[:PLACES], choices, keys)


def noise_of(gradients: np.ndarray, seconds: float | None) -> Noise:
    """Return what estimates of the gradients of several places show (places × samples × parameters)."""
    places, samples, _ = gradients.shape
    means, variances = gradients.mean(axis=1), gradients.var(axis=1, ddof=1)
    variance = float(variances.sum(axis=-1).mean())
    # the squares of means hold a part of their variance
    square = float((means**2).sum(axis=-1).mean()) - variance / samples
    error = np.sqrt(variances.mean(axis=0) / (places * samples))
    return Noise(means.mean(axis=0), error, float(np.sqrt(variance)), square, seconds or 0.0)


# ---------------------------------------------------------------------------------------------------- reporting


def show(records: Sequence[Record], options: Options) -> None:
    """Print a table for each part, and where the pathwise estimator is the noisier one."""
    speeds, noises = ([r for r in records if r["part"] == part] for part in ("speed", "noise"))
    if speeds:
        columns = {"fit": "name", "estimator": "estimator", "roll-outs": "roll_outs", "horizon": "horizon"}
        columns |= {"steps/s": "steps_per_second ,.0f"}
        columns |= {part: f"{part}_seconds ms" for part in ("update", "roll_outs", "model", "policy", "critic")}
        print_table("updates and their parts, each timed by itself; ms", speeds, columns)
    if noises:
        columns = {"problem": "problem", "horizon": "horizon", "estimator": "name", "deviation": "deviation .4g"}
        columns |= {"× pathwise": "relative .3g", "‖gradient‖": "gradient .3g", "needed": "roll_outs_needed ,.0f"}
        columns |= {"µs each": "seconds µs", "errors from best": "errors_from_best .1f"}
        title = "one roll-out's gradient: standard deviation, and how many it takes for an error of 10 %"
        print_table(title, noises, columns)
        worse = [r for r in noises if r["name"] == "score and critic" and r["relative"] < 1]
        names = "; ".join(f"{record['problem']} at {record['horizon']}" for record in worse)
        print(f"noisier along the path than by score and critic: {names or 'none'} ({options.samples} samples)")
