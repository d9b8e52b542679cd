"""Linear algebra of all methods; A is dense (m, n) or block-diagonal by step (N, r, b)."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from hector_jax.core.arrays import Array, contract


@contextmanager
def numpy_promotion() -> Iterator[None]:
    """Promote dtypes and ranks as NumPy does, whatever the user's own JAX options say."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def matvec(A: Array, x: Array) -> Array:
    """Return A x."""
    if A.ndim == 2:
        return A @ x
    return contract("krb,kb->kr", A, x.reshape(A.shape[0], A.shape[2])).ravel()


def rmatvec(A: Array, y: Array) -> Array:
    """Return A'y."""
    if A.ndim == 2:
        return y @ A
    return contract("krb,kr->kb", A, y.reshape(A.shape[:2])).ravel()


def block_diagonal(blocks: Float[Array, "N r b"]) -> Float[Array, "m n"]:
    """Return the matrix (N r, N b) with these blocks on its diagonal."""
    N, r, b = blocks.shape
    inside = jnp.asarray(np.kron(np.eye(N), np.ones((r, b))), blocks.dtype)
    return inside * jnp.tile(blocks.reshape(N * r, b), (1, N))


def plus_gram(P: Array, A: Array, w: Array, shift: Array | float = 0.0) -> Array:
    """Return P + A' diag(w) A + shift I."""
    P = P + shift * jnp.eye(len(P), dtype=P.dtype)
    if A.ndim == 2:
        return P + (w[:, None] * A).T @ A
    weighted = w.reshape(*A.shape[:2], 1) * A
    return P + block_diagonal(contract("krb,krc->kbc", weighted, A))


def cholesky(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a symmetric matrix; NaN if not positive definite."""
    # LAPACK reads columns: the transpose of rows, which needs no copy
    return lax.linalg.cholesky(jnp.asarray(matrix).T, symmetrize_input=False)


def largest(v: Array) -> Array:
    """Return the largest magnitude; zero for an empty array."""
    return jnp.max(jnp.abs(v), initial=0.0)


def multiplier(z: Array) -> Array:
    """Return the multipliers y (m,) of the rows from those of the sides (2, m)."""
    return z[0] - z[1]
