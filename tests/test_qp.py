"""The QP door against independent answers: solutions, statuses, derivatives; the GPU kernel."""

import subprocess
import sys
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import exact_solution, walking_qp

from benchmarks.problems import draw_problems, layer_qp
from hector_jax import WalkConfig, load_robot
from hector_jax.core.settings import from_table, to_table
from hector_jax.core.tree import stack
from hector_jax.qp import JAXOPT, QP, QpConfig, Solver, Status, check_solved, gpu_kernel, solve_qp
from hector_jax.qp.active_set import first_guess
from hector_jax.qp.interior_point import approach

WALKING = 500
SHAPES = [(1, 4), (2, 6), (5, 12), (12, 30), (30, 40), (50, 70), (120, 100)]
EACH = 143  # of a shape: 1001 general QPs


@jax.jit
def _solve_batch(qps):
    return jax.lax.map(solve_qp, qps)


def solve_all(qps):
    """Solve problems of one shape, EACH of them at a time: one program for each shape."""
    batches = np.arange(len(qps) + -len(qps) % EACH).reshape(-1, EACH) % len(qps)
    found = [jax.device_get(_solve_batch(stack([qps[i] for i in batch]))) for batch in batches]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(qps)], *found)


solve = jax.jit(solve_qp, static_argnums=1)


@partial(jax.jit, static_argnums=2)
def along(qp, tangent, config=QpConfig()):  # noqa: B008
    """Solution's x moved along a tangent of the data, and its solution."""
    solution, moved = jax.jvp(partial(solve_qp, config=config), (qp,), (tangent,))
    return solution, moved.x


def only(qp, **moved):
    """A tangent along which these parts alone move."""
    return jax.tree.map(np.zeros_like, qp)._replace(**moved)


def still(qp):
    """Solution of a walking QP, from the program that also differentiates it."""
    return along(qp, only(qp))[0]


@cache
def general(n, m):
    """EACH general QPs with their minimisers and conditions, and what is found of them."""
    made = [oracles.general_qp(seed, n, m) for seed in range(EACH)]
    return made, solve_all([qp for qp, _, _ in made])


@pytest.fixture(scope="module")
def walking():
    return [walking_qp(seed) for seed in range(WALKING)]


@pytest.fixture(scope="module")
def walked(walking):
    return stack([still(qp) for qp in walking])


def test_walking_qps_are_solved_to_the_first_newton(walking, walked):
    check_solved(walked)
    exact = np.stack([exact_solution(qp)[0] for qp in walking])
    error = np.abs(walked.x - exact)[:, :5].max(axis=1)
    assert np.median(error) <= 1e-8
    assert error.max() <= 1e-4
    assert walked.iterations.max() <= 20


def test_no_qp_of_the_benchmark_is_wrong_in_silence_in_32_bits():
    config, robot = WalkConfig(), load_robot()
    write = partial(jax.lax.map, partial(layer_qp, config, robot))
    qps = jax.device_get(jax.jit(write)(draw_problems(config, robot, WALKING)))
    single = jax.tree.map(np.float32, qps)
    found = jax.device_get(jax.jit(partial(jax.lax.map, solve_qp))(single))
    assert found.x.dtype == np.float32
    exact = [exact_solution(QP(*parts))[0][:5] for parts in zip(*qps, strict=True)]
    error = np.abs(found.x[:, :5] - exact).max(axis=1)
    solved = found.status == Status.SOLVED
    assert error[solved].max() <= 0.1
    assert solved.mean() >= 0.995


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_general_qps_are_right(n, m):
    made, found = general(n, m)
    definite = np.isfinite([cond for *_, cond in made])
    assert (found.status[definite] == Status.SOLVED).all()
    assert np.isin(found.status, (Status.SOLVED, Status.NOT_UNIQUE)).all()
    for i, (qp, x, cond) in enumerate(made):
        residual = oracles.kkt_residual(qp, found.x[i], found.y[i])
        assert residual <= (1e-8 if cond <= 1e4 else 1e-6), (i, residual, cond)
        if cond <= 1e4:
            np.testing.assert_allclose(found.x[i], x, atol=1e-4 * np.abs(x).max())


@pytest.mark.parametrize(("n", "m"), SHAPES[1:3])
def test_a_minimiser_is_not_unique_just_where_a_linear_program_finds_another(n, m):
    made, found = general(n, m)
    flat = [i for i, (_, _, cond) in enumerate(made) if np.isinf(cond)]
    unique = np.array([oracles.other_minimiser(made[i][0], found.x[i]) < 1e-3 for i in flat])
    np.testing.assert_array_equal(found.status[flat] == Status.SOLVED, unique)
    assert 10 < unique.sum() < len(flat) - 10


