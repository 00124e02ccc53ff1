"""Behavior-aware modeling: learn transition dynamics, and so hidden obstacles, from the actions of people.

`__init__.pyi` lists the public names in groups. Each name is imported at its first use, so `import sidestep` costs
no time.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
