"""The condensed MPC against Eq. 3-4 written out: its cost, its constraints, its derivative."""

import pickle
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from model import ROBOT, WEIGHT, random_weights
from oracles import exact_solution, pack_state

from hector_jax.control import LINE_FOOT, InputConstraint, InputCost, Squares, StateConstraint
from hector_jax.control.contact import FLAT_FOOT, FRICTION, LINE_FRICTION, Contact, Rows, StateCost
from hector_jax.control.disturbance import NO_DISTURBANCE
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, build_qp, solve_mpc
from hector_jax.control.mpc_by_rows import solve_mpc_by_rows
from hector_jax.control.parameters import bounds
from hector_jax.control.weights import Weights, expert, vector_to_weights, weights_to_vector
from hector_jax.core.geometry import rot_z
from hector_jax.core.settings import from_table, to_table
from hector_jax.core.trajectory import Disturbance, State, pack_wrench
from hector_jax.qp import QP, Status, solve_qp
from hector_jax.robot import srbm

CONFIG = MpcConfig()
N, DT = CONFIG.horizon, 0.03


@partial(jax.jit, static_argnums=(0, 2))
def _answer(config, problem, contacts):
    what = {"dt": DT, "max_contacts": contacts}
    return solve_mpc(config, problem, **what), build_qp(config, problem, **what)


def answer(config, weights, state, horizon, contacts, lacking=NO_DISTURBANCE):
    """Wrench and solution, and the QP and the map from its inputs to u_0.

    Configurations that differ in traced numbers alone share a program.
    """
    problem = MpcProblem(ROBOT, config.parameters(weights), state, horizon, lacking)
    numbers = ("friction", "max_force", "effort_reference")
    shape = replace(config, **{name: getattr(CONFIG, name) for name in numbers})
    return _answer(shape, jax.tree.map(jnp.asarray, problem), contacts)


def solve(*args):
    return answer(*args)[0]


linearise = jax.jit(jax.vmap(lambda e, r: srbm.linearise(ROBOT, e, r, DT)))


def problem(seed, push=1.0, contact=None, yaw=0.5):
    """A state some way off a walking reference, and a horizon that changes feet at step 4."""
    rng = np.random.default_rng(seed)
    spread = np.array([[0.05], [0.02], [0.3], [0.2]])
    off = push * spread * rng.normal(size=(4, 3))
    heading = yaw + 0.02 * np.arange(1, N + 1)
    zero = np.zeros((N, 3))
    euler, position, velocity, spin = (zero.copy() for _ in range(4))
    euler[:, 2], spin[:, 2] = heading, 0.02 / DT
    velocity[:, 0], velocity[:, 1] = 0.4 * np.cos(heading), 0.4 * np.sin(heading)
    position[:] = [0.0, 0.0, 0.5]
    position += np.cumsum(velocity, axis=0) * DT
    reference = State(euler, position, spin, velocity)
    state = State(*([[0.0, 0.0, yaw], [0.0, 0.0, 0.5], np.zeros(3), velocity[0]] + off))
    side = np.array([[0.0, 0.08, -0.5], [0.0, -0.08, -0.5]])
    turn = np.asarray(rot_z(jnp.array(yaw)))
    lever = (side + 0.02 * rng.normal(size=(N, 2, 3)) * [1, 1, 0]) @ turn.T
    if contact is None:
        left = np.arange(N) < 4
        contact = np.stack([left, ~left], axis=1)
    about = np.stack([0 * heading, 0 * heading, heading - 0.02], axis=1)
    foot_yaw = yaw + 0.1 * rng.normal(size=(N, 2))
    horizon = Horizon(reference, about, lever, foot_yaw, np.asarray(contact))
    return jax.tree.map(jnp.asarray, (state, horizon))


BOTH = np.ones((N, 2), bool)
LACKING = Disturbance(np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -1.0]))


def inputs(horizon, v, max_contacts=1):
    """The paper's u_k (N, 12), from the QP's variables, one foot at a time."""
    u = np.zeros((N, 2, 2, 3))  # step, force or moment, foot, axis
    v = np.asarray(v).reshape(N, max_contacts, 5)
    for k in range(N):
        for foot in np.flatnonzero(horizon.contact[k]):
            fx, fy, fz, my, mz = v[k, foot if max_contacts == 2 else 0]
            u[k, 0, foot] = fx, fy, fz
            u[k, 1, foot] = np.asarray(rot_z(horizon.foot_yaw[k, foot])) @ [0.0, my, mz]
    return u.reshape(N, 12)