@pytest.mark.parametrize("far", [1e3, 1e12, 1e200])
def test_a_loose_bound_of_any_size_changes_nothing(far):
    made = []
    for seed in range(6):  # of SHAPES[2]
        rng = np.random.default_rng(seed)
        M, A = rng.normal(size=(5, 5)), rng.normal(size=(12, 5))
        bound = np.r_[np.ones(11), far]
        P, q = M @ M.T + 0.1 * np.eye(5), 10.0 * rng.normal(size=5)
        made.append(QP(P, q, A, -bound, bound))
    found = solve_all(made)
    assert (found.status == Status.SOLVED).all()
    for qp, x in zip(made, found.x, strict=True):
        without = QP(qp.P, qp.q, qp.A[:11], qp.l[:11], qp.u[:11])
        np.testing.assert_allclose(x, exact_solution(without)[0], atol=1e-8)


INF = np.inf


def small(P=((2.0, 0.0), (0.0, 2.0)), q=(-2.0, -5.0), A=((1.0, 0.0),), l=(-INF,), u=(INF,)):  # noqa: E741
    """A QP of two variables, with rows that bind nothing up to three: one shape for all."""
    more = 3 - len(l)
    A, l, u = (*A, *[(0.5, 0.5)] * more), (*l, *[-INF] * more), (*u, *[INF] * more)  # noqa: E741
    return QP(*(np.array(part, float) for part in (P, q, A, l, u)))


EYE, ZERO = np.eye(2), (0.0, 0.0)


def rows(*rows, P=EYE, q=(-2.0, -5.0)):
    """A small QP from rows (a, l, u)."""
    A, l, u = zip(*rows, strict=True) if rows else ((), (), ())  # noqa: E741
    return small(P, q, A, l, u)


def correlated(off, q):
    return rows(P=((1.0, off), (off, 1.0)), q=q)


def crossed(slope):
    """A fall along a flat direction that a row of this slope ends, far away."""
    return rows(((1.0, 1.0 - slope), -INF, 1.0), P=np.ones((2, 2)), q=(-1.0, 1.0))


FIRST, SECOND, BOTH, HALF = (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 0.5)
FLAT = ((1.0, 0.0), (0.0, 0.0))
EDGES = {
    "a row of zeros past zero": (
        lambda t: rows((ZERO, -INF, -t)),
        dict(SOLVED=(0.0, 1e-17, 4.9e-8), INFEASIBLE=(5.1e-8, 1.0)),
    ),
    "the only row, all else at rest": (
        lambda t: small(q=ZERO, A=(ZERO, ZERO, ZERO), l=(t, -INF, -1.0), u=(INF, -t, 1.0)),
        dict(SOLVED=(0.0, 1e-17), INFEASIBLE=(1e-6, 1.0)),
    ),
    "crossed bounds": (
        lambda t: rows((FIRST, 1.0 + t, 1.0)),
        dict(SOLVED=(1e-16, 1e-9, 9e-8), INFEASIBLE=(1.1e-7, 1e-3)),
    ),
    "crossed bounds, unbounded otherwise": (
        lambda t: rows((FIRST, 1.0 + t, 1.0), P=FLAT, q=(0.0, 1.0)),
        dict(UNBOUNDED=(1e-16,), INFEASIBLE=(1e-3,)),
    ),
    "two rows that contradict each other": (
        lambda t: rows((BOTH, 1.0, 1.0), (BOTH, 1.0 + t, 1.0 + t)),
        dict(SOLVED=(1e-12, 5e-8), INFEASIBLE=(1e-7, 1e-3, 1.0)),
    ),
    "three rows that contradict each other": (
        lambda t: rows((FIRST, -INF, 1.0), (SECOND, -INF, 1.0), (BOTH, 2.0 + t, INF)),
        dict(SOLVED=(1e-12, 3e-8), INFEASIBLE=(5e-8, 1e-3, 1.0)),
    ),
    "a fall along a free variable": (
        lambda t: rows(P=FLAT, q=(1.0, -t)),
        dict(NOT_UNIQUE=(0.0, 1e-12, 2e-9), INACCURATE=(5e-9, 8e-9), UNBOUNDED=(1.1e-8, 1e-3, 1.0)),
    ),
    "a fall along a direction with little curvature": (
        lambda t: correlated(1.0 - t, (1.0, -1.0)),
        dict(UNBOUNDED=(0.0, 1e-12), NOT_UNIQUE=(1e-9,), SOLVED=(3e-8, 1e-6)),
    ),
    "a row that crosses a flat direction": (
        crossed,
        dict(UNBOUNDED=(0.0, -1e-11, -1e-9, -1e-6, -1e-3), SOLVED=(1e-3,)),
    ),
    "curvature": (
        lambda t: correlated(1.0 - t, (1.0, 1.0)),
        dict(NOT_UNIQUE=(0.0, 1e-10, 9.9e-9), SOLVED=(1.01e-8, 1e-6)),
    ),
    "negative curvature": (
        lambda t: correlated(1.0 + t, (1.0, 1.0)),
        dict(NOT_UNIQUE=(0.0, 1e-12, 9.9e-10), BAD_DATA=(1.01e-9, 1e-3)),
    ),
    "force of the row that holds": (
        lambda t: rows((SECOND, 1.0, 2.0), P=FLAT, q=(-1.0, t)),
        dict(NOT_UNIQUE=(0.0, 1e-12, 9.9e-9), SOLVED=(1.1e-8, 1e-3)),
    ),
    "price of two forces that share a load": (
        lambda t: rows((BOTH, 1.0, 1.0), (FIRST, 0.0, 2.0), (SECOND, 0.0, 2.0), P=t * EYE, q=ZERO),
        dict(NOT_UNIQUE=(0.0,), SOLVED=(1e-200, 1e-6)),
    ),
    "size of a number": (
        lambda t: rows(q=(t, 0.0)),
        dict(SOLVED=(1e300, 1e308), BAD_DATA=(INF, np.nan)),
    ),
    "size of a price": (
        lambda t: rows(P=((t, 0.0), (0.0, 1.0))),
        dict(SOLVED=(1e-100, 1e100), BAD_DATA=(INF, np.nan)),
    ),
    "size of an entry": (
        lambda t: rows(((t, 0.0), -INF, 9.0)),
        dict(SOLVED=(1e-100, 1.0), BAD_DATA=(INF, np.nan)),
    ),
    "an upper bound": (
        lambda t: rows((FIRST, -INF, t)),
        dict(SOLVED=(0.0, INF), BAD_DATA=(-1e20, -INF, np.nan)),
    ),
    "a bound that excludes every number": (
        lambda t: rows((FIRST, t, INF)),
        dict(SOLVED=(-INF, 9e19), BAD_DATA=(1e20, INF, np.nan)),
    ),
}


