"""One fit spread over many devices and processes: a small office is learned from the walks of those who know it.

Every process runs this same script. On one machine, over all devices that JAX finds:

    python examples/many_machines.py

In two processes that find each other over the network (here over loopback):

    python examples/many_machines.py --coordinator 127.0.0.1:12345 --processes 2 --process-id 0 &
    python examples/many_machines.py --coordinator 127.0.0.1:12345 --processes 2 --process-id 1

Under a launcher that JAX knows (SLURM, Open MPI), which tells each process who it is:

    srun python examples/many_machines.py --launched
"""

import argparse

import jax
import numpy as np

import sidestep as ss
from sidestep.worlds.offices import connected_cells, office, places


def find_each_other() -> None:
    """Joins the processes of this run; must come before JAX does anything."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--coordinator", help="address:port of process 0")
    parser.add_argument("--processes", type=int, help="how many there are")
    parser.add_argument("--process-id", type=int, help="which of them this is, from 0")
    parser.add_argument("--launched", action="store_true", help="ask the launcher for all that")
    options = parser.parse_args()
    if options.launched:
        jax.distributed.initialize()
    elif options.coordinator:
        jax.distributed.initialize(options.coordinator, options.processes, options.process_id)


def walks_in(truth: ss.Grid, blank: ss.Grid) -> ss.Demonstrations:
    """What is known of the office: walks of people who know it, to six goals. Every process makes the same ones."""
    random = np.random.default_rng(0)
    goals = places(truth, count=6, seed=0).tolist()
    starts = [random.choice(connected_cells(truth), size=20) for _ in goals]
    starts = [own[own != goal] for own, goal in zip(starts, goals, strict=True)]
    walks = ss.simulate(jax.random.key(0), ss.true_model(truth), [ss.reach(truth, goal) for goal in goals], starts)
    return ss.gather(walks, [ss.reach(blank, goal) for goal in goals])


def main() -> None:
    """Learns the office's walls; the first process says how that went."""
    find_each_other()
    jax.config.update("jax_enable_x64", True)
    truth = office(rows=12, columns=20, seed=0)
    blank = truth.forget()
    behavior = ss.Behavior(ss.BoltzmannAverage(), beta=20.0)
    mesh = ss.tasks_mesh()
    found = ss.fit(
        ss.ObstacleGrid(blank, -2.0), walks_in(truth, blank), behavior, mesh=mesh, optimizer=ss.LBFGS(max_iterations=20)
    )
    if jax.process_index() == 0:
        blocked = np.asarray(found.model.blocked).reshape(truth.shape)
        walls = truth.known == ss.Cell.OCCUPIED
        print(f"{jax.process_count()} process(es), {mesh.size} device(s): {found.message}")
        print(f"objective {found.final.objective:.9f}")
        print(f"P(blocked): {blocked[walls].mean():.3f} in walls, {blocked[~walls].mean():.3f} elsewhere, on average")


if __name__ == "__main__":
    main()
