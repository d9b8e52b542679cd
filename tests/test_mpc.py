"""The condensed MPC against Eq. 3-4 written out: its cost, its constraints, its symmetries."""

import pickle
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from oracles import exact_solution, pack_state

from hector_jax.control.contact import (
    FRICTION,
    LINE_FOOT,
    LINE_FRICTION,
    Contact,
    InputConstraint,
    InputCost,
    Rows,
    Squares,
    StateConstraint,
    StateCost,
)
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, build_qp, half_slope, solve_mpc
from hector_jax.control.parameters import bounds
from hector_jax.control.weights import (
    Weights,
    expert,
    nominal,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.geometry import rot_z
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import from_table, to_table
from hector_jax.core.trajectory import State, Wrench, pack_wrench, unpack_wrench
from hector_jax.qp import QP, Status, solve_qp
from hector_jax.robot import srbm
from hector_jax.robot.model import load_robot

ROBOT = load_robot()
CONFIG = MpcConfig()
N, DT = CONFIG.horizon, 0.03
WEIGHT = float(ROBOT.mass * ROBOT.gravity[2])
FLIP, TURN = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])  # of vectors, of axial ones


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


def write(*args):
    return answer(*args)[1]


linearise = jax.jit(jax.vmap(lambda e, r: srbm.linearise(ROBOT, e, r, DT)))


def random_weights(seed):
    draws = np.random.default_rng(seed).uniform(-1, 1, 24)
    return vector_to_weights(weights_to_vector(expert()) * 3.0**draws)


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
    state = State(
        np.array([0.0, 0.0, yaw]) + off[0],
        np.array([0.0, 0.0, 0.5]) + off[1],
        off[2],
        velocity[0] + off[3],
    )
    side = np.array([[0.0, 0.08, -0.5], [0.0, -0.08, -0.5]])
    lever = (side + 0.02 * rng.normal(size=(N, 2, 3)) * [1, 1, 0]) @ np.asarray(
        rot_z(jnp.array(yaw))
    ).T
    if contact is None:
        left = np.arange(N) < 4
        contact = np.stack([left, ~left], axis=1)
    about = np.stack([0 * heading, 0 * heading, heading - 0.02], axis=1)
    horizon = Horizon(
        reference, about, lever, yaw + 0.1 * rng.normal(size=(N, 2)), np.asarray(contact)
    )
    return jax.tree.map(jnp.asarray, (state, horizon))


BOTH = np.ones((N, 2), bool)


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


def cost(weights, state, horizon, u, about=0.0, gained=0.0):
    """Eq. 3 by rolling u out through A_k, B_k of Eq. 4a, gravity among the 15 states.

    `gained` is added to the states in each step.
    """
    A, B = linearise(horizon.euler, horizon.lever)
    x, total = np.asarray(pack_state(state, jnp.asarray(ROBOT.gravity))), 0.0
    Q, R = np.concatenate(weights.Q), np.asarray(pack_wrench(weights.R))
    wanted = np.concatenate(horizon.reference, axis=1)
    for k in range(N):
        x = np.asarray(A[k]) @ x + np.asarray(B[k]) @ u[k] + gained
        total += Q @ (x[:12] - wanted[k]) ** 2 + R @ (u[k] - about) ** 2
    assert (x[12:] == ROBOT.gravity).all()
    return total


def test_what_the_model_lacks_is_predicted_to_stay():
    state, horizon = problem(3)
    lacking = Disturbance(np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -1.0]))
    turned = np.asarray(rot_z(state.euler[2]))
    gained = DT * np.concatenate(
        [np.zeros(6), turned @ lacking.angular, turned @ lacking.linear, np.zeros(3)]
    )
    found, _ = answer(CONFIG, expert(), state, horizon, 1, lacking)[1]
    values = []
    for v in np.random.default_rng(0).normal(size=(3, N * 5)) * 20.0:
        written = cost(expert(), state, horizon, inputs(horizon, v), gained=gained)
        values.append(written - float(0.5 * v @ found.P @ v + found.q @ v))
    np.testing.assert_allclose(values, values[0], rtol=1e-9)


def sparse_problem(weights, state, horizon):
    """Eq. 3-4 with states, twelve inputs and every constraint; toe and heel as two contacts."""
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


