"""Independent answers for the tests: QPs of known kind, an exact solver, and its differences."""

import daqp
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.linalg
from scipy.optimize import linprog

from hector_jax import QP, State


def dense_rows(A: np.ndarray) -> np.ndarray:
    """Block-diagonal rows (N, r, b) as a plain matrix."""
    return A if A.ndim == 2 else scipy.linalg.block_diag(*A)


def mass_matrix(model, data):
    """MuJoCo's, of all degrees of freedom."""
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M


def pack_state(state: State, gravity):
    """The paper's x = [e; p; omega; v; g] (Eq. 3)."""
    return jnp.concatenate([*state, gravity])


def walking_qp(seed: int, horizon: int = 10) -> QP:
    """Condensed MPC of a single rigid body that changes feet every five steps; block rows.

    Weights log-uniform within x/10 of usual ones, yaw to 1 rad; every fourth state is pushed hard.
    """
    rng = np.random.default_rng(seed)
    dt, mass, inertia = 0.03, 12.0, np.diag([0.54, 0.52, 0.069])
    usual = np.array([100, 100, 250, 200, 200, 300] + [1] * 6)
    Q = usual * 10 ** rng.uniform(-1, 1, 12)
    R = np.array([1e-4, 1e-4, 5e-4, 1e-2, 1e-2]) * 10 ** rng.uniform(-1, 1, 5)
    yaw = rng.uniform(-1, 1)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    spread = np.array([0.1, 0.1, 0.1, 0.03, 0.03, 0.03, 0.5, 0.5, 0.5, 0.3, 0.3, 0.2])
    state = rng.normal(size=12) * spread * (2.5 if seed % 4 == 0 else 1.0)

    A = np.eye(12)
    A[:3, 6:9], A[3:6, 9:] = dt * turn.T, dt * np.eye(3)
    gravity = np.r_[np.zeros(11), -9.81 * dt]
    inverse = np.linalg.inv(turn @ inertia @ turn.T)
    P, q = np.kron(np.eye(horizon), np.diag(R)), np.zeros(5 * horizon)
    response = np.zeros((12, 5 * horizon))
    for k in range(horizon):
        side = 1.0 if ((k + seed) // 5) % 2 else -1.0
        x, y, z = turn @ np.array([0.05 * rng.normal(), 0.07 * side, -0.5])
        B = np.zeros((12, 5))
        B[6:9, :3] = dt * inverse @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        B[6:9, 3:] = dt * inverse @ turn[:, 1:]
        B[9:, :3] = dt / mass * np.eye(3)
        response = A @ response
        response[:, 5 * k : 5 * k + 5] += B
        state = A @ state + gravity
        P += response.T @ (Q[:, None] * response)
        q += response.T @ (Q * state)

    rows = np.zeros((7, 5))
    rows[:4, :2] = np.repeat(np.eye(2), 2, axis=0)
    rows[:4, 2] = [-0.5, 0.5, -0.5, 0.5]
    rows[4, 2] = rows[5, 3] = rows[6, 3] = 1.0
    rows[5, 2], rows[6, 2] = 0.09, -0.06
    lower = np.array([-np.inf, 0, -np.inf, 0, 0, 0, -np.inf])
    upper = np.array([0, np.inf, 0, np.inf, 500, np.inf, 0])
    return QP(
        P, q, np.tile(rows, (horizon, 1, 1)), np.tile(lower, horizon), np.tile(upper, horizon)
    )


def general_qp(seed: int, n: int, m: int) -> tuple[QP, np.ndarray, float]:
    """A QP built around its solution, the solution, and cond(P) (infinite for a singular P).

    Dense or sparse rows of any size, some equalities, one-sided or free, two redundant; more or
    fewer active rows than variables, every tenth of them without force; P well or badly
    conditioned, badly scaled, of half rank or zero.
    """
    rng = np.random.default_rng([seed, n, m])
    kind = ("plain", "plain", "scaled", "half rank", "zero")[rng.integers(5)]
    cond = 10 ** rng.uniform(0, 8)
    values = np.logspace(0, -np.log10(cond), n) if n > 1 else np.ones(1)
    values[n // 2 :] *= kind != "half rank"
    values *= kind != "zero"
    basis = np.eye(n)
    for mirror in rng.normal(size=(4, n)):  # a QR is slow where other processes hold the cores
        basis -= np.outer(2.0 * (basis @ mirror) / (mirror @ mirror), mirror)
    P = 10 ** rng.uniform(-3, 3) * (basis * values) @ basis.T
    scale = 10 ** rng.uniform(-1, 1, n) if kind == "scaled" else np.ones(n)
    P = 0.5 * (P + P.T) * np.outer(scale, scale)
    A = rng.normal(size=(m, n)) * (rng.uniform(size=(m, n)) < rng.choice([0.5, 1.0]))
    A[m // 2], A[m // 2 + 1] = A[0], -2.0 * A[1]
    A *= 10 ** rng.uniform(-2, 2, (m, 1)) ** rng.integers(2)

    x = rng.normal(size=n) * 10 ** rng.uniform(-2, 2)
    at = A @ x
    room = np.abs(A).sum(1) + 1e-3
    lower, upper = at - rng.exponential(size=m) * room, at + rng.exponential(size=m) * room
    y = np.zeros(m)
    for i in rng.permutation(m)[: rng.integers(min(m, n + n // 2) + 1)]:
        force = rng.exponential() * (rng.uniform() > 0.1)
        if rng.integers(2):
            upper[i], y[i] = at[i], force
        else:
            lower[i], y[i] = at[i], -force
    role = rng.integers(8, size=m)
    y = np.where(role == 0, rng.normal(size=m), y)
    lower, upper = np.where(role == 0, at, lower), np.where(role == 0, at, upper)
    lower = np.where(((role == 1) | (role == 5)) & (y >= 0) & (role != 0), -np.inf, lower)
    upper = np.where(((role == 2) | (role == 5)) & (y <= 0) & (role != 0), np.inf, upper)
    unique = kind in ("plain", "scaled")
    return QP(P, -(P @ x + A.T @ y), A, lower, upper), x, cond if unique else np.inf


def kkt_residual(qp: QP, x: np.ndarray, y: np.ndarray) -> float:
    """Largest of violation, stationarity and complementarity, each relative to its terms or 1."""
    P, q, lower, upper = qp.P, qp.q, qp.l, qp.u
    A = dense_rows(qp.A)
    at, pull, price = A @ x, A.T @ y, P @ x
    finite = np.r_[at, lower[np.isfinite(lower)], upper[np.isfinite(upper)]]
    violation = np.maximum(lower - at, at - upper).max(initial=0.0)
    slope = np.abs(price + q + pull).max()
    slack = np.where(y > 0, upper - at, at - lower)
    work = np.abs(np.where(y == 0, 0.0, y) * np.where(y == 0, 0.0, slack)).max(initial=0.0)
    return max(
        violation / (1.0 + np.abs(finite).max(initial=0.0)),
        slope / (1.0 + max(np.abs(v).max() for v in (price, pull, q))),
        work / (1.0 + abs(x @ price) + abs(q @ x)),
    )


def exact_solution(qp: QP) -> tuple[np.ndarray, np.ndarray]:
    """Minimiser and multipliers of a QP with P > 0: DAQP's active set, refined past 64 bits."""
    P, A = 0.5 * (qp.P + qp.P.T), dense_rows(qp.A)
    column = 1.0 / np.sqrt(np.diag(P))
    length = np.linalg.norm(A * column, axis=1)
    row = 1.0 / np.where(length > 0, length, 1.0)
    size = np.abs(column * qp.q).max()
    P, A, q = P * np.outer(column, column), row[:, None] * A * column, column * qp.q / size
    lower, upper = row * qp.l / size, row * qp.u / size
    bounds = [np.clip(v, -1e30, 1e30) for v in (upper, lower)]
    _, _, flag, info = daqp.solve(P.copy(), q, A.copy(), *bounds, primal_tol=1e-11)
    assert flag == 1
    force = info["lam"]
    active = np.abs(force) > 1e-14
    held = A[active]
    matrix = np.block([[P, held.T], [held, np.zeros((len(held), len(held)))]])
    wanted = np.r_[-q, np.where(force > 0, upper, lower)[active]]
    lu = scipy.linalg.lu_factor(matrix)
    answer = np.zeros(len(wanted), np.longdouble)
    for _ in range(5):
        rest = wanted - matrix.astype(np.longdouble) @ answer
        answer += scipy.linalg.lu_solve(lu, rest.astype(float))
    y = np.zeros(len(row))
    y[active] = answer[len(q) :]
    return size * column * answer[: len(q)].astype(float), size * row * y


def other_minimiser(qp: QP, x: np.ndarray) -> float:
    """How far minimisers beside x reach, in a box of half-width 1: 0 where x is the only one.

    Directions d with P d = 0 and q'd = 0 that cross no active row, by linear programs in normalised
    units.
    """
    diagonal, widest = np.diag(qp.P), np.abs(qp.A).max(axis=0)
    priced = diagonal > 1e-12 * diagonal.max()
    column = np.where(widest > 0, 1.0 / np.where(widest > 0, widest, 1.0), 1.0)
    column[priced] = diagonal[priced] ** -0.5
    length = np.linalg.norm(qp.A * column, axis=1)
    A = qp.A * column / np.where(length > 0, length, 1.0)[:, None]
    q = column * qp.q
    near = 1e-9 * (np.abs(A) @ np.abs(x / column) + 1e-3)
    room = [(qp.u - qp.A @ x) / np.where(length > 0, length, 1.0)]
    room += [(qp.A @ x - qp.l) / np.where(length > 0, length, 1.0)]
    up, down = (slack <= near for slack in room)
    still = np.concatenate([qp.P * np.outer(column, column), q[None] / (np.abs(q).max() or 1.0)])
    rows = np.concatenate([A[up], -A[down], still, -still])
    reach = 0.0
    for towards in np.random.default_rng(0).normal(size=(3, len(x))):
        for sign in (1.0, -1.0):
            found = linprog(sign * towards, rows, np.zeros(len(rows)), bounds=(-1, 1))
            reach = max(reach, np.abs(found.x).max())
    return reach


def condensed_walk(seed: int, horizon: int = 12) -> QP:
    """Condensed MPC of a linear inverted pendulum, its ZMP between two bounds from now on.

    Inputs are jerks, as in Kajita et al. 2003, the first half of them bounded. The ZMP now is on a
    bound and no input moves it: the first two rows are zeros, one bound of them but for rounding.
    """
    rng = np.random.default_rng(seed)
    dt, height = 0.1, 0.8
    A = np.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    B = np.array([dt**3 / 6, dt**2 / 2, dt])
    zmp = np.array([1.0, 0.0, -height / 9.81])
    before, jerk, half = rng.normal(size=3) * [0.05, 0.2, 0.2], rng.normal(), 0.1
    state, now = A @ before + B * jerk, (zmp @ A) @ before + (zmp @ B) * jerk
    centre = now + half * rng.choice([-1.0, 1.0])  # of the foot that stands now
    centres = centre + 0.15 * (np.arange(horizon) // 8)
    rows, free, power = [np.zeros(horizon)], [zmp @ state], np.eye(3)
    response = np.zeros((3, horizon))
    for k in range(horizon - 1):
        response = A @ response
        response[:, k] += B
        power = A @ power
        rows.append(zmp @ response)
        free.append(zmp @ power @ state)
    C, free = np.array(rows), np.array(free)
    last = A @ response + np.outer(B, np.arange(horizon) == horizon - 1)
    error = A @ power @ state - [centres[-1], 0.0, 0.0]
    P = last.T @ last + C.T @ C + 1e-3 * np.eye(horizon)
    q = last.T @ error + C.T @ (free - centres)
    jerks = np.eye(horizon)[: horizon // 2]
    G = np.concatenate([np.stack([C, -C], axis=1).reshape(-1, horizon), jerks])
    upper = np.stack([centres + half - free, free - centres + half], axis=1).ravel()
    most = np.full(horizon // 2, 20.0)
    return QP(P, q, G, np.r_[np.full(2 * horizon, -np.inf), -most], np.r_[upper, most])


def moved(qp: QP, tangent: QP, step: float) -> QP:
    """The QP some way along a tangent."""
    return QP(*(v + step * d for v, d in zip(qp, tangent, strict=True)))


def central_difference(qp: QP, tangent: QP, step: float) -> np.ndarray:
    """Change of the exact minimiser along a tangent."""
    ahead, behind = (exact_solution(moved(qp, tangent, s))[0] for s in (step, -step))
    return (ahead - behind) / (2.0 * step)
