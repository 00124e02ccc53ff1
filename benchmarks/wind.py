"""Wind in the plane, learned by rollouts from actions alone, beside its exact posterior.

    python -m benchmarks wind --seeds 0 1 2 3

Agents walk to one of three goals, s′ = s + a + wind + 0.1 ε, with nine displacements, the log-sum-exp and β = 4. The
reference imports neither rollouts nor lattices of the library. It has V on a grid over a torus that is much wider than
the walks. The mean of V over next states is a convolution with a normal density, exact by Fourier transforms. The
objective's gradient and Hessian follow by automatic differentiation, its maximum by Newton's method. The error of the
grid is seen by `--side`: with twice the points the maximum moves by less than a fiftieth of a standard deviation.
The fits have JAX's default 32-bit numbers, the walks and the reference have 64.

Records: `seed`, `wind` (learned), `exact` (the maximum), `deviation` (the standard deviations of the exact posterior,
normal around its maximum), `distance` (of the learned wind from the maximum, the largest component in such standard
deviations), `converged`, `message`, `seconds` of the fit.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import sidestep as ss
import sidestep.continuous as sc
from benchmarks import Record, note, option, print_table

TRUTH, NOISE, BETA, DISCOUNT = np.array([0.25, -0.15]), 0.1, 4.0, 0.95
GOALS, RADIUS, SIDE = ((3.0, 2.0), (-3.0, 2.0), (0.0, -3.5)), 0.8, 5.0
ACTIONS = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
VARIANCE = 1.0
"""Of the prior of each component of the wind, around 0."""
WALKS, MOVES = 35, 40
HORIZON = 24
TORUS, SWEEPS = 24.0, 80
BEHAVIOR = ss.Behavior(ss.LogSumExp(), BETA)


@dataclass
class Options:
    """What to measure."""

    seeds: list[int] = option([0, 1, 2, 3], "seeds of the fits", quick=[0], least=0)
    data_seed: int = option(0, "the seed of the walks", least=0)
    iterations: int = option(0, "steps of the model; 0 for the defaults", quick=20, least=0)
    side: int = option(192, "points along a side of the reference's grid", quick=80)


class Wind(sc.GaussianDynamics):
    """Motion in the plane: s′ = s + a + θ + noise · ε."""

    parameters: Float[Array, " 2"]
    noise: Float[Array, " 2"]

    def outcomes(self, state: Array, action: Array) -> sc.Outcomes:
        """Return the only outcome."""
        return sc.Outcomes.single(state + action + self.parameters)


def wind(speed: np.ndarray) -> Wind:
    """Return the motion under a wind."""
    return Wind(jnp.asarray(speed), jnp.full(2, NOISE))


def tasks() -> list[sc.ReachTask]:
    """Return the task of each goal."""
    return [sc.reach_region(goal, RADIUS, discount=DISCOUNT, step_cost=1.0) for goal in GOALS]


def demonstrations(seed: int) -> ss.Demonstrations:
    """Return the walks of agents that know the wind; they plan on a lattice."""
    random, corner = np.random.default_rng(seed), jnp.full(2, 1.4 * SIDE)
    agent = sc.LatticePlanner(wind(TRUTH), jnp.asarray(ACTIONS), BEHAVIOR, sc.Lattice(-corner, corner, (61, 61)))
    shares = [len(part) for part in np.array_split(np.arange(WALKS), len(GOALS))]
    starts = [_starts(np.array(goal), count, random) for goal, count in zip(GOALS, shares, strict=True)]
    walks = sc.simulate_trajectories(jax.random.key(seed), agent, wind(TRUTH), tasks(), starts, MOVES)
    return sc.gather_trajectories(walks, tasks())


def _starts(goal: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return places in the square that are two meters or more from a goal."""
    places = random.uniform(-SIDE, SIDE, (100 * count, 2))
    return places[np.linalg.norm(places - goal, axis=1) > 2.0][:count]


# ---------------------------------------------------------------------------------------------------- reference


class Reference(NamedTuple):
    """The exact posterior near its maximum: the maximum, and minus the Hessian there."""

    maximum: Float[np.ndarray, " 2"]
    information: Float[np.ndarray, "2 2"]

    @property
    def deviation(self) -> Float[np.ndarray, " 2"]:
        """The standard deviation of each component."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))


def reference(walks: ss.Demonstrations, side: int) -> Reference:
    """Return the maximum of the exact objective, by Newton's method from the truth."""
    speed, bend = TRUTH, np.eye(2)
    slope = jax.jacfwd(partial(objective, walks=walks, side=side))  # forwards: there are two parameters
    derivatives = jax.jit(lambda speed: (slope(speed), jax.jacfwd(slope)(speed)))
    for _ in range(5):
        gradient, hessian = map(np.asarray, derivatives(jnp.asarray(speed)))
        bend = -hessian
        step = np.linalg.solve(bend, gradient)
        speed = speed + step
        if np.abs(step).max() < 1e-4:
            break
    return Reference(speed, bend)


