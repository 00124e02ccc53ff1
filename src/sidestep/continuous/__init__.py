"""Continuous worlds: behavior-aware modeling with vectors for states, and values by rollouts.

This is the paper's section "Continuous State Spaces". `value_gradient` has eq. 11, `plan_policy` follows eq. 12, and
`fit_dynamics` uses both. `__init__.pyi` lists the public names; each is imported at its first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
