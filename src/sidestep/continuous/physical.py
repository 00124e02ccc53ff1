"""Physical systems with unknown constants, and Gaussian noise around one step of their integrator.

The **pendulum** is that of Gymnasium's `Pendulum-v1`: the angle φ from upright and its speed ω under a torque u,

    ω′ = ω + (3g/(2ℓ) sin φ + 3u/(mℓ²)) Δt,  clipped to [−8, 8],        φ′ = φ + ω′ Δt,        u in [−2, 2].

The **point mass** moves in a plane under an acceleration a, wind and friction:

    v′ = v + (a + wind − friction · v) Δt,        x′ = x + v′ Δt.

Unknown constants above 0 are learned as logarithms: steps are relative, and no constant becomes negative.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Scalar

from sidestep._arguments import to_finite
from sidestep.continuous.dynamics import GaussianDynamics, Outcomes, checked_noise
from sidestep.errors import check_choice, check_positive, to_list

PENDULUM_CONSTANTS = ("gravity", "mass", "length")
"""The constants of a pendulum that may be unknown."""


class Pendulum(GaussianDynamics):
    """Gymnasium's `Pendulum-v1`; the state is (φ, ω) in radians and radians per second, the action (u,).

    Args:
        gravity: The gravity g in m/s², above 0.
        mass: The mass m in kg, above 0.
        length: ℓ in m, above 0.
        unknown: The names of the constants to learn, from `PENDULUM_CONSTANTS`.
        noise: The standard deviations of φ′ and ω′, above 0.
        time_step: Δt in seconds, above 0.

    Attributes:
        parameters: The logarithms of the unknown constants, by name.
        known: The other constants.

    Raises:
        InputError: For constants, noise or a time step not above 0, or an unknown name.

    Example:
        >>> pendulum = Pendulum(gravity=10.0)
        >>> [round(float(x), 4) for x in pendulum.outcomes(jnp.zeros(2), jnp.array([1.0])).means[0]]
        [0.0075, 0.15]
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
        values: dict[str, float] = dict(zip(PENDULUM_CONSTANTS, (gravity, mass, length), strict=True))
        for name, value in (*values.items(), ("time_step", time_step)):
            check_positive(value, name)
        for name in to_list(unknown, str, "unknown", 0):
            check_choice(name, PENDULUM_CONSTANTS, "unknown")
        self.parameters = {name: jnp.log(jnp.asarray(values[name], jnp.result_type(float))) for name in unknown}
        self.known = {name: value for name, value in values.items() if name not in unknown}
        self.noise, self.time_step = checked_noise(noise, 2), time_step

    def constant(self, name: str) -> Float[Scalar, ""] | float:
        """Return a constant in its own unit, whether known or learned.

        Args:
            name: The name of the constant.
        """
        return jnp.exp(self.parameters[name]) if name in self.parameters else self.known[name]

    def example_action(self) -> Float[Array, " 1"]:
        """Return a torque."""
        return jnp.zeros(1, self.noise.dtype)

    def outcomes(self, state: Float[Array, " 2"], action: Float[Array, " 1"]) -> Outcomes:
        """Return one step of the integrator.

        Args:
            state: The state s.
            action: The action a.

        Returns:
            A single outcome: the angle from upright and the angular speed.
        """
        gravity, mass, length = (self.constant(name) for name in PENDULUM_CONSTANTS)
        angle, speed = state
        acceleration = 3 * gravity / (2 * length) * jnp.sin(angle) + 3 / (mass * length**2) * jnp.clip(action[0], -2, 2)
        speed = jnp.clip(speed + acceleration * self.time_step, -8, 8)
        return Outcomes.single(jnp.stack([angle + speed * self.time_step, speed]))


class PointMass(GaussianDynamics):
    """A point mass in a plane; the state is (x, y, v_x, v_y), the action an acceleration.

    Args:
        friction: The deceleration per unit of speed, above 0.
        wind: The acceleration by wind.
        noise: The standard deviation of each component of the next state, above 0.
        time_step: Δt, above 0.

    Attributes:
        parameters: {"friction": its logarithm, "wind": the acceleration by wind}.

    Raises:
        InputError: For friction, noise or a time step not above 0, or wind that is not finite.

    Example:
        >>> [round(float(x), 3) for x in PointMass().outcomes(jnp.zeros(4), jnp.array([1.0, 0.0])).means[0]]
        [0.01, 0.0, 0.1, 0.0]
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
        check_positive(friction, "friction")
        check_positive(time_step, "time_step")
        real, wind = jnp.result_type(float), to_finite(wind, "wind", (2,))
        self.parameters = {"friction": jnp.log(jnp.asarray(friction, real)), "wind": jnp.asarray(wind, real)}
        self.noise, self.time_step = checked_noise(noise, 4), time_step

    def example_action(self) -> Float[Array, " 2"]:
        """Return an acceleration."""
        return jnp.zeros(2, self.noise.dtype)

    def outcomes(self, state: Float[Array, " 4"], action: Float[Array, " 2"]) -> Outcomes:
        """Return one step of the integrator.

        Args:
            state: The state s.
            action: The action a.

        Returns:
            A single outcome: the place (two numbers) and the velocity (two numbers).
        """
        place, speed = state[:2], state[2:]
        friction = jnp.exp(self.parameters["friction"])
        speed = speed + (action + self.parameters["wind"] - friction * speed) * self.time_step
        return Outcomes.single(jnp.concatenate([place + speed * self.time_step, speed]))
