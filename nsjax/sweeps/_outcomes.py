"""Which of the values that a function returns says how a lane ended."""

from typing import Any, NamedTuple

import jax
import numpy as np

from ..flow._results import is_okay, RESULTS


Item = type(RESULTS.successful)


class Outcome(NamedTuple):
    """Where among the leaves it is, and of which enumeration."""

    leaf: int
    kind: Any

    def names(self, codes: np.ndarray) -> dict[str, int]:
        """How many lanes there are of each result."""
        of_code = {int(item._value): name for name, item in self.kind._name_to_item.items()}
        values, numbers = np.unique(codes, return_counts=True)
        return {of_code[int(value)]: int(number) for value, number in zip(values, numbers)}

    def failed(self, codes: np.ndarray) -> np.ndarray:
        every = self.kind._name_to_item.values()
        good = [x for x in every if is_okay(x)] if self.kind is RESULTS else [self.kind.successful]
        return ~np.isin(codes, [int(item._value) for item in good])


def outcome_of(tree: Any) -> Outcome:
    """Of the structure of what a function returns: its `result`, as a `Solution` has one, or else the only one of
    `RESULTS` that there is in it."""
    numbered = jax.tree.unflatten(tree, range(tree.num_leaves))
    own = getattr(numbered, "result", None)
    items = jax.tree.leaves(numbered, is_leaf=lambda x: isinstance(x, Item))
    found = [own] if isinstance(own, Item) else [x for x in items if isinstance(x, Item)]
    if len(found) != 1:
        raise ValueError(
            "How a lane ended is known if the function returns a `Solution`, or one of `RESULTS` beside other things, "
            f"such as `return sol.y1, sol.result`; but this one returns {len(found) or 'none'} of them."
        )
    return Outcome(int(found[0]._value), found[0]._enumeration)
