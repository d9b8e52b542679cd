"""Answers past 64 bits: DAQP finds the active set, its equations are solved in extended precision.

The derivative is a central difference of those answers along each parameter. P and q move along
their tangents in extended precision too, so that the step can be small and still say nine digits.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from benchmarks.problems import INPUTS, Ready
from hector_jax.qp import QP

STEP = 1e-5  # of log-weights, rad, m, rad/s and m/s


class Answer(NamedTuple):
    """First input of a problem and its derivative."""

    first: np.ndarray  # (5,)
    slope: np.ndarray  # (5, 36)
    regular: bool  # no row comes or goes within a step


def _solve(P: np.ndarray, q: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray):
    """Minimiser in extended precision, and the sides that are active."""
    import daqp

    bounds = [np.clip(bound, -1e30, 1e30) for bound in (upper, lower)]
    _, _, flag, info = daqp.solve(P.astype(float), q.astype(float), A, *bounds, primal_tol=1e-11)
    if flag != 1:
        raise RuntimeError(f"DAQP ended with exit flag {flag} on a walking QP")
    sides = np.sign(info["lam"])
    held = np.flatnonzero(sides)
    n, rows = len(q), A[held]
    matrix = np.zeros((n + len(held), n + len(held)), P.dtype)
    matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = P, rows.T, rows
    wanted = np.concatenate([-q, np.where(sides > 0, upper, lower)[held]])
    factor = scipy.linalg.lu_factor(matrix.astype(float))
    answer = np.zeros_like(wanted)
    for _ in range(4):
        answer += scipy.linalg.lu_solve(factor, (wanted - matrix @ answer).astype(float))
    return answer[:n], sides


def answer(ready: Ready) -> Answer:
    """First input of a ready QP with its central differences along all parameters."""
    qp = ready.qp
    column = 1.0 / np.sqrt(np.diag(qp.P))
    row = 1.0 / np.linalg.norm(qp.A * column, axis=1)
    size = np.abs(column * qp.q).max()
    scaled = QP(
        (column[:, None] * qp.P * column).astype(np.longdouble),
        (column * qp.q / size).astype(np.longdouble),
        row[:, None] * qp.A * column,
        row * qp.l / size,
        row * qp.u / size,
    )
    back = size * column[:INPUTS]
    middle, sides = _solve(*scaled)
    slope, regular = [], True
    for dP, dq in zip(ready.P_slopes, ready.q_slopes, strict=True):
        step_P, step_q = column[:, None] * dP * column, column * dq / size
        ends = []
        for step in (STEP, -STEP):
            moved = scaled._replace(P=scaled.P + step * step_P, q=scaled.q + step * step_q)
            x, moved_sides = _solve(*moved)
            ends.append(x[:INPUTS])
            regular &= np.array_equal(sides, moved_sides)
        slope.append(back * ((ends[0] - ends[1]) / (2.0 * STEP)).astype(float))
    return Answer(back * middle[:INPUTS].astype(float), np.array(slope).T, regular)
