"""Trees of arrays as types: static checkers know nothing of jaxtyping's `PyTree`, and read these as `Any`."""

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    FloatTree: TypeAlias = Any
    ArrayTree: TypeAlias = Any
    Tree: TypeAlias = Any
else:
    from jaxtyping import Array, Float, PyTree, Shaped

    FloatTree = PyTree[Float[Array, "..."]]
    ArrayTree = PyTree[Shaped[Array, "..."]]
    Tree = PyTree
