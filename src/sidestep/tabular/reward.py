"""The reward of reaching a goal, as two numbers; it imports nothing, so that configurations cost no time to load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidestep.errors import to_number

if TYPE_CHECKING:
    import sidestep.tabular.graph
    import sidestep.tabular.grid
    import sidestep.tabular.tasks


@dataclass(frozen=True)
class Reward:
    """The reward that agents pursue on their way to a goal.

    Attributes:
        discount: γ in (0, 1]; below 1 without a step cost.
        step_cost: The cost of a cell side, above 0. Without it the goal pays 1 (the paper's form).

    Raises:
        InputError: For numbers out of these ranges.

    Example:
        >>> from sidestep import Grid
        >>> float(Reward(discount=1.0, step_cost=2.0).reach(Grid.unknown(1, 3), 2).reward[0, 0])
        -2.0
    """

    discount: float = 0.95
    step_cost: float | None = None

    def __post_init__(self) -> None:
        to_number(self.discount, "discount", above=0, most=1)
        if self.step_cost is not None:
            to_number(self.step_cost, "step_cost", above=0)

    def reach(
        self, world: sidestep.tabular.grid.Grid | sidestep.tabular.graph.Graph, goal: int | tuple[float, float]
    ) -> sidestep.tabular.tasks.Task:
        """Return the task of reaching a goal with this reward.

        Args:
            world: A grid, or the graph of any discrete world.
            goal: A state; on a grid also a position (x, y) in metres.

        Raises:
            InputError: As `reach` does.
        """
        from sidestep.tabular.tasks import reach

        return reach(world, goal, discount=self.discount, step_cost=self.step_cost)