@pytest.mark.parametrize("name", EDGES)
def test_a_verdict_changes_at_its_threshold_and_the_derivative_with_it(name):
    make, sides = EDGES[name]
    for told, values in sides.items():
        status = Status[told]
        for value in values:
            alone = solve(qp := make(value))
            found, moved = along(qp, jax.tree.map(jnp.ones_like, qp))
            assert Status(int(alone.status)) == status, value
            assert found.status == alone.status
            worst = max(alone.primal_residual, alone.dual_residual, alone.gap)
            assert (worst <= 1e-8) == (status in (Status.SOLVED, Status.NOT_UNIQUE))
            assert np.isfinite(np.r_[alone.x, alone.y]).all()
            assert np.isfinite(moved).all()
            if status != Status.SOLVED:
                assert not np.asarray(moved).any()


def test_a_fall_that_ends_far_away_is_not_called_unbounded():
    for end in (1e-11, 1e-10, 1e-9, 1e-8):
        for qp in (correlated(1.0 - end, (1.0, -1.0)), crossed(end)):
            assert solve(qp).status in (Status.NOT_UNIQUE, Status.INACCURATE), end


def in_decades(seed):
    """A QP of five variables in units from 1e-8 to 1e8 and twelve rows, in turn of each kind.

    Also its status, the units and, if P is definite, the minimiser in these units.
    """
    rng, kind = np.random.default_rng(seed), seed % 8
    M, w, v = rng.normal(size=(5, 5)), rng.normal(size=5), rng.normal(size=5)
    v /= np.linalg.norm(v)
    P, flat, unit = M @ M.T + np.eye(5), np.eye(5) - np.outer(v, v), np.eye(5)
    D = 10.0 ** rng.permutation(np.linspace(-8.0, 8.0, 5))
    A, lower, upper = np.zeros((12, 5)), np.full(12, -INF), np.full(12, INF)
    status = Status.SOLVED
    if kind in (1, 2):  # bounds of the variables
        A[:5], upper[:5] = np.diag(D), 0.1 * D
        lower[:5] = -upper[:5]
    if kind == 2:  # and rows of several
        A[5:], upper[5:] = rng.normal(size=(7, 5)), 0.1
    if kind in (3, 4, 5):
        P, w = flat @ P @ flat, flat @ w
        status = Status.NOT_UNIQUE
    if kind in (4, 5):
        w, status = w - v, Status.UNBOUNDED
    if kind == 5:
        A[0], upper[0], status = v, 3.0, Status.SOLVED
    if kind == 6:
        P = 2.0 * np.ones((5, 5)) - unit
        status = Status.BAD_DATA
    if kind == 7:  # one variable has no price
        P[0], P[:, 0], w[0] = 0.0, 0.0, np.abs(w[0])
        A[0], lower[0] = unit[0], -2.0
    scaled = QP(P / np.outer(D, D), w / D, A / D, lower, upper)
    x = exact_solution(QP(P, w, A, lower, upper))[0] if kind < 3 else None
    return scaled, status, D, x


