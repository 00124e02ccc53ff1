"""Walls and a slip, learned together: three rooms in which every fifth move goes astray.

People know the walls and the slip, and go the best ways. Neither is told: from their walks the model learns where the
walls are, and how often one slips, which is the same in every cell.
"""

import jax
import numpy as np

import sidestep as ss
from sidestep.worlds.rooms import rooms_in_a_row

jax.config.update("jax_enable_x64", True)

flat = rooms_in_a_row(5, 11, doors=(4, 0))
world, blank = ss.SlipperyGrid(flat, slip=float(np.log(0.2 / 0.8))), flat.forget()

goals, free = [0, 24, 4, 28, 10, 52, 31], np.flatnonzero(flat.known.ravel() == ss.Cell.FREE)
tasks = [ss.reach(blank, goal, discount=1.0, step_cost=1.0) for goal in goals]
starts = [np.setdiff1d(free, [goal])[::4] for goal in goals]
demonstrations = ss.gather(ss.simulate(jax.random.key(0), world, tasks, starts), tasks)

behavior = ss.Behavior(ss.BoltzmannAverage(), beta=3.0)
found = ss.fit(ss.SlipperyGrid(blank), demonstrations, behavior, prior=ss.Normal(-2.0, 4.0)).model

print(f"moves slip with probability {found.slip[0]:.2f}; the cells more probably blocked than not:")
for row in np.asarray(found.blocked) > 0.5:
    print(" ".join(".#"[int(cell)] for cell in row))
