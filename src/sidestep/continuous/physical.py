"""Physical systems with unknown constants, and Gaussian noise around one step of their integrator.

The **pendulum** is that of Gymnasium's `Pendulum-v1`: the angle φ from upright and its speed ω under a torque u,

    ω′ = ω + (3g/(2ℓ) sin φ + 3u/(mℓ²)) Δt,  kept in [−8, 8],        φ′ = φ + ω′ Δt,        u in [−2, 2].

The **point mass** moves in a plane, pushed by an acceleration a, by wind, and slowed by friction:

    v′ = v + (a + wind − friction · v) Δt,        x′ = x + v′ Δt.

Unknown constants that are above 0 are learned as logarithms, so that steps are relative and none turns negative.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Scalar

from sidestep.continuous.dynamics import GaussianDynamics, Outcomes, certain, check_finite, checked_noise
from sidestep.errors import InputError

PENDULUM_CONSTANTS = ("gravity", "mass", "length")
"""What may be unknown about a pendulum."""


class Pendulum(GaussianDynamics):
    """Gymnasium's `Pendulum-v1`; the state is (φ, ω), the action (u,).

    - `parameters`: the logarithms of the unknown constants, by name.
    - `known`: the other constants.
    - `noise`: of φ′ and ω′.
    """

    parameters: dict[str, Float[Array, ""]]
    known: dict[str, float] = eqx.field(static=True)
    noise: Float[Array, " 2"]
    time_step: float = eqx.field(static=True)

    def __init__(
        self,
        gravity: float = 10.0,
        mass: float = 1.0,
        length: float = 1.0,
        *,
        unknown: Sequence[str] = ("gravity",),
        noise: tuple[float, float] = (0.01, 0.05),
        time_step: float = 0.05,
    ):
        """Raises `InputError` for constants, noise or a time step not above 0, or an unknown that is none of them."""
        values: dict[str, float] = {"gravity": gravity, "mass": mass, "length": length}
        for name, value in (*values.items(), ("time_step", time_step)):
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"expected a finite number above 0, found {value}", field=name)
        if not set(unknown) <= set(values):
            raise InputError(f"expected some of {PENDULUM_CONSTANTS}, found {tuple(unknown)}", field="unknown")
        self.parameters = {name: jnp.log(jnp.asarray(values[name], jnp.result_type(float))) for name in unknown}
        self.known = {name: value for name, value in values.items() if name not in unknown}
        self.noise, self.time_step = checked_noise(jnp.asarray(noise), 2), time_step

    def constant(self, name: str) -> Float[Scalar, ""] | float:
        """A constant in its own units, known or not."""
        return jnp.exp(self.parameters[name]) if name in self.parameters else self.known[name]

    def example_action(self) -> Float[Array, " 1"]:
        """A torque."""
        return jnp.zeros(1, self.noise.dtype)

    def outcomes(self, state: Float[Array, " 2"], action: Float[Array, " 1"]) -> Outcomes:
        """One step of the integrator."""
        gravity, mass, length = (self.constant(name) for name in PENDULUM_CONSTANTS)
        angle, speed = state
        torque = jnp.clip(action[0], -2, 2)
        push = 3 * gravity / (2 * length) * jnp.sin(angle) + 3 / (mass * length**2) * torque
        speed = jnp.clip(speed + push * self.time_step, -8, 8)
        return certain(jnp.stack([angle + speed * self.time_step, speed]))


class PointMass(GaussianDynamics):
    """A point mass in a plane with friction and wind; the state is (x, y, v_x, v_y), the action an acceleration.

    - `parameters`: {"friction": its logarithm, "wind": the acceleration by wind}.
    - `noise`: of each component of the next state.
    """

    parameters: dict[str, Float[Array, "..."]]
    noise: Float[Array, " 4"]
    time_step: float = eqx.field(static=True)

    def __init__(
        self,
        friction: float = 0.5,
        wind: tuple[float, float] = (0.0, 0.0),
        *,
        noise: tuple[float, float, float, float] = (0.01, 0.01, 0.02, 0.02),
        time_step: float = 0.1,
    ):
        """Raises `InputError` for friction, noise or a time step not above 0, and wind that is not finite."""
        for name, value in (("friction", friction), ("time_step", time_step)):
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"expected a finite number above 0, found {value}", field=name)
        real = jnp.result_type(float)
        self.parameters = {"friction": jnp.log(jnp.asarray(friction, real)), "wind": jnp.asarray(wind, real)}
        check_finite(self.parameters)
        self.noise, self.time_step = checked_noise(jnp.asarray(noise), 4), time_step

    def example_action(self) -> Float[Array, " 2"]:
        """An acceleration."""
        return jnp.zeros(2, self.noise.dtype)

    def outcomes(self, state: Float[Array, " 4"], action: Float[Array, " 2"]) -> Outcomes:
        """One step of the integrator."""
        place, speed = state[:2], state[2:]
        friction = jnp.exp(self.parameters["friction"])
        speed = speed + (action + self.parameters["wind"] - friction * speed) * self.time_step
        return certain(jnp.concatenate([place + speed * self.time_step, speed]))