def test_curvature_is_judged_in_units_of_the_variables():
    cases = [in_decades(seed) for seed in range(EACH)]  # SHAPES[2]
    found = solve_all([qp for qp, *_ in cases])
    np.testing.assert_array_equal(found.status, [status for _, status, *_ in cases])
    for found_x, (_, _, D, x) in zip(found.x, cases, strict=True):
        if x is not None:
            np.testing.assert_allclose(found_x / D, x, atol=1e-10 * np.abs(x).max())


def test_rows_of_small_numbers_bind_bounds_move_and_crossed_ones_are_an_equality_in_the_middle():
    pressed = solve(rows((1e-9 * np.array(FIRST), -INF, -1e-9), (BOTH, -INF, 9.0)))
    np.testing.assert_allclose(pressed.x, [-1.0, 5.0], atol=1e-9)
    for lower, upper, at, moves in ((-INF, 0.5, 0.5, 1.0), (1.0 + 1e-9, 1.0 - 1e-9, 1.0, 0.5)):
        qp = rows((FIRST, lower, upper))
        found, moved = along(qp, only(qp, u=np.ones(3)))
        np.testing.assert_allclose(found.x, [at, 5.0], atol=1e-13)
        np.testing.assert_allclose(moved, [moves, 0.0], atol=1e-9)


def test_condensed_walks_are_solved_though_the_first_rows_are_zeros():
    walks = [oracles.condensed_walk(seed) for seed in range(EACH)]  # SHAPES[3], compiled once
    first = np.array([qp.u[:2].min() for qp in walks])
    assert (first < 0).sum() >= 5
    assert np.abs(first).max() < 1e-16
    found = solve_all(walks)
    check_solved(found)
    for qp, x in zip(walks, found.x, strict=True):
        free = qp._replace(A=qp.A[2:], l=qp.l[2:], u=qp.u[2:])
        np.testing.assert_allclose(x, exact_solution(free)[0], atol=1e-9)


def of_kind(seed):
    """A QP of five variables and nine rows, in turn of each verdict; and which it is."""
    rng, kind = np.random.default_rng(seed), seed % 6
    M, A, x = rng.normal(size=(5, 5)), rng.normal(size=(9, 5)), rng.normal(size=5)
    P, q = M @ M.T + 0.1 * np.eye(5), 10.0 * rng.normal(size=5)
    v = rng.normal(size=5)
    flat = np.eye(5) - np.outer(v, v) / (v @ v)
    if kind in (1, 3):
        P, q, A = flat @ P @ flat, flat @ q - (kind == 3) * 3.0 * v, A @ flat
    if kind == 4:
        P = P - 1.5 * (v @ P @ v) / (v @ v) ** 2 * np.outer(v, v)
    if kind == 5:  # three variables have no price
        P = P * np.outer([1, 1, 0, 0, 0], [1, 1, 0, 0, 0])
    lower, upper = A @ x + (0.05 + rng.exponential(size=(2, 9))) * [[-1.0], [1.0]]
    if kind == 0:
        lower[4] = upper[4] = A[4] @ x
    if kind == 2:
        A[1], lower[1], upper[1] = -A[0], -INF, -upper[0] - 0.5
    names = "SOLVED", "NOT_UNIQUE", "INFEASIBLE", "UNBOUNDED", "BAD_DATA", "SOLVED"
    return QP(P, q, A, lower, upper), Status[names[kind]]


def with_rows(qp, rows, lower, upper):
    """Three more rows, so that all have one shape."""
    A = np.concatenate([qp.A, np.broadcast_to(rows, (3, 5))])
    return qp._replace(A=A, l=np.r_[qp.l, lower], u=np.r_[qp.u, upper])


def in_units(qp, objective=1.0, row=1.0, variable=1.0):
    """The same problem with objective, rows and variables in other units; new rows keep theirs."""
    row = np.r_[np.broadcast_to(row, 9), np.ones(3)]
    variable = np.broadcast_to(variable, 5)
    P, q = objective * qp.P * np.outer(variable, variable), objective * qp.q * variable
    return QP(P, q, row[:, None] * qp.A * variable, row * qp.l, row * qp.u)


