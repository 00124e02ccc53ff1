"""A small fit over devices or processes: what `test_devices` compares, and the program of its child processes."""

import argparse
import os
import sys
import traceback
from pathlib import Path

import jax
import numpy as np

from helpers.walled import BLANK, PATHS, follow
from sidestep.errors import InputError
from sidestep.inference.batching import MEMORY, BatchPlan, plan_batches
from sidestep.inference.checkpoints import Checkpoint
from sidestep.inference.devices import tasks_mesh
from sidestep.inference.fit import fit
from sidestep.inference.objective import Objective, Parameters, Problem
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
"""Goals and discounts of five tasks: neither 4 nor 2 devices get equal numbers of them."""
CASES = {"jacobi": (Jacobi(), MEMORY), "gauss_seidel": (GaussSeidel(), 1.0)}
"""Solvers and memory: one batch, and the largest number of batches."""
STEP = 0.3 * np.sin(np.arange(25.0))
"""A change of the parameters, different in every cell."""
ITERATIONS = 5


# JAX arrays are made in functions: processes must be connected before there are any
def model() -> ObstacleGrid:
    """The model where fits start."""
    return ObstacleGrid(BLANK, -2.0)


def behavior() -> BehaviorModel:
    """The behavior of the agents."""
    return behavior_model(Behavior(BoltzmannAverage(), 10.0))


def at(theta: jax.Array) -> Parameters:
    """Parameters where nothing of behavior is learned."""
    return Parameters(theta, BehaviorParameters())


def demonstrations(repeats: int = 1) -> Demonstrations:
    """Trajectories to the first three goals, and to the other two, which are at the same places."""
    paths = [*PATHS, *((task + 3, start, moves) for task, start, moves in PATHS if task < 2)]
    walks = [Trajectory(*follow(start, moves), task) for task, start, moves in paths * repeats]
    return gather(walks, [reach(BLANK, goal, discount=discount) for goal, discount in GOALS])


def problem(name: str, repeats: int = 1) -> Problem:
    """The problem of a case."""
    solver = CASES[name][0]
    return Problem(model(), behavior(), demonstrations(repeats), Normal(), ALL_TERMS, SolveOptions(solver=solver))


def plan(name: str, mesh: jax.sharding.Mesh | None) -> BatchPlan:
    """The batches of a case."""
    solver, memory = CASES[name]
    return plan_batches(model(), solver, len(GOALS), memory=memory, devices=1 if mesh is None else mesh.size)


def measured(name: str, mesh: jax.sharding.Mesh | None) -> dict[str, np.ndarray]:
    """The objective and its gradient at two points, the second from the warm starts of the first; and a short fit."""
    objective = Objective(problem(name), plan(name, mesh), mesh)
    start = model().parameters
    here, starts = objective.evaluate(at(start), objective.cold_starts())
    there, _ = objective.evaluate(at(start + STEP), starts)
    result = fitted(name, mesh)
    return {
        "batches": np.array(len(objective.batches)),
        "parts": np.array([here[:4], there[:4]]),
        "gradient": np.array([here.gradient.model, there.gradient.model]),
        "learned": np.asarray(result.model.parameters),
        "sweeps": np.asarray(result.sweeps),
        "converged": np.asarray(result.task_converged),
    }


def fitted(name, mesh, **settings):
    """A fit of a few iterations."""
    solver, memory = CASES[name]
    settings |= {
        "options": SolveOptions(solver=solver),
        "memory": memory,
        "mesh": mesh,
        "optimizer": LBFGS(max_iterations=ITERATIONS),
    }
    return fit(model(), demonstrations(), behavior(), **settings)


def resumed(name, mesh, file: Path) -> np.ndarray:
    """The parameters of a fit that is interrupted at iteration 3 and resumed from its checkpoint."""
    checkpoint = Checkpoint(file, min_interval=0, max_fraction=1)
    began = []

    def interrupt(progress):
        if progress.iteration == 3:
            raise KeyboardInterrupt

    try:
        fitted(name, mesh, checkpoint=checkpoint, report=interrupt)
    except KeyboardInterrupt:
        result = fitted(
            name, mesh, checkpoint=checkpoint, resume=True, report=lambda progress: began.append(progress.iteration)
        )
        assert began == [3, 4, 5], began
        return np.asarray(result.model.parameters)
    raise AssertionError("the fit was not interrupted")


def refusal_of_different_data(name, mesh) -> str:
    """The error message if processes have different demonstrations."""
    try:
        Objective(problem(name, 1 + jax.process_index()), plan(name, mesh), mesh)
    except InputError as error:
        return str(error)
    return ""


def main() -> None:
    """Measure, and write the results to the folder `out`, one file per process."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--port", type=int)
    parser.add_argument("--process", type=int, default=0)
    parser.add_argument("--name")
    options = parser.parse_args()
    if options.port:
        jax.distributed.initialize(
            f"127.0.0.1:{options.port}", num_processes=2, process_id=options.process, initialization_timeout=60
        )
    mesh, name = tasks_mesh(), options.name
    results = measured(name, mesh)
    results["resumed"] = resumed(name, mesh, options.out / f"{name}.checkpoint")
    results["devices"] = np.array(mesh.size)
    np.savez(options.out / f"{name}-{options.process}.npz", allow_pickle=False, **results)
    if options.port:
        (options.out / f"refusal-{options.process}.txt").write_text(refusal_of_different_data(name, mesh))


if __name__ == "__main__":
    try:
        main()
    except BaseException:
        # `sys.exit` would wait for the other process, which waits for this one
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