def rolled_out(state, horizon, u):
    """States (N, 15) after each step of Eq. 4a, x = A_k x + B_k u, gravity among them."""
    A, B = linearise(horizon.euler, horizon.lever)
    x, found = np.asarray(pack_state(state, jnp.asarray(ROBOT.gravity))), []
    for k in range(N):
        x = np.asarray(A[k]) @ x + np.asarray(B[k]) @ u[k]
        found.append(x)
    assert (x[12:] == ROBOT.gravity).all()
    return np.array(found)


def cost(weights, state, horizon, u):
    Q, R = np.concatenate(weights.Q), np.asarray(pack_wrench(weights.R))
    wanted = np.concatenate(horizon.reference, axis=1)
    states = rolled_out(state, horizon, u)[:, :12]
    return np.sum((states - wanted) ** 2 @ Q) + np.sum(u**2 @ R)


def sparse_problem(weights, state, horizon):
    """Eq. 3-4 with states, twelve inputs and every constraint; toe and heel as two contacts.

    The twelve rows of a step's dynamics come first, then those of each foot, see `KINDS`.
    """
    A, B = (np.asarray(M) for M in linearise(horizon.euler, horizon.lever))
    Q, R = np.concatenate(weights.Q), np.asarray(pack_wrench(weights.R))
    wanted = np.concatenate(horizon.reference, axis=1)
    P = scipy.linalg.block_diag(*[np.diag(2 * Q)] * N, *[np.diag(2 * R)] * N)
    q = np.concatenate([*(-2 * Q * wanted), np.zeros(12 * N)])
    rows, lower, upper = [], [], []

    def add(k, on_input, low, high):
        row = np.zeros((len(on_input), 24 * N))
        row[:, 12 * (N + k) : 12 * (N + k + 1)] = on_input
        rows.append(row)
        lower.append(np.full(len(row), low))
        upper.append(np.full(len(row), high))

    x = np.asarray(pack_state(state, jnp.asarray(ROBOT.gravity)))
    toe, heel, mu = ROBOT.toe, ROBOT.heel, CONFIG.friction
    for k in range(N):
        row = np.zeros((12, 24 * N))
        row[:, 12 * k : 12 * k + 12] = np.eye(12)
        known = A[k, :12, 12:] @ ROBOT.gravity
        if k:
            row[:, 12 * (k - 1) : 12 * k] = -A[k, :12, :12]
        else:
            known = known + A[k, :12, :12] @ x[:12]
        row[:, 12 * (N + k) : 12 * (N + k + 1)] = -B[k, :12]
        rows.append(row)
        lower.append(known)
        upper.append(known)
        for foot in (0, 1):
            force = np.eye(12)[3 * foot : 3 * foot + 3]
            moment = np.eye(12)[6 + 3 * foot : 9 + 3 * foot]
            if not horizon.contact[k, foot]:
                add(k, np.concatenate([force, moment]), 0.0, 0.0)
                continue
            R_foot = np.asarray(rot_z(horizon.foot_yaw[k, foot]))
            moment, side = R_foot.T @ moment, R_foot[:, 1] @ force
            add(k, moment[:1], 0.0, 0.0)
            for along in (force[:1] + force[1:2], force[:1] - force[1:2]):
                add(k, along - mu * force[2], -np.inf, 0.0)
                add(k, along + mu * force[2], 0.0, np.inf)
            add(k, force[2:], 0.0, CONFIG.max_force)
            # loads and side forces at toe and heel that amount to F_z, M_y and to side force, M_z
            load = np.linalg.inv([[1, 1], [-toe, heel]]) @ np.stack([force[2], moment[1]])
            across = np.linalg.inv([[1, 1], [toe, -heel]]) @ np.stack([side, moment[2]])
            add(k, load, 0.0, np.inf)
            grip = mu * np.abs(R_foot[:2, 1]).max()
            add(k, across - grip * load, -np.inf, 0.0)
            add(k, across + grip * load, 0.0, np.inf)
    return QP(P, q, *map(np.concatenate, (rows, lower, upper)))


