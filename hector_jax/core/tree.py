"""Trees of arrays as a whole."""

from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array

Tree = TypeVar("Tree")
Layout = tuple[Any, tuple[jax.ShapeDtypeStruct, ...]]  # structure and leaves of a tree; hashable


def stack(trees: Sequence[Tree]) -> Tree:
    """Trees of one structure, their leaves stacked along a new first axis (numpy)."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *trees)


def where(condition: Bool[Array, ""], yes: Tree, no: Tree) -> Tree:
    """One tree or the other, of one structure, shapes and dtypes."""
    return jax.tree.map(lambda y, n: jnp.where(condition, y, n), yes, no)


def layout(tree: Any) -> Layout:
    """What `unpack` has to know of a tree."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple(jax.ShapeDtypeStruct(np.shape(x), jnp.result_type(x)) for x in leaves)


def pack(tree: Any) -> Float[Array, " n"]:
    """All numbers of a tree in one array; whole numbers and truth values become floats."""
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)])


def unpack(layout: Layout, packed: Float[Array, " n"]) -> Any:
    """The tree of this layout whose numbers were packed."""
    structure, leaves = layout
    parts = jnp.split(packed, np.cumsum([leaf.size for leaf in leaves])[:-1])
    pairs = zip(parts, leaves, strict=True)
    return structure.unflatten([x.reshape(leaf.shape).astype(leaf.dtype) for x, leaf in pairs])