@pytest.mark.parametrize(("max_contacts", "about"), [(1, "zero"), (2, "zero"), (2, "gravity")])
def test_the_condensed_cost_is_that_of_the_rolled_out_states(max_contacts, about):
    config = MpcConfig(effort_reference=about)
    weights, (state, horizon) = (
        random_weights(1),
        problem(1, contact=BOTH if max_contacts == 2 else None),
    )
    qp, _ = write(config, weights, state, horizon, max_contacts)
    rng = np.random.default_rng(2)
    share = np.tile([0.0, 0.0, WEIGHT / 2], 4)
    share[6:] = 0.0

    def both(v):
        found = 0.5 * v @ qp.P @ v + qp.q @ v
        u = inputs(horizon, v, max_contacts)
        return found - cost(weights, state, horizon, u, share if about == "gravity" else 0.0)

    vs = rng.normal(size=(4, len(qp.q))) * np.tile([20, 20, 100, 3, 3], N * max_contacts)
    gaps = np.array([both(v) for v in vs])  # the same constant for every v
    np.testing.assert_allclose(gaps, gaps[0], rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_answer_is_that_of_the_sparse_problem(seed):
    weights, (state, horizon) = random_weights(seed), problem(seed, push=1.0 + seed)
    wrench, solution = solve(CONFIG, weights, state, horizon, 1)
    assert solution.status == Status.SOLVED
    exact, _ = exact_solution(sparse_problem(weights, state, horizon))
    u = exact[12 * N :].reshape(N, 12)
    np.testing.assert_allclose(pack_wrench(wrench), u[0], atol=1e-5)
    np.testing.assert_allclose(inputs(horizon, solution.x), u, atol=1e-4)
    least = cost(weights, state, horizon, u)
    assert cost(weights, state, horizon, inputs(horizon, solution.x)) == pytest.approx(least)


def test_every_constraint_holds_and_each_kind_binds_somewhere():
    bound = np.zeros(6, int)
    for seed in range(12):
        state, horizon = problem(seed, push=4.0)
        if seed == 0:  # a hard landing asks for more than the greatest force
            state = state._replace(velocity=state.velocity.at[2].set(-3.0))
        _, solution = solve(CONFIG, random_weights(seed), state, horizon, 1)
        assert solution.status == Status.SOLVED
        for k, u in enumerate(inputs(horizon, solution.x).reshape(N, 2, 2, 3)):
            foot = int(np.argmax(horizon.contact[k]))
            assert not u[:, 1 - foot].any()
            R = np.asarray(rot_z(horizon.foot_yaw[k, foot]))
            force, moment, side = u[0, foot], R.T @ u[1, foot], R[:, 1] @ u[0, foot]
            toe, heel, mu = ROBOT.toe, ROBOT.heel, CONFIG.friction
            grip = mu * np.abs(R[:2, 1]).max()
            at_toe = (heel * force[2] - moment[1]) / (toe + heel)
            at_heel = (toe * force[2] + moment[1]) / (toe + heel)
            across_toe = (heel * side + moment[2]) / (toe + heel)
            across_heel = (toe * side - moment[2]) / (toe + heel)
            assert moment[0] == pytest.approx(0.0, abs=1e-12)
            room = [
                mu * force[2] - abs(force[0]) - abs(force[1]),
                CONFIG.max_force - force[2],
                at_toe,
                at_heel,
                grip * at_toe - abs(across_toe),
                grip * at_heel - abs(across_heel),
            ]
            assert min(room) > -1e-5
            assert force[2] > -1e-5
            bound += (np.array(room) < 1e-5) & (force[2] > 1.0)
    assert (bound > 0).all(), bound


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


def test_line_friction_can_be_left_to_the_pyramid():
    config = MpcConfig(line_friction=False)
    state, horizon = problem(5, push=4.0)
    qp, _ = write(config, nominal(), state, horizon, 1)
    full, _ = write(CONFIG, nominal(), state, horizon, 1)
    assert qp.A.shape == (N, 7, 5)
    assert full.A.shape == (N, 11, 5)
    np.testing.assert_array_equal(full.A[:, :7], qp.A)


def velocities(state, horizon, u):
    """Velocity at the end of each step (N, 3) under the inputs u (N, 12)."""
    A, B = linearise(horizon.euler, horizon.lever)
    x, found = np.asarray(pack_state(state, jnp.asarray(ROBOT.gravity))), []
    for k in range(N):
        x = np.asarray(A[k]) @ x + np.asarray(B[k]) @ u[k]
        found.append(x[9:12])
    return np.array(found)


def test_a_plan_obeys_an_input_and_a_state_constraint_of_ones_own():
    state, horizon = problem(3, push=2.0)
    state = state._replace(velocity=state.velocity.at[2].set(-0.3))

    def planned(config):
        _, solution = solve(config, expert(), state, horizon, 1)
        assert solution.status == Status.SOLVED
        u = inputs(horizon, solution.x)
        twist = np.abs(u[:, 6:].reshape(N, 2, 3)[..., 2]).max()
        return twist, velocities(state, horizon, u)[:, 2].min()

    twist, fall = planned(CONFIG)
    assert twist > 0.0 > fall

    def gentle(contact):
        return Rows(contact.moment[2:], -0.5 * twist, 0.5 * twist)

    def slow(step):
        return Rows(step.state.velocity[2:], 0.5 * fall, np.inf)

    own = InputConstraint("gentle", of=gentle), StateConstraint("slow", of=slow)
    less, slower = planned(MpcConfig(constraints=(*CONFIG.constraints, *own)))
    assert less <= 0.5 * twist + 1e-6
    assert slower >= 0.5 * fall - 1e-6


def test_the_first_pose_which_no_input_moves_can_be_left_unbounded():
    """A body that is measured below its lowest height rises to it from the second step on."""
    state, horizon = problem(3, push=2.0)
    state = state._replace(velocity=state.velocity.at[2].set(0.0))
    low = float(state.position[2]) + 0.002  # [m]

    def status(first):
        def high(step):
            bound = jnp.where(step.number == 0, first, low)
            return Rows(step.state.position[2:], bound, jnp.inf)

        constraints = (*CONFIG.constraints, StateConstraint(f"high {first}", of=high))
        config = MpcConfig(constraints=constraints, max_force=2000.0)
        return solve(config, expert(), state, horizon, 1)[1].status

    assert status(low) == Status.INFEASIBLE
    assert status(-np.inf) == Status.SOLVED


def test_costs_of_ones_own_are_added_to_those_of_the_weights():
    def place(step):
        return Squares(step.state.position, step.reference.position, 70.0)

    def load(contact):
        return Squares(contact.force[2:], 0.0, 2e-4)

    own = StateCost("place", of=place), InputCost("load", of=load)
    base, (state, horizon) = expert(), problem(3, push=2.0)
    heavy = base._replace(
        Q=base.Q._replace(position=base.Q.position + 70.0),
        R=base.R._replace(force=base.R.force + np.array([0.0, 0.0, 2e-4])),
    )
    for max_contacts in (1, 2):
        expected, _ = solve(CONFIG, heavy, state, horizon, max_contacts)
        config = replace(CONFIG, costs=own)
        got, solution = solve(config, base, state, horizon, max_contacts)
        np.testing.assert_allclose(pack_wrench(got), pack_wrench(expected), atol=1e-6)
        assert solution.status == Status.SOLVED
    plain, _ = solve(CONFIG, base, state, horizon, 1)
    assert np.abs(pack_wrench(plain) - pack_wrench(expected)).max() > 0.1


def test_a_cost_on_forces_about_the_weight_is_that_of_the_effort_reference():
    prices = np.array([1e-4, 2e-4, 5e-4])

    def carry(contact):
        return Squares(contact.force, jnp.array([0.0, 0.0, WEIGHT]), prices)

    state, horizon = problem(3, push=2.0)
    own = replace(CONFIG, costs=(InputCost("carry", of=carry),))
    about_weight = replace(CONFIG, effort_reference="gravity")
    base = expert()
    moments = base._replace(R=base.R._replace(force=0.0 * base.R.force))
    forces = base._replace(R=base.R._replace(force=0.0 * base.R.force + prices))
    for contacts in (1, 2):  # one foot stands at a time
        got = write(own, moments, state, horizon, contacts)[0]
        expected = write(about_weight, forces, state, horizon, contacts)[0]
        np.testing.assert_allclose(got.P, expected.P, atol=1e-12 * np.abs(expected.P).max())
        feet = np.abs(np.asarray(expected.q)) > 0.0  # the others have no foot and no reference
        np.testing.assert_allclose(got.q[feet], expected.q[feet], rtol=1e-9)
        assert not np.asarray(got.q)[~feet].any()


def test_no_constraints_are_those_of_the_contact_model_and_names_become_values():
    assert MpcConfig(constraints=()) == CONFIG
    assert MpcConfig(contact="line", constraints=("friction",)).constraints == (FRICTION,)
    assert CONFIG == MpcConfig(contact="line")
    with pytest.raises(InputError, match="did you mean 'friction'"):
        from_table("robot.toml", MpcConfig, {"constraints": ["frictoin"]})


def test_constraints_are_chosen_by_name_in_files():
    names = ["friction", "unilateral_force", "line_pressure", "line_friction"]
    table = {"contact": "line", "constraints": names}
    assert from_table("robot.toml", MpcConfig, table) == CONFIG
    assert from_table("config.json", MpcConfig, to_table(CONFIG)) == CONFIG
    assert pickle.loads(pickle.dumps(CONFIG)) == CONFIG
    assert [str(one) for one in MpcConfig(line_friction=False).on("inputs")] == names[:3]
    assert replace(MpcConfig(line_friction=False), line_friction=True) == MpcConfig()
    for wrong in ({"constraints": ["frictoin"]}, {"contact": "round"}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            from_table("robot.toml", MpcConfig, wrong)


def test_room_for_two_feet_changes_nothing_while_one_stands():
    state, horizon = problem(3, push=2.0)
    one, _ = solve(CONFIG, expert(), state, horizon, 1)
    two, solution = solve(CONFIG, expert(), state, horizon, 2)
    np.testing.assert_allclose(pack_wrench(two), pack_wrench(one), atol=1e-6)
    empty = np.asarray(solution.x).reshape(N, 2, 5)[~np.asarray(horizon.contact)]
    np.testing.assert_allclose(empty, 0.0, atol=1e-9)
    assert not np.asarray(one.force[1]).any()  # of the foot in the air
    assert not np.asarray(one.moment[1]).any()


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


def test_standing_feet_share_the_weight():
    state, horizon = standing()
    wrench, _ = solve(CONFIG, expert(), state, horizon, 2)
    np.testing.assert_allclose(wrench.force[0], wrench.force[1], atol=1e-6)
    # effort is priced and the horizon ends: near the weight only
    assert wrench.force[:, 2].sum() == pytest.approx(WEIGHT, rel=0.15)
    np.testing.assert_allclose(wrench.force[:, :2], 0.0, atol=1e-6)


def test_effort_about_the_weight_stands_with_exactly_the_weight():
    state, horizon = standing()
    config = MpcConfig(effort_reference="gravity")
    wrench, _ = solve(config, expert(), state, horizon, 2)
    np.testing.assert_allclose(wrench.force, [[0.0, 0.0, WEIGHT / 2]] * 2, atol=1e-6)
    np.testing.assert_allclose(wrench.moment, 0.0, atol=1e-6)


def test_effort_about_the_weight_is_all_of_it_on_one_foot():
    state, horizon = standing()
    horizon = horizon._replace(contact=jnp.asarray(BOTH).at[:, 1].set(False))
    dear = expert()._replace(R=jax.tree.map(lambda r: 1e9 * r, expert().R))
    wrench, _ = solve(MpcConfig(effort_reference="gravity"), dear, state, horizon, 1)
    np.testing.assert_allclose(wrench.force, [[0.0, 0.0, WEIGHT], [0.0] * 3], atol=1e-3)


def test_only_the_ratio_of_weights_matters():
    state, horizon = problem(6, push=2.0)
    one, _ = solve(CONFIG, expert(), state, horizon, 1)
    tenfold = jax.tree.map(lambda w: 10.0 * w, expert())
    other, _ = solve(CONFIG, tenfold, state, horizon, 1)
    np.testing.assert_allclose(pack_wrench(other), pack_wrench(one), atol=1e-6)


@pytest.mark.parametrize("push", [0.5, 4.0])
def test_a_mirrored_problem_has_the_mirrored_answer(push):
    def mirrored(s):
        return State(s.euler * TURN, s.position * FLIP, s.ang_velocity * TURN, s.velocity * FLIP)

    state, horizon = problem(7, push)
    weights = random_weights(7)
    other = Horizon(
        mirrored(horizon.reference),
        horizon.euler * TURN,
        horizon.lever[:, ::-1] * FLIP,
        -horizon.foot_yaw[:, ::-1],
        horizon.contact[:, ::-1],
    )
    swapped = weights._replace(R=Wrench(*(w[::-1] for w in weights.R)))
    one, _ = solve(CONFIG, weights, state, horizon, 1)
    two, _ = solve(CONFIG, swapped, mirrored(state), other, 1)
    np.testing.assert_allclose(two.force, one.force[::-1] * FLIP, atol=1e-6)
    np.testing.assert_allclose(two.moment, one.moment[::-1] * TURN, atol=1e-6)


def test_a_yawed_problem_has_the_yawed_answer():
    # Nominal weights know no direction; the friction pyramid does, so that it must not bind.
    config = MpcConfig(friction=5.0)
    state, horizon = problem(8, push=0.5)
    R = rot_z(jnp.array(0.9))

    def turned(s):
        return State(s.euler + jnp.array([0.0, 0.0, 0.9]), *(v @ R.T for v in s[1:]))

    other = Horizon(
        turned(horizon.reference),
        horizon.euler + jnp.array([0.0, 0.0, 0.9]),
        horizon.lever @ R.T,
        horizon.foot_yaw + 0.9,
        horizon.contact,
    )
    one, _ = solve(config, nominal(), state, horizon, 1)
    two, _ = solve(config, nominal(), turned(state), other, 1)
    np.testing.assert_allclose(two.force, one.force @ R.T, atol=1e-6)
    np.testing.assert_allclose(two.moment, one.moment @ R.T, atol=1e-6)


def test_a_batch_is_a_loop():
    cases = [problem(seed, push=2.0) for seed in range(3)]
    stacked = jax.tree.map(lambda *rows: jnp.stack(rows), *cases)
    batch = jax.vmap(lambda s, h: solve(CONFIG, expert(), s, h, 1)[0])(*stacked)
    for i, (state, horizon) in enumerate(cases):
        one, _ = solve(CONFIG, expert(), state, horizon, 1)
        np.testing.assert_allclose(batch.force[i], one.force, atol=1e-7)


@pytest.mark.parametrize(("contacts", "stance"), [(1, None), (2, None), (2, BOTH)])
@pytest.mark.parametrize("about", ["zero", "gravity"])
def test_the_slope_without_the_matrix_is_that_of_the_qp(contacts, stance, about):
    """P v + q, at any inputs; with one foot on the ground where there is room for two as well."""
    state, horizon = problem(5, contact=stance)
    lacking = Disturbance(np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -1.0]))
    config, weights = MpcConfig(effort_reference=about), random_weights(5)
    qp, condensed = answer(config, weights, state, horizon, contacts, lacking)[1]
    asked = MpcProblem(ROBOT, config.parameters(weights), state, horizon, lacking)
    for v in np.random.default_rng(0).normal(size=(3, N * 5 * contacts)) * 30.0:
        half = half_slope(CONFIG, asked, condensed, jnp.asarray(v.reshape(N, -1)))
        expected = qp.P @ v + qp.q
        np.testing.assert_allclose(
            2 * half.ravel(), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max()
        )


