"""A world that is no grid: learn which actions fail from people who avoid them.

Four places in a row, and an action "jump" that would lead from the first place straight to the last. It fails, and
everybody knows: nobody ever jumps. From walks alone the model learns that jumping does not work.
"""

import jax
import jax.numpy as jnp
import numpy as np

import sidestep as ss

WALK, JUMP = 0, 1
PLACES = 4

jax.config.update("jax_enable_x64", True)

# outcome 0 of an action is where it should lead, outcome 1 is staying put
leads_to = np.array([[[min(place + 1, 3), place], [3, place]] for place in range(PLACES)])
world = ss.TabularModel(ss.graph(leads_to), jnp.zeros(leads_to.shape))

task = ss.reach(world.graph, goal=3, discount=0.9)
walk = ss.Trajectory(states=np.arange(PLACES), actions=np.full(PLACES - 1, WALK), task=0)
demonstrations = ss.gather([walk] * 20, [task])

behavior = ss.Behavior(ss.BoltzmannAverage(), beta=10.0)
fit = ss.fit(world, demonstrations, behavior, prior=ss.Normal(0.0, 2.0))

works = fit.model.probabilities()[:, :, 0]
print(fit.message)
print(f"walking from the first place works with probability {works[0, WALK]:.2f}, jumping with {works[0, JUMP]:.2f}")