# of the rows of a foot on the ground
KINDS = {"pyramid": range(1, 5), "max": [5], "toe": [6], "heel": [7]}
KINDS |= {"grip of the toe": [8, 10], "grip of the heel": [9, 11]}


def test_the_answer_is_that_of_the_sparse_problem_and_each_kind_of_row_holds_it_somewhere():
    """With one foot on the ground also where there is room for two; and with both."""
    pressed = dict.fromkeys(KINDS, 0)
    for seed in range(10):
        left = np.arange(N) < 4 if seed % 2 else np.arange(N) >= 4
        contact = np.stack([left, ~left], axis=1) if seed < 8 else BOTH
        state, horizon = problem(seed, push=1.0 + seed % 4, contact=contact, yaw=0.5 + seed)
        if seed == 0:  # a hard landing asks for more than the greatest force
            state = state._replace(velocity=state.velocity.at[2].set(-3.0))
        weights = random_weights(seed)
        exact, prices = exact_solution(sparse_problem(weights, state, horizon))
        u = exact[12 * N :].reshape(N, 12)
        least = cost(weights, state, horizon, u)
        for contacts in (1, 2) if seed < 8 else (2,):
            wrench, solution = solve(CONFIG, weights, state, horizon, contacts)
            assert solution.status == Status.SOLVED
            np.testing.assert_allclose(pack_wrench(wrench), u[0], atol=1e-5)
            found = inputs(horizon, solution.x, contacts)
            np.testing.assert_allclose(found, u, atol=1e-4)
            assert cost(weights, state, horizon, found) == pytest.approx(least)
        empty = np.asarray(solution.x).reshape(N, 2, 5)[~contact]
        np.testing.assert_allclose(empty, 0.0, atol=1e-9)
        for stands_left, price in zip(left, prices.reshape(N, -1), strict=True):
            of_foot = price[12:24] if stands_left or seed >= 8 else price[18:]
            for kind, its in KINDS.items():
                pressed[kind] += (np.abs(of_foot[list(its)]) > 1e-6).any()
    assert all(pressed.values()), pressed


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 4, 1.2])
def test_what_toe_and_heel_hold_across_a_foot_is_what_the_plants_hold(yaw):
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    # a force of one across the foot, and whatever toe and heel push against each other along it
    least = min(np.abs(across + push * along).sum() for push in np.linspace(-2, 2, 4001))
    six = jnp.asarray(LINE_FOOT.selection)
    contact = Contact(six[:3], six[3:], jnp.asarray(yaw), ROBOT, CONFIG.friction, CONFIG.max_force)
    rows = np.asarray(LINE_FRICTION.of(contact).A)
    load = np.array([0.0, 0.0, 1.0, 0.0, 0.0])  # shared by toe and heel
    grip = (rows[1] - rows[0]) @ load / 2 / ROBOT.heel
    assert grip == pytest.approx(CONFIG.friction / least, rel=1e-3)


def test_a_plan_obeys_an_input_and_a_state_constraint_of_ones_own():
    state, horizon = problem(3, push=2.0)
    state = state._replace(velocity=state.velocity.at[2].set(-0.3))

    def planned(config):
        _, solution = solve(config, expert(), state, horizon, 1)
        assert solution.status == Status.SOLVED
        u = inputs(horizon, solution.x)
        twist = np.abs(u[:, 6:].reshape(N, 2, 3)[..., 2]).max()
        return twist, rolled_out(state, horizon, u)[1:, 11].min()

    twist, fall = planned(CONFIG)
    assert twist > 0.0 > fall

    def gentle(contact):
        return Rows(contact.moment[2:], -0.5 * twist, 0.5 * twist)

    def slow(step):
        bound = jnp.where(step.number == 0, -jnp.inf, 0.5 * fall)  # the first step is free
        return Rows(step.state.velocity[2:], bound, jnp.inf)

    own = InputConstraint("gentle", of=gentle), StateConstraint("slow", of=slow)
    less, slower = planned(MpcConfig(constraints=(*CONFIG.constraints, *own)))
    assert less <= 0.5 * twist + 1e-6
    assert slower >= 0.5 * fall - 1e-6