def test_units_redundant_rows_and_rounding_change_no_verdict():
    cases, expected = [], []
    for seed in range(24):
        (qp, status), rng = of_kind(seed), np.random.default_rng(100 + seed)
        never = [-INF] * 3, [INF] * 3
        past, noise = ([-INF, 1e-17, -1.0], [-1e-17, INF, 1e-17]), 1e-17 * rng.normal(size=(3, 5))
        again = [qp.l[8], -2.0 * qp.u[1], -INF], [INF, -2.0 * qp.l[1], INF]
        same = [qp.A[8], -2.0 * qp.A[1], 0.1 * qp.A[2]], *again
        for rows_added in ((0.0, *never), same, (0.0, *past), (noise, *past)):
            more = with_rows(qp, *rows_added)
            for size in (1.0, 1e-6, 1e-3, 1e3, 1e6):
                one_row, one_variable = np.ones(9), np.ones(5)
                one_row[rng.integers(9)] = one_variable[rng.integers(5)] = size
                cases += [in_units(more, size), in_units(more, row=one_row)]
                cases += [in_units(more, variable=one_variable)]
            each_row, each_variable = 10 ** rng.uniform(-3, 3, 9), 10 ** rng.uniform(-3, 3, 5)
            cases += [in_units(more, variable=each_variable)]
            cases += [in_units(more, 1e4, each_row, each_variable)]
            expected += [status] * 17
        for bound in (0.0, 1e-17, 1e-9, -1e-9, -1e-6):
            cases += [with_rows(qp, 0.0, never[0], [bound, INF, INF])]
            cases += [with_rows(qp, 0.0, [-INF, -bound, -INF], never[1])]
            unmet = bound == -1e-6 and status != Status.BAD_DATA
            expected += [Status.INFEASIBLE if unmet else status] * 2
    found = solve_all(cases).status  # of SHAPES[2]
    wrong = np.flatnonzero(found != expected)
    assert not [(i, Status(int(found[i])).name, expected[i].name) for i in wrong]


@jax.jit
def _solve_and_pull_batch(qps, cotangent):
    """Solutions of a batch, and the gradients of cotangent'x by all data."""

    def x_and_solution(qp):
        solution = solve_qp(qp)
        return solution.x, solution

    def solve_and_pull(qp):
        _, pull, solution = jax.vjp(x_and_solution, qp, has_aux=True)
        return solution, pull(cotangent)[0]

    return jax.lax.map(solve_and_pull, qps)


def test_rows_without_bounds_change_nothing():
    cases = [of_kind(seed) for seed in range(24)]
    expected = np.array([status for _, status in cases])
    made, never = [], ([-INF] * 3, [INF] * 3)
    for i, (qp, _) in enumerate(cases):
        rng = np.random.default_rng(200 + i)
        sizes = 1.0, 1e-17, 1e-3, 1e3, 1e17, 1e200, 10 ** rng.uniform(-3, 3, (3, 1))
        drawn = [size * rng.normal(size=(3, 5)) for size in sizes]
        made += [with_rows(qp, added, *never) for added in (0.0, 0.5 * np.eye(3, 5), *drawn)]
    cotangent = np.random.default_rng(0).normal(size=5)
    found, gradient = jax.device_get(_solve_and_pull_batch(stack(made), cotangent))
    each = len(made) // len(cases)
    np.testing.assert_array_equal(found.status, np.repeat(expected, each))
    for part in (found.x, found.y, *gradient):
        np.testing.assert_array_equal(part, np.repeat(part[::each], each, axis=0))

    # without the rows sums have fewer terms, which may be rounded differently
    qps = stack([qp for qp, _ in cases])
    alone, alone_gradient = jax.device_get(_solve_and_pull_batch(qps, cotangent))
    np.testing.assert_array_equal(alone.status, expected)
    pairs = zip((found.x, found.y, *gradient), (alone.x, alone.y, *alone_gradient), strict=True)
    for more, part in pairs:
        more, part = more[::each][expected == Status.SOLVED], part[expected == Status.SOLVED]
        rows = part.shape[1]  # nine, or as many as variables
        np.testing.assert_allclose(more[:, :rows], part, rtol=0.0, atol=1e-12)
        assert not more[:, rows:].any()


def test_each_status_has_its_meaning_and_is_documented():
    page = (Path(__file__).parents[1] / "docs" / "qp.md").read_text()
    for status in Status:
        assert status.meaning.endswith(".")
        assert f"| {status.value} `{status.name}` |" in page
    with pytest.raises(ValueError, match=r"QP: NOT_UNIQUE \(.*\)\. x is a minimiser"):
        check_solved(solve(rows(P=FLAT, q=(1.0, 0.0))))


def test_block_rows_are_those_of_the_dense_matrix(walking, walked):
    made = [qp._replace(A=oracles.dense_rows(qp.A)) for qp in walking[:EACH]]
    dense = solve_all(made)  # of SHAPES[5]
    np.testing.assert_allclose(walked.x[:EACH], dense.x, atol=1e-8)
    np.testing.assert_allclose(walked.y[3], dense.y[3], atol=1e-8)  # unique, unlike some others