@pytest.mark.parametrize("contacts", [1, 2])
def test_the_derivative_without_the_matrix_is_that_of_the_qp(contacts):
    """In the weights, the state and the levers, of all inputs at once, in both modes."""
    state, horizon = problem(6, push=2.0, contact=None if contacts == 1 else BOTH)
    what = {"dt": DT, "max_contacts": contacts}

    def asked(logs, shift, lever):
        weights = vector_to_weights(weights_to_vector(expert()) * jnp.exp(logs))
        moved = state._replace(position=state.position + shift)
        level = horizon._replace(lever=horizon.lever + lever)
        return MpcProblem(ROBOT, CONFIG.parameters(weights), moved, level, NO_DISTURBANCE)

    def with_slope(*at):
        return solve_mpc(CONFIG, asked(*at), **what)[1].x

    def with_matrix(*at):
        return solve_qp(build_qp(CONFIG, asked(*at), **what)[0], CONFIG.qp).x

    at = jnp.zeros(24), jnp.zeros(3), jnp.zeros(3)
    rng = np.random.default_rng(0)
    along = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in at)
    pull = jnp.asarray(rng.normal(size=N * 5 * contacts))
    forward, reverse = [], []
    for function in (with_slope, with_matrix):
        forward.append(jax.jit(lambda f=function: jax.jvp(f, at, along))())
        reverse.append(jax.jit(lambda f=function: jax.vjp(f, *at)[1](pull))())
    np.testing.assert_array_equal(forward[0][0], forward[1][0])
    size = np.abs(forward[1][1]).max()
    assert size > 0.1
    np.testing.assert_allclose(forward[0][1], forward[1][1], atol=1e-8 * size)
    for one, other in zip(*reverse, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8 * np.abs(other).max())
    both = sum(float(jnp.vdot(g, d)) for g, d in zip(reverse[0], along, strict=True))
    assert both == pytest.approx(float(pull @ forward[0][1]), rel=1e-8)


def test_u_is_packed_forces_first():
    state, horizon = problem(3)
    _, condensed = write(CONFIG, expert(), state, horizon, 1)
    wrench = unpack_wrench(condensed.inputs[0] @ jnp.array([1.0, 2.0, 3.0, 0.0, 5.0]))
    np.testing.assert_allclose(wrench.force, [[1, 2, 3], [0, 0, 0]])
    np.testing.assert_allclose(wrench.moment, [[0, 0, 5], [0, 0, 0]])


@pytest.mark.parametrize(
    "wrong", [{"horizon": 0}, {"step_ticks": 0}, {"effort_reference": "something"}]
)
def test_impossible_problems_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        MpcConfig(**wrong)
