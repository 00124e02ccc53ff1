"""Which solver a problem gets if nobody chooses one."""

import jax

from sidestep.tabular.backups import Backup
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.ordered import KERNELS, Ordered
from sidestep.tabular.solvers.process import Solver

_SMALL = 400
"""The number of states below which the sweeps in JAX are at least as fast on a CPU (`benchmarks/scaling.py`)."""


def solver_for(backup: Backup, states: int) -> Solver:
    """`Ordered` for larger problems on a CPU and backups that have machine code, and `Jacobi` otherwise."""
    if jax.default_backend() == "cpu" and states >= _SMALL and type(backup) in KERNELS:
        return Ordered()
    return Jacobi()