def test_a_batch_is_a_loop_whatever_becomes_of_its_problems(walking):
    first = walking[0]
    flat = first._replace(P=0.0 * first.P, q=0.0 * first.q)
    falls = flat._replace(q=np.tile([0.0, 0.0, 0.0, 0.0, 1.0], 10))  # a moment without a bound
    crossed = first._replace(l=np.where(first.u == 500.0, 501.0, first.l))
    made = [*walking[:6], flat, falls, crossed, first._replace(q=np.nan * first.q)]
    batch, loop = jax.jit(jax.vmap(solve_qp))(stack(made)), stack([still(qp) for qp in made])
    np.testing.assert_allclose(batch.x, loop.x, atol=1e-8)
    np.testing.assert_array_equal(batch.status, loop.status)
    expected = ["SOLVED"] * 6 + ["NOT_UNIQUE", "UNBOUNDED", "INFEASIBLE", "BAD_DATA"]
    assert [Status(code).name for code in np.asarray(batch.status)] == expected


def test_a_solver_is_a_value_jaxopt_is_one_and_one_of_ones_own_another(walking, walked):
    read = from_table("file", QpConfig, {"solver": "jaxopt"})
    assert (read, hash(read)) == (QpConfig(JAXOPT), hash(QpConfig(JAXOPT)))
    assert to_table(read)["solver"] == "jaxopt"
    called = []

    def counted(*args, max_iterations):
        called.append(max_iterations)
        return approach(*args, max_iterations=max_iterations)

    cold = QpConfig(Solver("interior_point", approach=counted, guess=None), max_iterations=59)
    found = [solve(qp, cold) for qp in walking[:4]]
    assert set(called) == {59}
    np.testing.assert_allclose(stack(found).x, walked.x[:4], atol=1e-6)
    for qp in walking[:4]:
        tangent = only(qp, q=np.ones(50))
        ours, mine = along(qp, tangent)
        theirs, other = along(qp, tangent, QpConfig(JAXOPT))
        check_solved(theirs)
        np.testing.assert_allclose(theirs.x, ours.x, atol=1e-6)
        np.testing.assert_allclose(other, mine, atol=1e-6 * np.abs(mine).max())


def tangents(seed, qp):
    rng = np.random.default_rng(seed)
    P, q, A = (rng.normal(size=part.shape) * np.abs(part) for part in qp[:3])
    return [only(qp, q=q), only(qp, P=5e-3 * (P + P.T), A=1e-2 * A)]


def test_derivative_is_that_of_an_exact_solver(walking):
    errors = []
    for seed in range(60):
        qp = walking[seed]
        for tangent in tangents(seed, qp):
            _, moved = along(qp, tangent)
            # A change of the active set inside the step shows in the larger one only.
            found = [oracles.central_difference(qp, tangent, step) for step in (1e-5, 1e-6)]
            size = np.linalg.norm(found[1])
            errors.append(min(np.linalg.norm(moved - f) for f in found) / size)
    assert np.median(errors) <= 1e-7, np.median(errors)
    assert np.quantile(errors, 0.95) <= 1e-6, np.quantile(errors, 0.95)
    assert np.max(errors) <= 1e-3, np.max(errors)


def test_forward_and_reverse_are_one_derivative(walking):
    pull = jax.jit(lambda qp, seed: jax.vjp(lambda qp: solve_qp(qp).x, qp)[1](seed)[0])
    for seed in range(10):
        qp, rng = walking[seed], np.random.default_rng(seed)
        cotangent = jnp.asarray(rng.normal(size=50))
        back = pull(qp, cotangent)
        for tangent in tangents(seed, qp):
            _, moved = along(qp, tangent)
            reverse = sum(float(jnp.vdot(b, t)) for b, t in zip(back, tangent, strict=True))
            scale = np.linalg.norm(moved) * np.linalg.norm(cotangent)
            assert abs(float(moved @ cotangent) - reverse) <= 1e-9 * scale


@pytest.mark.parametrize("times", [1e3, 1e6])
def test_a_q_that_is_too_large_makes_no_problem_infeasible_or_unbounded(times):
    made = [oracles.general_qp(seed, 5, 12)[0] for seed in range(3 * EACH)]
    found = solve_all([qp._replace(q=times * qp.q) for qp in made])
    assert np.isin(found.status, [Status.SOLVED, Status.NOT_UNIQUE]).all()


INTERPRETED = partial(gpu_kernel.guess, interpret=True)