def objective(speed: Array, walks: ss.Demonstrations, side: int) -> Array:
    """Return log L(θ) of the actions plus the logarithm of the prior, but for a constant."""
    total = -jnp.sum(speed**2) / (2 * VARIANCE)
    for index, goal in enumerate(GOALS):
        own = np.flatnonzero(np.asarray(walks.task) == index)
        values = Values(speed, jnp.asarray(goal), side)
        log_policy = jax.nn.log_softmax(BETA * values.action_values(walks.states[own]), axis=1)
        total += jnp.take_along_axis(log_policy, walks.actions[own][:, None], axis=1).sum()
    return total


class Values:
    """The soft values of one task, on a grid over a torus."""

    def __init__(self, speed: Array, goal: Array, side: int):
        self.speed, self.side, spacing = speed, side, TORUS / side
        line = (np.arange(side) - side // 2) * spacing
        self.waves = 2 * np.pi * np.fft.fftfreq(side, spacing)
        places = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
        # the fraction of each cell that lies within the goal, by 16 × 16 points
        fine = ((np.arange(16) + 0.5) / 16 - 0.5) * spacing
        offsets = np.stack(np.meshgrid(fine, fine, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = sum((((places + offset - goal) ** 2).sum(axis=-1) <= RADIUS**2) for offset in offsets) / len(offsets)
        self.going_on = 1 - jnp.asarray(inside)
        self.shifts = jnp.stack([self._shift(jnp.asarray(action)) for action in ACTIONS])
        values = jnp.zeros((side, side))
        self.values, _ = jax.lax.scan(lambda values, _: (self._backup(values), None), values, length=SWEEPS)

    def _shift(self, action: Array) -> Array:
        """Return the transform of the density of s′ − s, so that a product is the mean over s′."""
        phase = [
            jnp.exp(1j * self.waves * (action + self.speed)[axis] - (NOISE * self.waves) ** 2 / 2) for axis in (0, 1)
        ]
        return phase[0][:, None] * phase[1]

    def _backup(self, values: Array) -> Array:
        after = jnp.fft.ifft2(jnp.fft.fft2(values)[None] * self.shifts).real
        return self.going_on * jax.nn.logsumexp(BETA * (-1.0 + DISCOUNT * after), axis=0) / BETA

    def action_values(self, states: Array) -> Float[Array, "states actions"]:
        """Return Q of every action, by the same convolution at any place."""
        transform = jnp.fft.fft2(self.values)[None] * self.shifts / self.side**2
        at = states + self.side // 2 * (TORUS / self.side)
        along = [jnp.exp(1j * at[:, axis, None] * self.waves) for axis in (0, 1)]
        return -1.0 + DISCOUNT * jnp.einsum("aij,si,sj->sa", transform, *along).real


# ---------------------------------------------------------------------------------------------------- fits


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each seed."""
    walks = demonstrations(options.data_seed)
    note(f"the exact posterior of {len(walks)} moves")
    exact = reference(walks, options.side)
    for seed in options.seeds:
        note(f"the fit of seed {seed}")
        started = time.perf_counter()
        learned = fit(walks, seed, options.iterations)
        seconds, speed = time.perf_counter() - started, np.asarray(learned.dynamics.parameters)
        yield {
            "seed": seed,
            "wind": speed.tolist(),
            "exact": exact.maximum.tolist(),
            "deviation": exact.deviation.tolist(),
            "distance": float(np.max(np.abs(speed - exact.maximum) / exact.deviation)),
            "converged": learned.converged,
            "message": learned.message,
            "seconds": seconds,
        }


def fit(walks: ss.Demonstrations, seed: int, iterations: int = 0) -> sc.ContinuousFit[Wind, sc.FinitePolicy]:
    """Return a fit in 32-bit numbers with the default settings; iterations other than 0 make a short one."""
    few = {"iterations": iterations, "policy_warmup": iterations, "verification_samples": 8}
    schedule = sc.Schedule(**few) if iterations else sc.Schedule()
    with jax.enable_x64(False):
        walks, behavior = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), (walks, BEHAVIOR))
        features = sc.task_features(sc.task_at(walks.tasks, walks.task), walks.states)
        policy = sc.finite_policy(jax.random.key(seed), jnp.asarray(ACTIONS), features)
        settings = {"prior": ss.Normal(0.0, VARIANCE), "terms": ("actions",), "schedule": schedule, "seed": seed}
        return sc.fit_dynamics(wind(np.zeros(2)), walks, behavior, policy, sc.Planner(HORIZON), **settings)


def show(records: Sequence[Record], _: Options) -> None:
    """Print the fits beside the exact maximum."""
    rows = [{**record, **_in_words(record)} for record in records]
    columns = {"seed": "seed", "wind": "learned", "maximum": "maximum", "deviation": "deviations"}
    columns |= {"distance": "distance .2f", "converged": "converged", "s": "seconds .0f"}
    print_table("wind learned from actions; distance in exact posterior standard deviations", rows, columns)
    for record in records:
        print(f"seed {record['seed']}: {record['message']}")
    wrong = [str(record["seed"]) for record in records if record["converged"] and record["distance"] > 1]
    print(f"said to have converged beyond one standard deviation: {', '.join(wrong) or 'none'}")


def _in_words(record: Record) -> Record:
    fields = {"learned": "wind", "maximum": "exact", "deviations": "deviation"}
    return {name: "({:.3f}, {:.3f})".format(*record[field]) for name, field in fields.items()}
