"""Which solver a problem gets if nobody chooses one."""

import jax

from sidestep.tabular.backups import Backup
from sidestep.tabular.solvers.base import Solver
from sidestep.tabular.solvers.gauss_seidel import KERNELS, GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi

_SMALL = 400
"""The number of states below which the sweeps in JAX are at least as fast on a CPU (`benchmarks/scaling.py`)."""


def default_solver(backup: Backup, states: int) -> Solver:
    """`GaussSeidel` for larger problems on a CPU and backups that have machine code, and `Jacobi` otherwise."""
    if jax.default_backend() == "cpu" and states >= _SMALL and type(backup) in KERNELS:
        return GaussSeidel()
    return Jacobi()