def as_on_a_gpu(monkeypatch, kernel=INTERPRETED):
    """The default solver, its guess from this kernel; what is traced from now on is for a GPU."""

    def guess(tolerances, qp):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax.lax, "platform_dependent", lambda *args, cuda, default: cuda(*args))
            patch.setattr(gpu_kernel, "guess", kernel)
            return first_guess(tolerances, qp)

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    return QpConfig(solver=Solver("interior_point", approach=approach, guess=guess))


def test_on_a_gpu_the_kernels_point_is_the_solution(monkeypatch):
    config, robot = WalkConfig(), load_robot()

    def layer(qp_config, problem):
        def first(weights):
            qp = layer_qp(config, robot, problem._replace(weights=weights))
            found = solve_qp(qp, qp_config)
            return found.x[:5] @ problem.pull, found

        return jax.grad(first, has_aux=True)(problem.weights)

    problems = draw_problems(config, robot, 100)
    slope, usual = jax.jit(partial(jax.lax.map, partial(layer, QpConfig())))(problems)
    gpu = as_on_a_gpu(monkeypatch)
    along, found = jax.jit(partial(jax.lax.map, partial(layer, gpu)))(problems)
    assert (found.iterations == 0).all()  # nothing was corrected
    assert (found.status == Status.SOLVED).all()
    size = jnp.max(jnp.abs(usual.x), axis=1, keepdims=True)
    assert (jnp.abs(found.x - usual.x) <= 1e-10 * size).all()
    for theirs, ours in zip(*map(jax.tree.leaves, (along, slope)), strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=1e-7, atol=1e-9 * np.abs(ours).max())


@pytest.mark.parametrize("settled", [False, True])
def test_on_a_gpu_a_wrong_point_of_the_kernel_is_corrected(walking, walked, settled, monkeypatch):
    """One that did not settle is not taken, one that did is where the corrections start."""

    def lost(P, q, A, lower, upper, curvature):
        x, side = jnp.full_like(q, 1.0 if settled else jnp.nan), jnp.ones(len(lower), jnp.int32)
        return gpu_kernel.Guess(x, jnp.ones_like(lower), side, jnp.int32(settled), jnp.int32(0))

    config = as_on_a_gpu(monkeypatch, lost)
    for qp, x in zip(walking[:4], walked.x[:4], strict=True):
        found = solve(qp, config)
        check_solved(found)
        assert found.iterations > 0
        np.testing.assert_allclose(found.x, x, atol=1e-9 * np.abs(x).max())


IN_32_BITS = pytest.param(np.float32, 1e-3, marks=pytest.mark.slow)  # compiles all once more


@pytest.mark.parametrize(("dtype", "error"), [(np.float64, 1e-9), IN_32_BITS])
def test_on_a_gpu_each_verdict_of_a_batch_is_that_of_the_cpu(dtype, error, monkeypatch):
    """Also if the kernel solves a problem but does not prove P definite: a flat one, or 32 bits."""
    P, one = np.diag([1.0, 1.0, 1.0, 1.0, 0.0]), np.ones(9)
    flat = QP(P, 5.0 * P[0], np.eye(9, 5), -one, one)
    saddle, nan = flat._replace(P=2.0 * P - np.eye(5)), flat._replace(q=np.full(5, np.nan))
    cases = [(flat, Status.NOT_UNIQUE), *map(of_kind, range(30, 36))]
    size = 10.0 ** np.array([-5, -2, 0, 2, 5])  # x is 1 / size
    decades = QP(np.diag(size**2), -size, flat.A, -1e6 * one, 1e6 * one)
    cases += [(saddle, Status.BAD_DATA), (nan, Status.BAD_DATA), (decades, Status.SOLVED)]
    qps = stack([qp._replace(A=qp.A[None]) for qp, _ in cases])  # one block
    qps = jax.tree.map(lambda part: part.astype(dtype), qps)
    cpu = jax.jit(jax.vmap(solve_qp))(qps)
    gpu = jax.jit(jax.vmap(partial(solve_qp, config=as_on_a_gpu(monkeypatch))))(qps)
    np.testing.assert_array_equal(cpu.status, [status for _, status in cases])
    np.testing.assert_array_equal(gpu.status, cpu.status)
    assert not gpu.iterations[:2].any()  # the kernel solved these
    size = jnp.max(jnp.abs(cpu.x), axis=1, keepdims=True)
    assert (jnp.abs(gpu.x - cpu.x) <= error * size)[cpu.status == Status.SOLVED].all()


def test_derivative_is_finite_where_it_is_one_sided():
    weak = small(u=(1.0,))  # the row passes through the free minimiser: active without force
    _, moved = along(weak, only(weak, q=np.array([-1.0, 0.0])))
    assert 0.0 <= moved[0] <= 0.5  # between that of the row held and that of the row free
    A = (1.0, -0.5), (1.0, 0.5), (0.0, 1.0)
    apex = small(P=np.eye(2), q=(0.0, 1.0), A=A, l=(-INF, 0, 0), u=(0, INF, INF))
    found, moved = along(apex, jax.tree.map(jnp.ones_like, apex))
    check_solved(found)
    np.testing.assert_allclose(found.x, 0.0, atol=1e-8)
    assert np.isfinite(moved).all()


