"""The kernel that solves a QP on a GPU, interpreted here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import dense_rows, exact_solution, walking_qp

from hector_jax.qp import gpu_kernel


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_guess_is_the_active_set_of_the_solution(dtype):
    qps = [walking_qp(seed) for seed in range(12)]
    cases, truth = [], []
    for qp in qps:
        column = 1.0 / np.sqrt(np.diag(qp.P))
        A = dense_rows(qp.A) * column
        row = 1.0 / np.linalg.norm(A, axis=1)
        size = np.abs(column * qp.q).max()
        normal = (
            column[:, None] * qp.P * column,
            column * qp.q / size,
            row[:, None] * A,
            row * qp.l / size,
            row * qp.u / size,
        )
        cases.append([np.asarray(part, dtype) for part in normal])
        y = exact_solution(qp)[1]
        truth.append(np.where(np.abs(y) > 1e-9 * np.abs(y).max(initial=1.0), np.sign(y), 0))
    run = jax.jit(jax.vmap(lambda *qp: gpu_kernel.guess(*qp, interpret=True)))
    found = run(*(jnp.stack(parts) for parts in zip(*cases, strict=True)))
    assert found.settled.all()
    right = (np.asarray(found.side) == np.array(truth)).all(axis=1)
    assert right.all() if dtype is np.float64 else right.mean() > 0.7
    assert found.x.dtype == dtype


def test_only_small_problems_fit():
    assert gpu_kernel.fits(50, 110)
    assert gpu_kernel.fits(gpu_kernel.VARIABLES, gpu_kernel.ROWS)
    assert not gpu_kernel.fits(100, 110)
    assert not gpu_kernel.fits(50, 220)