def test_costs_of_ones_own_are_added_to_those_of_the_weights():
    prices = np.array([1e-4, 2e-4, 5e-4])

    def place(step):
        return Squares(step.state.position, step.reference.position, 70.0)

    def carry(contact):
        return Squares(contact.force, jnp.array([0.0, 0.0, WEIGHT]), prices)

    config, base = MpcConfig(effort_reference="gravity"), expert()
    own = replace(config, costs=(StateCost("place", of=place), InputCost("carry", of=carry)))
    heavy = base._replace(
        Q=base.Q._replace(position=base.Q.position + 70.0),
        R=base.R._replace(force=base.R.force + prices),
    )
    state, horizon = problem(3, push=2.0)
    for contacts in (1, 2):  # one foot stands at a time
        _, expected = solve(config, heavy, state, horizon, contacts)
        _, got = solve(own, base, state, horizon, contacts)
        assert got.status == Status.SOLVED
        np.testing.assert_allclose(got.x, expected.x, atol=1e-6)
        _, plain = solve(config, base, state, horizon, contacts)
        assert np.abs(plain.x - expected.x).max() > 0.1


def test_constraints_are_chosen_by_name_and_are_else_those_of_the_contact_model():
    names = ["friction", "unilateral_force", "line_pressure", "line_friction"]
    table = {"contact": "line", "constraints": names}
    assert from_table("robot.toml", MpcConfig, table) == CONFIG
    assert from_table("config.json", MpcConfig, to_table(CONFIG)) == CONFIG
    if not hasattr(MpcConfig.__init__, "__wrapped__"):  # no types are checked, which names are not
        assert MpcConfig(contact="line", constraints=("friction",)).constraints == (FRICTION,)
    assert pickle.loads(pickle.dumps(CONFIG)) == CONFIG
    assert [str(one) for one in MpcConfig(line_friction=False).on("inputs")] == names[:3]
    assert replace(MpcConfig(line_friction=False), line_friction=True) == MpcConfig()
    flat = replace(MpcConfig(), contact=FLAT_FOOT)
    assert (flat, flat.constraints) == (MpcConfig(contact=FLAT_FOOT), FLAT_FOOT.constraints)
    assert replace(flat, contact=LINE_FOOT, friction=0.5) == MpcConfig(friction=0.5)
    assert replace(pickle.loads(pickle.dumps(CONFIG)), contact=FLAT_FOOT) == flat
    named = MpcConfig(constraints=(FRICTION,))
    assert replace(named, contact=FLAT_FOOT).constraints == (FRICTION,)


def standing():
    still = np.tile([0.0, 0.0, 0.5], (N, 1))
    zero = np.zeros((N, 3))
    lever = np.tile([[0.0, 0.08, -0.5], [0.0, -0.08, -0.5]], (N, 1, 1))
    horizon = Horizon(State(zero, still, zero, zero), zero, lever, np.zeros((N, 2)), BOTH)
    state = State(*(np.array(row[0]) for row in horizon.reference))
    return jax.tree.map(jnp.asarray, (state, horizon))


def test_two_feet_in_the_corner_of_the_box_have_no_unique_wrench():
    """R of 1e-7 beside Q of 1e4 hardly prices how two feet share a wrench."""
    weights = Weights(bounds()[1].Q, bounds()[0].R)
    for max_contacts, status in ((1, Status.SOLVED), (2, Status.NOT_UNIQUE)):
        state, horizon = problem(1, contact=BOTH if max_contacts == 2 else None)
        _, solution = solve(CONFIG, weights, state, horizon, max_contacts)
        assert solution.status == status
        assert max(solution.primal_residual, solution.dual_residual, solution.gap) <= 1e-8


