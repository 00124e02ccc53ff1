"""A small fit spread over devices or processes: what `test_devices` compares, and the program that its children run."""

import argparse
import os
import sys
import traceback
from pathlib import Path

import jax
import numpy as np

from helpers.walled import BLANK, PATHS, follow
from sidestep.errors import InputError
from sidestep.inference.checkpoints import Saver
from sidestep.inference.fit import fit
from sidestep.inference.objective import MEMORY, Objective, Parameters, Problem, tasks_mesh
from sidestep.inference.optimizers import LBFGS
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import BehaviorModel, BehaviorParameters, behavior_model
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

GOALS = ((4, 0.95), (14, 0.95), (0, 0.95), (4, 0.9), (14, 0.9))
"""Five tasks, which neither 4 nor 2 devices can share equally: goals and discounts."""
WAYS = {"jacobi": (Jacobi(), 1.0), "ordered": (GaussSeidel(), MEMORY)}
"""Solvers and memory: as many batches as there can be, and one."""
BENT = 0.3 * np.sin(np.arange(25.0))
"""A change of the parameters, different in every cell."""
ITERATIONS = 5


# what is made of JAX's arrays is made in functions: processes find each other before there are any
def model() -> ObstacleGrid:
    """Where fits start."""
    return ObstacleGrid(BLANK, -2.0)


def walkers() -> BehaviorModel:
    """Who walked."""
    return behavior_model(Behavior(BoltzmannAverage(), 10.0))


def at(theta: jax.Array) -> Parameters:
    """θ of the model, where nothing of people is learned."""
    return Parameters(theta, BehaviorParameters())


def demonstrations(repeats: int = 1) -> Demonstrations:
    """Walks to the first three goals, and to the other two where they are the same."""
    ways = [*PATHS, *((task + 3, start, moves) for task, start, moves in PATHS if task < 2)]
    walks = [Trajectory(*follow(start, moves), task) for task, start, moves in ways * repeats]
    return gather(walks, [reach(BLANK, goal, discount=discount) for goal, discount in GOALS])


def problem(name: str, repeats: int = 1) -> Problem:
    """What is to be solved."""
    solver = WAYS[name][0]
    return Problem(model(), walkers(), demonstrations(repeats), Normal(), ALL_TERMS, SolveOptions(solver=solver))


def measured(name: str, mesh: jax.sharding.Mesh | None) -> dict[str, np.ndarray]:
    """The objective, its parts and its slope at two points, the second from the first one's starts; a short fit."""
    objective = Objective(problem(name), WAYS[name][1], mesh)
    start = model().parameters
    here, starts = objective.evaluate(at(start), objective.cold_starts())
    there, _ = objective.evaluate(at(start + BENT), starts)
    found = fitted(name, mesh)
    return {
        "batches": np.array(len(objective.batches)),
        "parts": np.array([here[:4], there[:4]]),
        "slope": np.array([here.slope.model, there.slope.model]),
        "found": np.asarray(found.model.parameters),
        "sweeps": np.asarray(found.sweeps),
        "converged": np.asarray(found.task_converged),
    }


def fitted(name, mesh, **settings):
    """A fit of a few iterations."""
    solver, memory = WAYS[name]
    settings |= {
        "options": SolveOptions(solver=solver),
        "memory": memory,
        "mesh": mesh,
        "optimizer": LBFGS(iterations=ITERATIONS),
    }
    return fit(model(), demonstrations(), walkers(), **settings)


def resumed(name, mesh, checkpoint: Path) -> np.ndarray:
    """What a fit finds that is interrupted at iteration 3 and goes on from its checkpoint."""
    setattr(Saver, "pause", lambda *_: 0.0)  # noqa: B010
    began = []

    def interrupt(progress):
        if progress.iteration == 3:
            raise KeyboardInterrupt

    try:
        fitted(name, mesh, checkpoint=checkpoint, report=interrupt)
    except KeyboardInterrupt:
        found = fitted(
            name, mesh, checkpoint=checkpoint, resume=True, report=lambda progress: began.append(progress.iteration)
        )
        assert began == [3, 4, 5], began
        return np.asarray(found.model.parameters)
    raise AssertionError("the fit was not interrupted")


def refusal_of_different_data(name, mesh) -> str:
    """What is said if the processes have seen different walks."""
    try:
        Objective(problem(name, 1 + jax.process_index()), MEMORY, mesh)
    except InputError as error:
        return str(error)
    return ""


def main() -> None:
    """Measures and writes what was found into the folder `out`, a file a process."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--port", type=int)
    parser.add_argument("--process", type=int, default=0)
    options = parser.parse_args()
    if options.port:
        jax.distributed.initialize(
            f"127.0.0.1:{options.port}", num_processes=2, process_id=options.process, initialization_timeout=60
        )
    mesh = tasks_mesh()
    for name in WAYS:
        found = measured(name, mesh)
        found["resumed"] = resumed(name, mesh, options.out / f"{name}.checkpoint")
        found["devices"] = np.array(mesh.size)
        np.savez(options.out / f"{name}-{options.process}.npz", allow_pickle=False, **found)
    if options.port:
        (options.out / f"refusal-{options.process}.txt").write_text(refusal_of_different_data("jacobi", mesh))


if __name__ == "__main__":
    try:
        main()
    except BaseException:
        # an orderly end would wait for the other process, which waits for this one
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
