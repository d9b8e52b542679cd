"""Operations on whole trees of arrays: stack, select, pack."""

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
    """Stack the leaves of trees of one structure along a new first axis (numpy)."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *trees)


def where(condition: Bool[Array, ""], yes: Tree, no: Tree) -> Tree:
    """Select one of two trees of the same structure, shapes and dtypes."""
    return jax.tree.map(lambda y, n: jnp.where(condition, y, n), yes, no)


def layout(tree: Any) -> Layout:
    """Return the structure, shapes and dtypes of a tree, for `unpack`."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple(jax.ShapeDtypeStruct(np.shape(x), jnp.result_type(x)) for x in leaves)


def pack(tree: Any) -> Float[Array, " n"]:
    """Concatenate the leaves of a tree in one array; integers and booleans become floats."""
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)])


def unpack(layout: Layout, packed: Float[Array | np.ndarray, "*batch n"]) -> Any:
    """Rebuild the tree of this layout from packed numbers; leaves are NumPy's if they are."""
    structure, leaves = layout
    split = np.split if isinstance(packed, np.ndarray) else jnp.split
    parts = split(packed, np.cumsum([leaf.size for leaf in leaves])[:-1], axis=-1)
    return structure.unflatten(
        [
            x.reshape((*packed.shape[:-1], *leaf.shape)).astype(leaf.dtype)
            for x, leaf in zip(parts, leaves, strict=True)
        ]
    )
