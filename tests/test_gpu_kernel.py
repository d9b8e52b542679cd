"""The kernel that solves a QP on a GPU, interpreted here."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import exact_solution, walking_qp

from hector_jax.qp import gpu_kernel


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_guess_is_the_active_set_of_the_solution(dtype):
    qps = [walking_qp(seed) for seed in range(12)]
    cases, truth = [], []
    for qp in qps:
        column = 1.0 / np.sqrt(np.diag(qp.P))
        A = qp.A * column.reshape(len(qp.A), 1, -1)
        row = 1.0 / np.linalg.norm(A, axis=2)
        size = np.abs(column * qp.q).max()
        normal = [column[:, None] * qp.P * column, column * qp.q / size, row[..., None] * A]
        normal += [row.ravel() * bound / size for bound in (qp.l, qp.u)]
        cases.append([np.asarray(part, dtype) for part in normal])
        y = exact_solution(qp)[1]
        truth.append(np.where(np.abs(y) > 1e-9 * np.abs(y).max(initial=1.0), np.sign(y), 0))
    run = jax.jit(jax.vmap(lambda *qp: gpu_kernel.guess(*qp, curvature=1e-8, interpret=True)))
    found = run(*(jnp.stack(parts) for parts in zip(*cases, strict=True)))
    assert found.settled.all()
    right = (np.asarray(found.side) == np.array(truth)).all(axis=1)
    assert right.all() if dtype is np.float64 else right.mean() > 0.7
    assert found.x.dtype == dtype
    assert (found.definite == (dtype is np.float64)).all()


@pytest.mark.parametrize(("least", "definite"), [(2e-8, 1), (0.5e-8, 0), (0.0, 0), (-1.0, 0)])
def test_the_kernel_knows_a_definite_matrix(least, definite):
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(5, 5)))[0]
    P = basis @ np.diag([1.0, 1.0, 1.0, 1.0, least]) @ basis.T
    free = np.full(2, np.inf)
    qp = map(jnp.asarray, (P, np.ones(5), np.ones((1, 2, 5)), -free, free))
    assert gpu_kernel.guess(*qp, curvature=1e-8, interpret=True).definite == definite


def test_only_small_problems_fit_and_the_package_loads_without_triton():
    assert gpu_kernel.fits(50, 110)
    assert gpu_kernel.fits(gpu_kernel.VARIABLES, gpu_kernel.ROWS)
    assert not gpu_kernel.fits(100, 110)
    assert not gpu_kernel.fits(50, 220)
    absent = "import sys; sys.modules['jaxlib.mlir._mlir_libs._triton_ext'] = None"
    subprocess.run([sys.executable, "-c", f"{absent}; import hector_jax.tuning.batch"], check=True)
