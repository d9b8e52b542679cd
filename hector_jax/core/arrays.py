"""The type of arrays: JAX's, beside which NumPy's are welcome."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jax
    import numpy as np

    Array = jax.Array | np.ndarray
else:
    from jaxtyping import Array

__all__ = ["Array"]
