"""The type of arrays: those of JAX, and NumPy's as well."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jax
    import numpy as np

    Array = jax.Array | np.ndarray
else:
    from jaxtyping import Array

__all__ = ["Array"]
