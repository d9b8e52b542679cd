"""The type of arrays, those of JAX and NumPy's as well, and products of small ones."""

import math
from typing import TYPE_CHECKING

import jax.numpy as jnp
from jax.typing import ArrayLike

if TYPE_CHECKING:
    import jax
    import numpy as np

    Array = jax.Array | np.ndarray
else:
    from jaxtyping import Array

__all__ = ["Array", "contract"]


def contract(subscripts: str, *operands: ArrayLike) -> Array:
    """Return `jnp.einsum(subscripts, *operands)`, computed as a sum of products.

    For small operands: XLA fuses a sum of products with the operations around it, but starts a
    kernel for each matrix product, which takes a GPU longer than the product itself. An operand has
    each letter at most once; sizes are not checked.

    >>> contract("ij,j->i", jnp.eye(2), jnp.array([3.0, 4.0])).tolist()
    [3.0, 4.0]
    """
    inputs, output = subscripts.split("->")
    letters = output + "".join(sorted(set(inputs) - set(output) - {","}))
    factors = []
    for axes, operand in zip(inputs.split(","), operands, strict=True):
        operand = jnp.transpose(operand, [axes.index(x) for x in letters if x in axes])
        missing = [i for i, x in enumerate(letters) if x not in axes]
        factors.append(jnp.expand_dims(operand, missing))
    return jnp.sum(math.prod(factors), axis=tuple(range(len(output), len(letters))))