def test_data_that_is_not_finite_is_told_and_moves_nothing_and_residuals_have_no_slope():
    def pull(qp):
        return jax.grad(lambda qp: jnp.sum((found := solve_qp(qp)).x + found.y[0]))(qp)

    for number in (np.nan, np.inf, -np.inf):
        for part in "PqA":
            value = np.array(getattr(good := small(l=(-1.0,), u=(1.0,)), part))
            value.flat[0] = number
            qp = good._replace(**{part: value})
            assert along(qp, good)[0].status == Status.BAD_DATA
            assert not np.any(np.concatenate([along(qp, good)[1], *map(np.ravel, pull(qp))]))

    @jax.jit
    def slopes(qp):  # of evidence: a loss that holds it is not pulled by its rounding
        moved = jax.jvp(solve_qp, (qp,), (qp,))[1]
        return moved.primal_residual, moved.dual_residual, moved.gap

    assert slopes(small()) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("change", [{"q": np.zeros(3)}, {"A": np.zeros((1, 3))}])
def test_shapes_that_do_not_fit_are_refused(change):
    with pytest.raises(ValueError, match="QP shapes"):
        solve_qp(small()._replace(**change))


@pytest.mark.parametrize(("small", "large"), [(1e-10, 1e10), (1e-16, 1e16), (1e-100, 1e100)])
def test_a_curvature_counts_however_large_the_others_are(small, large):
    for diagonal in ([small, large], [large, small]):
        found = solve(rows(P=np.diag(diagonal), q=(-1.0, -1.0)))
        check_solved(found)
        np.testing.assert_allclose(found.x, 1.0 / np.array(diagonal), rtol=1e-12)


def knee(p):
    """1 / p, as the minimiser of p x^2 / 2 - x."""
    one = jnp.ones(1)
    return solve_qp(QP(p * jnp.eye(1), -one, jnp.ones((1, 1)), -9.0 * one, 9.0 * one)).x[0]


def twice(p):
    """The same in a loop, as a walk is one."""
    return jax.lax.scan(lambda x, _: (knee(x), None), p, None, length=2)[0]


@pytest.mark.parametrize("of", [knee, twice])
def test_a_second_derivative_is_refused_and_not_zero(of):
    sound, two = -0.25 if of is knee else 1.0, jnp.array([2.0, 2.0])
    for first in (jax.grad(of), jax.jacfwd(of), jax.grad(jax.checkpoint(of))):
        np.testing.assert_allclose(jax.jit(jax.vmap(first))(two), sound, rtol=1e-9)
        for second in (jax.grad(first), jax.jacfwd(jax.jit(first))):
            with pytest.raises(NotImplementedError, match="first derivative only"):
                second(2.0)
    other = jax.grad(lambda p: jax.grad(lambda t: t**2 * of(p))(3.0))  # of the QP but once
    np.testing.assert_allclose(other(2.0), 6.0 * sound, rtol=1e-9)


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_a_program_with_strict_promotion_can_solve_and_differentiate(kind):
    A, one = np.array([[[1.0, 1.0]], [[1.0, 0.0]]], kind).reshape(2, 2), np.ones(2, kind)
    low, high = np.array([1.0, 0.0], kind), np.array([1.0, 0.2], kind)
    blocks = QP(np.eye(2, dtype=kind), -one, np.eye(2, dtype=kind)[:, None, :1], -one, one)
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        dense = QP(np.eye(2, dtype=kind), 0 * one, A, low, high)
        for qp in (dense, blocks._replace(A=A[:1, None], l=-one[:1], u=one[:1])):
            qp = jax.tree.map(jnp.asarray, qp)
            slope = jax.jit(jax.grad(jax.jit(lambda q, qp=qp: solve_qp(qp._replace(q=q)).x[0])))
            assert np.isfinite(slope(qp.q)).all()
            assert solve_qp(qp).x.dtype == kind
    found = solve_qp(QP(np.eye(2), 0.0 * one, A, low, high)).x
    np.testing.assert_allclose(found, [0.2, 0.8], atol=1e-6)


def test_whole_numbers_are_solved_in_the_default_floats():
    parts = [[2, 0], [0, 2]], [-2, -5], [[1, 2]], [-10], [3]
    found = solve_qp(QP(*map(jnp.asarray, parts)))
    assert found.x.dtype == np.float64
    np.testing.assert_allclose(found.x, [0.4, 1.3], atol=1e-12)


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