def test_effort_about_the_weight_stands_with_exactly_the_weight_on_two_feet_or_on_one():
    state, horizon = standing()
    config = MpcConfig(effort_reference="gravity")
    wrench, _ = solve(config, expert(), state, horizon, 2)
    np.testing.assert_allclose(wrench.force, [[0.0, 0.0, WEIGHT / 2]] * 2, atol=1e-6)
    np.testing.assert_allclose(wrench.moment, 0.0, atol=1e-6)
    horizon = horizon._replace(contact=jnp.asarray(BOTH).at[:, 1].set(False))
    dear = expert()._replace(R=jax.tree.map(lambda r: 1e9 * r, expert().R))
    wrench, _ = solve(config, dear, state, horizon, 1)
    np.testing.assert_allclose(wrench.force, [[0.0, 0.0, WEIGHT], [0.0] * 3], atol=1e-3)


@pytest.mark.parametrize(("contacts", "stance"), [(1, None), (2, None), (2, BOTH)])
def test_the_derivative_without_the_matrix_is_that_of_the_qp(contacts, stance):
    """In the weights, the state and the levers, of all inputs and multipliers, in both modes."""
    state, horizon = problem(6, push=2.0, contact=stance)
    config = MpcConfig(effort_reference="zero" if contacts == 1 else "gravity")
    what = {"dt": DT, "max_contacts": contacts}

    def asked(logs, shift, lever):
        weights = vector_to_weights(weights_to_vector(expert()) * jnp.exp(logs))
        moved = state._replace(position=state.position + shift)
        level = horizon._replace(lever=horizon.lever + lever)
        return MpcProblem(ROBOT, config.parameters(weights), moved, level, LACKING)

    def with_slope(*at):
        found = solve_mpc(config, asked(*at), **what)[1]
        return jnp.concatenate([found.x, found.y])

    def with_matrix(*at):
        found = solve_qp(build_qp(config, asked(*at), **what)[0], config.qp)
        return jnp.concatenate([found.x, found.y])

    at = jnp.zeros(24), jnp.zeros(3), jnp.zeros(3)
    rng = np.random.default_rng(0)
    along = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in at)
    pull = jnp.asarray(rng.normal(size=jax.eval_shape(with_matrix, *at).shape))
    forward, reverse = [], []
    for function in (with_slope, with_matrix):
        forward.append(jax.jit(lambda f=function: jax.jvp(f, at, along))())
        reverse.append(jax.jit(lambda f=function: jax.vjp(f, *at)[1](pull))())
    np.testing.assert_array_equal(forward[0][0], forward[1][0])
    inputs = N * 5 * contacts
    for part in (slice(inputs), slice(inputs, None)):
        one, other = forward[0][1][part], forward[1][1][part]
        size = np.abs(other).max()
        assert size > 1e-3
        np.testing.assert_allclose(one, other, atol=1e-8 * size)
    for one, other in zip(*reverse, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8 * np.abs(other).max())
    both = sum(float(jnp.vdot(g, d)) for g, d in zip(reverse[0], along, strict=True))
    assert both == pytest.approx(float(pull @ forward[0][1]), rel=1e-8)


@pytest.mark.parametrize(("contacts", "stance"), [(1, None), (2, BOTH)])
def test_the_derivative_by_rows_is_that_of_the_wrench_for_many_tangents_and_in_reverse(
    contacts, stance
):
    state, horizon = problem(6, push=2.0, contact=stance)
    config = MpcConfig()

    def wrench(solve, inputs):
        logs, shift, turn = jnp.split(inputs, (24, 27))
        weights = vector_to_weights(weights_to_vector(expert()) * jnp.exp(logs))
        moved = state._replace(position=state.position + shift)
        turned = horizon._replace(foot_yaw=horizon.foot_yaw + turn)
        asked = MpcProblem(ROBOT, config.parameters(weights), moved, turned, LACKING)
        return pack_wrench(solve(config, asked, DT, contacts)[0])

    at, found = jnp.zeros(29), []
    for solve in (solve_mpc, solve_mpc_by_rows):
        of = partial(wrench, solve)
        found.append(jax.jit(lambda of=of: (of(at), jax.jacfwd(of)(at), jax.jacrev(of)(at)))())
    np.testing.assert_array_equal(found[0][0], found[1][0])
    for one, other in zip(found[0][1:], found[1][1:], strict=True):
        assert np.abs(one[:, 27:]).max() > 1e-3  # also by what the wrench alone depends on
        np.testing.assert_allclose(one, other, atol=1e-10 * np.abs(one).max())
