"""Trees of arrays as a whole."""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from hector_jax.core.arrays import Array

Tree = TypeVar("Tree")


def stack(trees: Sequence[Tree]) -> Tree:
    """Trees of one structure, their leaves stacked along a new first axis (numpy)."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *trees)


def where(condition: Bool[Array, ""], yes: Tree, no: Tree) -> Tree:
    """One tree or the other, of one structure, shapes and dtypes."""
    return jax.tree.map(lambda y, n: jnp.where(condition, y, n), yes, no)
