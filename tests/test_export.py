"""What goes to the robot: weights, the C++ controller's own QP, the controller in C."""

import contextlib
import ctypes
import io
import json
import os
import re
import runpy
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jsonschema
import mujoco
import numpy as np
import pytest
from compiled import CONFIG, TUNED, WARNINGS, assert_same, needs_cc, source_of
from model import OTHERS, ROBOT, random_weights
from oracles import exact_solution
from pretend import call, instead, refused
from scipy.spatial.transform import Rotation

from benchmarks.problems import draw_problems, layer_qp, pick
from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table
from hector_jax.control.contact import (
    LINE_FRICTION,
    InputConstraint,
    StateCost,
)
from hector_jax.control.gait import GaitConfig
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, solve_mpc
from hector_jax.control.parameters import TUNABLES, Q, R
from hector_jax.control.reference import Command, named_command
from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.console import Broken
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import to_table
from hector_jax.core.trajectory import State, pack_wrench
from hector_jax.export import check, export
from hector_jax.export.check import (
    Inputs,
    Library,
    compare_with_live,
    compile_controller,
    inputs_of,
)
from hector_jax.export.export import SCHEMA, weights_cpp
from hector_jax.export.template import fill_template
from hector_jax.qp import QP, Status, solve_qp
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import ideal
from hector_jax.store.cache import robot_hash
from hector_jax.store.run import Run

pytestmark = pytest.mark.usefixtures("on_cpu")
HERE = Path(__file__).parent
BAD_INPUT, OUT_OF_BOUNDS = 6, 7  # of enum controller_status
EXAMPLES = HERE.parent / "examples" / "exported"
# The open C++ controller


def pasted(text, name):
    """The twelve numbers of `double name[12] = {...};`."""
    inside = re.search(rf"double {name}\[12\] = \{{(.*?)\}};", text, re.DOTALL).group(1)
    return np.array([float(x) for x in re.sub(r"//.*", "", inside).split(",") if x.strip()])


def their_qp(Q, Alpha, state, lever, foot_yaw, reference, contact, dt, mass, inertia):
    """Its QP, written down from what its SolverMPC.cpp does, with the robot and dt given.

    States rpy, p, omega, v, 9.81; inputs F_0, F_1, M_0, M_1; A and B frozen, powers of A, H and g
    with their 2; rows friction (mu 2.0), M_x, two of the line foot, 2 F_z <= 1000; a foot in the
    air has no variables. Three things are as here, and the header says so: M_x may be up to
    0.01 N m there, foot 1 has one line row twice, and F_x and F_y are bounded each by itself.
    """
    N = len(contact)
    roll, pitch, yaw = state.euler
    R_wb = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    A, B = np.zeros((13, 13)), np.zeros((13, 12))
    rates = [[np.cos(yaw) * np.cos(pitch), -np.sin(yaw), 0], [0, np.cos(yaw), 0], [0, 0, 1]]
    rates[1][0], rates[2][0] = np.sin(yaw) * np.cos(pitch), -np.sin(pitch)
    A[0:3, 6:9] = np.linalg.inv(rates)
    A[3:6, 9:12] = np.eye(3)
    A[11, 12] = -1.0
    turn = np.linalg.inv(R_wb @ inertia @ R_wb.T)
    for foot in (0, 1):
        B[6:9, 3 * foot : 3 * foot + 3] = turn @ np.cross(lever[foot], np.eye(3)).T
        B[6:9, 6 + 3 * foot : 9 + 3 * foot] = turn
        B[9:12, 3 * foot : 3 * foot + 3] = np.eye(3) / mass
    A, B = np.eye(13) + dt * A, dt * B
    powers = [np.linalg.matrix_power(A, i) for i in range(N + 1)]
    A_qp = np.vstack(powers[1:])
    B_qp = np.block([[powers[i - j] @ B if i >= j else 0 * B for j in range(N)] for i in range(N)])
    S = np.diag(np.tile(np.append(Q, 0.0), N))
    x_0 = np.concatenate([*state, [9.81]])
    X_d = np.concatenate([np.append(row, 0.0) for row in np.concatenate(reference, axis=1)])
    H = 2.0 * (B_qp.T @ S @ B_qp + np.diag(np.tile(Alpha, N)))
    g = 2.0 * B_qp.T @ S @ (A_qp @ x_0 - X_d)

    mu, lt, lh, big = 2.0, 0.09, 0.06, 5e10
    F, below, above = np.zeros((16, 12)), np.zeros(16), np.zeros(16)
    for foot in (0, 1):
        f, m, row = 3 * foot, 6 + 3 * foot, 8 * foot
        yaw = foot_yaw[foot]
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        left = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        F[row : row + 4, f + 2] = 1.0
        F[row : row + 4, f : f + 2] = [[-mu, -mu], [mu, mu], [mu, -mu], [-mu, mu]]
        F[row + 4, m : m + 3] = ahead
        F[row + 5, f + 2], F[row + 5, m : m + 3] = -lt, left
        F[row + 6, f + 2], F[row + 6, m : m + 3] = -lh, -left
        F[row + 7, f + 2] = 2.0
        below[row : row + 8] = [0, 0, 0, 0, 0, -big, -big, 0]
        above[row : row + 8] = [big, big, big, big, 0, 0, 0, 1000.0]
    stands = np.concatenate([np.tile(np.repeat(feet, 3), 2) for feet in contact])
    rows = np.concatenate([np.repeat(feet, 8) for feet in contact])
    full = QP(H, g, np.kron(np.eye(N), F), np.tile(below, N), np.tile(above, N))
    P, A = full.P[np.ix_(stands, stands)], full.A[np.ix_(rows, stands)]
    return QP(P, full.q[stands], A, full.l[rows], full.u[rows]), stands


def same_problem(seed):
    """A state, and a horizon about it as the C++ controller has it: nothing moves along."""
    rng = np.random.default_rng(seed)
    N, dt = CONFIG.mpc.horizon, CONFIG.mpc_step
    euler = np.array([0.05, -0.08, 0.6]) + 0.03 * rng.normal(size=3)
    state = State(euler, np.array([0.3, 0.1, 0.41]), *(0.2 * rng.normal(size=(2, 3))))
    lever = np.array([[0.02, 0.08, -0.41], [-0.03, -0.08, -0.41]]) + 0.02 * rng.normal(size=(2, 3))
    foot_yaw = 0.6 + 0.1 * rng.normal(size=2)
    steps = dt * np.arange(1, N + 1)[:, None]
    reference = State(
        np.tile([0.0, 0.0, 0.6], (N, 1)),
        state.position + steps * np.array([0.4, 0.2, 0.0]),
        np.zeros((N, 3)),
        np.tile([0.4, 0.2, 0.0], (N, 1)),
    )
    left = (np.arange(N) + 5 * seed) // 5 % 2 == 0
    contact = np.stack([left, ~left], axis=1)
    return state, lever, foot_yaw, reference, contact


# toe and heel have changed places in their rows, and theirs hold by no friction each
THEIRS = replace(CONFIG.mpc, line_friction=False, friction=0.5)
SWAPPED = ROBOT._replace(toe=np.array(0.06), heel=np.array(0.09), gravity=np.array([0, 0, 9.81]))
solve = jax.jit(solve_mpc, static_argnames=("config", "dt", "max_contacts"))


@pytest.mark.parametrize("seed", range(6))
def test_the_cpp_controller_finds_our_wrench_with_the_pasted_weights(seed):
    weights, (state, lever, foot_yaw, reference, contact) = random_weights(seed), same_problem(seed)
    N, dt = CONFIG.mpc.horizon, CONFIG.mpc_step
    text = weights_cpp(weights, CONFIG, ROBOT, name="random")
    known = (state, lever, foot_yaw, reference, contact, dt, ROBOT.mass, ROBOT.inertia)
    qp, stands = their_qp(pasted(text, "Q"), pasted(text, "Alpha"), *known)
    theirs = np.zeros(12 * N)
    theirs[stands] = exact_solution(qp)[0]
    still = [np.tile(x, (N, *np.ones(np.ndim(x), int))) for x in (state.euler, lever, foot_yaw)]
    now, each = jax.tree.map(jnp.asarray, (state, Horizon(reference, *still, contact)))
    problem = MpcProblem(SWAPPED, THEIRS.parameters(weights), now, each)
    wrench, solution = solve(THEIRS, problem, dt=dt, max_contacts=1)
    assert solution.status == Status.SOLVED
    ours = np.asarray(pack_wrench(wrench))
    assert np.abs(ours).max() > 10.0
    np.testing.assert_allclose(ours, theirs[:12], atol=1e-7)
    assert seed or np.abs(np.asarray(solution.y)).max() > 1e-9  # a limit binds in the first


def test_the_header_has_our_numbers_and_says_what_the_cpp_controller_lacks():
    def header(weights=None, **mpc):
        config = replace(CONFIG, mpc=replace(CONFIG.mpc, **mpc))
        return weights_cpp(weights or nominal(), config, ROBOT, name="nominal")

    text = header()
    for fact in ("steps of 0.03 s, 10 of them", "F_z <= M_y <=", "friction at toe and heel: True"):
        assert fact in text
    assert "ATTENTION" not in text
    assert [line for line in text.splitlines() if line[:2] != "//"][0] == "double Q[12] = {"
    assert "ATTENTION" in header(effort_reference="gravity")
    told = "ATTENTION: tuned beside costs that the C++ controller has not: low."
    assert told in header(costs=(StateCost("low", of=None),))
    others = {"friction": np.array(0.4), "effort_reference": np.array(0.5)}
    tuned = header(nominal()._replace(others=others))
    assert "<= 0.4 F_z <= 200 N" in tuned
    assert tuned.count("ATTENTION") == 3
    without = tuple(c for c in MpcConfig().constraints if c != LINE_FRICTION)
    assert "friction at toe and heel: False" in header(constraints=without)


# The controller in C


def save_run(folder):
    """A finished run, as far as export reads it."""
    save_weights(folder / "weights" / "best.json", TUNED)
    config = {
        "flags": as_table(Tune()),
        "robot": robot_hash(load_robot()),
        "tune": {"rollout": {"walk": to_table(CONFIG)}},
    }
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """What the command printed for such a run, and the folder that it wrote."""
    needs_cc()
    run, printed = save_run(tmp_path_factory.mktemp("run")), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        assert call(patch, "export", run, "--seconds", "0.1", "--json") == 0
    return json.loads(printed.getvalue()), run / "export"


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The compiled controller of the tuned weights."""
    needs_cc()
    return compile_controller(source_of(TUNED), tmp_path_factory.mktemp("c"), *WARNINGS)


def answers(library, inputs, before=lambda i, compiled: None):
    """The outputs along the inputs; `before` is called before each."""
    compiled, out = Library(library), np.zeros(len(inputs.estimate), check.layout_of(ROBOT).output)
    for i in range(len(out)):
        before(i, compiled)
        compiled.step(inputs, out, i)
    return out


def walk_of(command, seconds, weights=TUNED):
    return check.record(CONFIG, ROBOT, Job(weights, command, ideal(), seconds))


@pytest.fixture(scope="module")
def walked():
    return walk_of(named_command("s"), 0.4)


def test_the_compiled_controller_answers_as_the_live_one_did(library, walked):
    assert_same(compare_with_live(CONFIG, ROBOT, library, walked))
    assert np.abs(walked.wrench.force).max() > 100.0 * walked.measurement.state.velocity[-1, 0] > 10


def test_measured_yaw_and_anchor_may_be_of_any_turn(library):
    command = Command(np.full(2, 4.0), np.array([[0.2, 0.0]] * 2), np.full(2, 0.5 * np.pi))
    walked = walk_of(command, 2.4)
    state = walked.measurement.state
    yaw = state.euler[:, 2]
    assert abs(yaw[-1]) > 3.3
    within_pi = np.pi - np.mod(np.pi - yaw, 2 * np.pi)
    any_turn = yaw + 2 * np.pi * np.random.default_rng(0).integers(-3, 4, len(yaw))
    for seen, turns in ((within_pi, (0, 0)), (any_turn, (0, 0)), (within_pi, (-1, 2))):
        euler = np.column_stack([state.euler[:, :2], seen])
        measurement = walked.measurement._replace(state=state._replace(euler=euler))
        standing, anchor = (
            known._replace(yaw=np.asarray(known.yaw + 2 * np.pi * turn))
            for known, turn in zip((walked.standing, walked.anchor), turns, strict=True)
        )
        again = walked._replace(measurement=measurement, standing=standing, anchor=anchor)
        assert_same(compare_with_live(CONFIG, ROBOT, library, again))


def test_what_is_no_number_has_a_status_and_the_torques_of_the_call_before(library, walked):
    """Also in the millisecond of a plan, which is then made in the next."""
    inputs, lost = inputs_of(walked, ROBOT), [3, 500, 501]
    inputs.estimate["euler"][500, 2] = np.nan
    inputs.estimate["joints"][3, 0], inputs.estimate["position"][501, 1] = np.inf, -np.inf
    out = answers(library, inputs)
    assert np.flatnonzero(out["status"] == BAD_INPUT).tolist() == lost
    np.testing.assert_array_equal(out["torque"][500:502], out["torque"][[499, 499]])
    np.testing.assert_array_equal(out["force"][500:502], out["force"][[499, 499]])
    assert np.abs(out["force"][502] - out["force"][499]).max() > 1e-6  # planned
    np.testing.assert_allclose(out["torque"][502:], walked.torque[502:], atol=1.0)
    assert out["age"][[499, 501, 502, 510]].tolist() == [9, 11, 2, 0]


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("command", "duration", 6.9e-310),  # what memory that nobody filled in holds
        ("command", "duration", 1e7),
        ("command", "velocity", 1e308),
        ("command", "velocity", 10.1),
        ("command", "yaw_rate", -10.1),
        ("anchor", "position", np.nan),
        ("anchor", "position", 1e100),
        ("anchor", "yaw", 6e15),
        ("anchor", "tick", -(2**63)),
        ("estimate", "joint_rates", np.inf),
        ("estimate", "joint_rates", 1e308),
        ("estimate", "velocity", 1e307),
        ("estimate", "euler", 1e20),  # a yaw next to which no other can be told
        ("command", "pieces", 0),
        ("command", "pieces", 17),
        ("command", "duration", 0.0),
        ("command", "yaw_rate", np.nan),
    ],
)
def test_refused_calls_between_change_nothing(library, walked, part, name, value):
    """No bit of the memory, so that the walk is the same to the last one."""
    inputs = inputs_of(walked, ROBOT)
    inputs = inputs._replace(estimate=inputs.estimate[:1300], anchor=inputs.anchor[:1300])
    wrong, out = Inputs(*map(np.copy, inputs)), np.zeros(1300, check.layout_of(ROBOT).output)
    getattr(wrong, part)[name][:] = value

    def refuse(i, compiled):
        if i % 13 == 0:
            memory = compiled.memory.raw
            compiled.step(wrong, out, i)
            assert out["status"][i] == BAD_INPUT
            assert compiled.memory.raw == memory

    np.testing.assert_array_equal(answers(library, inputs, refuse), answers(library, inputs))
    assert not out["torque"][0].any()  # before the first good call


@pytest.mark.parametrize("flag", ["-ffast-math", "-Ofast"])
def test_a_compiler_that_takes_no_number_for_nan_is_refused(flag, tmp_path):
    needs_cc()
    with pytest.raises(Broken, match="remove the checks for NaN"):
        compile_controller(source_of(TUNED), tmp_path, flag)


OWN_Q = """#include "controller.h"
double WHOSE(void) {
    static struct controller c;
    controller_init(&c);
    return c.next.Q[0] == controller_exported.Q[0] ? c.next.Q[0] : -1.0;
}
"""
BOTH = """#include <stdio.h>
double a(void), b(void);
int main(void) { return printf("%.17g %.17g", a(), b()) < 0; }
"""


@pytest.mark.parametrize("shared", [False, True])
def test_two_exports_in_one_program_keep_their_numbers(tmp_path, shared):
    needs_cc()
    both = {"a": TUNED, "b": CONFIG.with_others(nominal(), OTHERS)}
    (tmp_path / "main.c").write_text(BOTH)
    linked = []
    for name, weights in both.items():
        folder = tmp_path / name
        for file, text in {**source_of(weights), "own.c": OWN_Q}.items():
            write_file(folder / file, text.encode())
        words = f"cc -std=c99 -fPIC -DWHOSE={name}"
        if shared:
            linked.append(f"{name}/own.so")
            words += " -shared own.c controller.c -lm -o own.so"
        else:
            linked += [f"{name}/own.o", f"{name}/controller.o"]
            words += " -c own.c controller.c"
        subprocess.run(words.split(), cwd=folder, check=True)
    words = ["cc", "main.c", *linked, "-Wl,-rpath,.", "-lm", "-o", "main"]
    subprocess.run(words, cwd=tmp_path, check=True)
    said = subprocess.run(["./main"], cwd=tmp_path, capture_output=True, text=True, check=True)
    found = [float(x) for x in said.stdout.split()]
    assert found == [float(weights.Q.euler[0]) for weights in both.values()]


def test_a_program_in_cpp_links_with_the_controller(library):
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler")
    code = """#include "controller.h"
    static controller c;
    int main() { controller_init(&c); return controller_exported.Q[0] <= 0.0; }
    """
    (library.parent / "use.cpp").write_text(code)
    words = "c++ use.cpp controller.so -Wl,-rpath,. -o use".split()
    subprocess.run(words, cwd=library.parent, check=True)
    assert subprocess.run(["./use"], cwd=library.parent).returncode == 0


def exported_numbers(functions):
    """A copy of the struct of tunables: Q, R, scalars, kp and kd."""
    kind = ctypes.c_double * (24 + len(TUNABLES) - 2 + 10)
    return kind(*kind.in_dll(functions, "controller_exported"))


def test_other_weights_count_from_the_next_plan_on(library, walked, tmp_path):
    second = compile_controller(source_of(CONFIG.with_others(nominal(), OTHERS)), tmp_path)
    numbers = exported_numbers(ctypes.CDLL(str(second)))

    def change(i, compiled):
        if i == 503:
            assert compiled.functions.controller_set_tunables(compiled.memory, numbers) == 0

    inputs = inputs_of(walked, ROBOT)
    changed, before = answers(library, inputs, change), answers(library, inputs)
    after = answers(second, inputs)  # whose memory is the same: both have no integral action
    np.testing.assert_array_equal(changed[:510], before[:510])
    for name in ("torque", "force", "moment"):
        np.testing.assert_allclose(changed[name][510:], after[name][510:], atol=1e-6)
        assert np.abs(changed[name][510:] - before[name][510:]).max() > 1e-2


@pytest.mark.parametrize("value", [0.0, -1.0, 1e13, np.nan, np.inf])
def test_weights_out_of_bounds_are_refused_and_change_nothing(library, walked, value):
    def change(i, compiled):
        if i == 3:
            numbers = exported_numbers(compiled.functions)
            numbers[4] = value
            found = compiled.functions.controller_set_tunables(compiled.memory, numbers)
            assert found == OUT_OF_BOUNDS

    inputs = inputs_of(walked, ROBOT)
    inputs = inputs._replace(estimate=inputs.estimate[:30], anchor=inputs.anchor[:30])
    np.testing.assert_array_equal(answers(library, inputs, change), answers(library, inputs))


def test_other_weights_are_bounded_by_the_boxes_of_the_tuner(library):
    functions, parameters = ctypes.CDLL(str(library)), CONFIG.parameters(TUNED)
    boxes = [*[Q] * 12, *[R] * 12]
    for tunable in TUNABLES.values():
        boxes += [tunable] * np.size(tunable.read(parameters))
    exported = list(exported_numbers(functions))
    for end, further in (("lower", np.minimum), ("upper", np.maximum)):
        found = (ctypes.c_double * len(boxes)).in_dll(functions, f"controller_{end}")
        assert list(found) == further([getattr(box, end) for box in boxes], exported).tolist()


@pytest.fixture(scope="module")
def solve_in_c(library):
    """The C program's solution of a QP of one contact a step: x, its residual and status."""
    words = "cc -std=c99 -O2 -fPIC -shared -o qp.so -lm -I.".split()
    subprocess.run([*words, HERE / "exported_qp.c"], cwd=library.parent, check=True)
    drawn = ctypes.CDLL(str(library.parent / "qp.so")).drawn

    def solve(qp):
        P, q, A, low, high = qp
        low, high = (bound.reshape(A.shape[:2]) for bound in (low, high))
        both = [
            (s * A[:, i], s * b[:, i]) for i in range(A.shape[1]) for s, b in ((1, high), (-1, low))
        ]
        sides, bounds = zip(*[side for side in both if np.abs(side[1]).max() < 1e20], strict=True)
        x, residual = np.zeros(len(q)), np.zeros(1)
        arrays = (P, q, np.stack(sides, axis=1), np.stack(bounds, axis=1))
        at = [np.ascontiguousarray(array) for array in arrays]
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (*at, x, residual)]
        status = drawn(*pointers[:4], len(A), *pointers[4:])
        return x, residual[0], status

    return solve


qp_of = jax.jit(partial(layer_qp, CONFIG, ROBOT))
solved = jax.jit(solve_qp)


def assert_same_solution(solve_in_c, qp):
    ours = solved(qp)
    x, residual, status = solve_in_c(qp)
    assert status == ours.status
    assert (residual <= 1e-8) == (status in (Status.SOLVED, Status.NOT_UNIQUE))
    if status == Status.SOLVED:
        column = np.sqrt(np.diag(qp.P))
        condition = np.linalg.cond(qp.P / column / column[:, None])
        size = max(np.abs(column * ours.x).max(), 1e-6 * np.abs(qp.q / column).max())
        assert condition > 1e6 or np.abs(column * (x - ours.x)).max() <= 1e-8 * size


@pytest.mark.parametrize("count", [60, pytest.param(2000, marks=pytest.mark.slow)])
def test_the_qp_in_c_has_our_solution_and_status(solve_in_c, count):
    problems = draw_problems(CONFIG, ROBOT, count)
    for i in range(count):
        assert_same_solution(solve_in_c, QP(*map(np.asarray, qp_of(pick(problems, i)))))


def test_hard_qps_have_our_status_too(solve_in_c):
    """Flat, infeasible, bounds of zero, vertices with more rows than variables, no numbers."""
    problems, found = draw_problems(CONFIG, ROBOT, 12), []
    for i in range(12):
        qp = QP(*map(np.asarray, qp_of(pick(problems, i))))
        low = np.where(qp.u == 500.0, 1.0, qp.l)
        flat = np.eye(50)[5 * (i % 10) : 5 * (i % 10) + 2].sum(axis=0) / 2**0.5  # F_x = F_y
        level = np.eye(50) - np.outer(flat, flat)
        changes = (
            {"P": level @ qp.P @ level, "q": level @ qp.q},
            {"P": level @ qp.P @ level + 1e-10 * np.outer(flat, flat), "q": level @ qp.q},
            {"P": qp.P - np.diag(np.diag(qp.P))},
            {"u": np.where(qp.u == 500.0, -1.0, qp.u)},
            {"l": low, "u": np.where(qp.u == 500.0, 1.0, qp.u)},
            {"q": 100.0 * np.abs(qp.q)},
            {"q": np.zeros(50)},
            {"q": np.where(np.arange(50) == 7, np.nan, qp.q)},
        )
        for change in changes:
            hard = qp._replace(**change)
            assert_same_solution(solve_in_c, hard)
            found.append(int(solved(hard).status))
    assert set(found) == {Status.SOLVED, Status.NOT_UNIQUE, Status.INFEASIBLE, Status.BAD_DATA}


def test_the_library_allocates_nothing(library):
    listed = subprocess.run(["nm", "-u", library], capture_output=True, text=True).stdout
    assert not {"malloc", "calloc", "realloc", "free"} & set(re.findall(r"\w+", listed))
    assert "sincos" in listed or "sin" in listed


SANITIZERS = "-O1 -g -fsanitize=address,undefined -fno-sanitize-recover"
BUILDS = [("cc", SANITIZERS, []), ("aarch64-linux-gnu-gcc", "-O2 -static", ["qemu-aarch64"])]


@pytest.mark.slow
@pytest.mark.parametrize("build", BUILDS, ids=["sanitizers", "aarch64"])
def test_another_build_walks_as_the_first_does(walked, tmp_path, build):
    for program in (build[0], *build[2]):
        if shutil.which(program) is None:
            pytest.skip(f"there is no {program}")
    inputs, sums = inputs_of(walked, ROBOT), []
    inputs.estimate["euler"][700, 1], inputs.estimate["velocity"][800] = np.nan, 1e150
    compile_controller(source_of(TUNED), tmp_path)
    for file, part in inputs._asdict().items():
        part.tofile(tmp_path / file)
    for compiler, flags, runner in (("cc", "-O2", []), build):
        words = [compiler, "-std=c99", *flags.split(), HERE / "exported_walk.c", "controller.c"]
        subprocess.run([*words, "-I.", "-lm", "-o", "walk"], cwd=tmp_path, check=True)
        words = [*runner, "./walk", *inputs._fields]
        ran = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        assert (ran.returncode, ran.stderr) == (0, "")
        sums.append(float(ran.stdout))
    assert sums[1] == pytest.approx(sums[0], abs=1e-8)


def test_weights_that_fall_and_constraints_of_ones_own_are_refused():
    limp = TUNED._replace(Q=jax.tree.map(lambda w: 1e-6 * w, nominal().Q))
    with pytest.raises(ValueError, match="fall"):
        walk_of(named_command("straight"), 0.2, limp)
    own = MpcConfig(costs=(StateCost("low", of=None),))
    named_as_ours = (*CONFIG.mpc.constraints, InputConstraint("friction", of=lambda contact: None))
    for mpc, name in ((own, "low"), (MpcConfig(constraints=named_as_ours), "friction")):
        with pytest.raises(InputError, match=f"functions in Python.*has none: {name}; it has"):
            source_of(TUNED, replace(CONFIG, mpc=mpc))


# The command


@pytest.fixture
def run(tmp_path):
    return save_run(tmp_path)


def test_the_command_writes_files_that_run_without_us(capsys, exported):
    card, folder = exported
    files = "CMakeLists.txt check.npz controller.c controller.h controller.json ros2_control"
    names = [*files.split(), "weights.cpp", "weights.json", SCHEMA]
    assert sorted(path.name for path in folder.glob("[!.]*")) == names
    assert json.loads((folder / "controller.json").read_text()) == card
    assert card["check"]["force"] <= 1e-8
    assert 0.0 < card["check"]["hold_ms"]["p50"] < card["check"]["plan_ms"]["p50"]
    assert card["sha256"]["weights.json"] in (folder / "controller.h").read_text()
    schema = json.loads((folder / SCHEMA).read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(json.loads((folder / "weights.json").read_text()), schema)
    jax.tree.map(np.testing.assert_array_equal, load_weights(folder / "weights.json"), TUNED)
    runpy.run_path(str(EXAMPLES / "check.py"))["main"](folder)
    said = capsys.readouterr().out
    assert "1200 calls" in said
    assert float(re.search(r"difference (\S+) N m", said)[1]) <= 1e-8


def test_the_c_program_walks_the_robot_in_mujoco(exported, tmp_path):
    """As its comment compiles it: one and a half seconds, ahead and to the left."""
    code, home = (EXAMPLES / "walk.c").read_text(), Path(mujoco.__path__[0])
    if not list(home.glob("libmujoco.so*")):
        pytest.skip("this MuJoCo has no libmujoco.so")
    line = re.search(r"^ \*     (cc .*)$", code, re.MULTILINE)[1]
    for name, value in {"FOLDER": exported[1], "$M": home, "walk.c": EXAMPLES / "walk.c"}.items():
        line = line.replace(name, str(value))
    subprocess.run(line, shell=True, cwd=tmp_path, check=True)
    words = ["./walk", ROBOT.description.model, "1.5"]
    said = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    x, y, z, yaw, unsolved = map(float, re.findall(r"-?\d+(?:\.\d+)?", said))
    assert 0.3 < x < 0.6
    assert 0.0 < y < 0.4
    assert (z, yaw) == pytest.approx((ROBOT.standing_height, 0.75), abs=0.2)
    assert unsolved == 0


def no_compiler(patch):
    for module in (export, check):
        patch.setattr(module, "compiler", lambda: None)


def no_program(patch):
    """None may run, as in a temporary folder that is mounted so."""
    patch.setattr(os, "statvfs", lambda folder: SimpleNamespace(f_flag=os.ST_NOEXEC))


@pytest.mark.parametrize(
    ("lacks", "said"), [(no_compiler, "no C compiler (cc)"), (no_program, "(TMPDIR)")]
)
def test_files_are_written_where_nothing_is_compiled_or_run(monkeypatch, capsys, run, lacks, said):
    lacks(monkeypatch)
    assert call(monkeypatch, "export", run, "--seconds", "0.1") == 0
    assert f"{said}: the check of controller.c did not run" in capsys.readouterr().err
    assert json.loads((run / "export" / "controller.json").read_text())["check"] is None


def test_what_differs_from_the_live_controller_is_not_written(monkeypatch, capsys, run):
    instead(monkeypatch, export, "compile_controller", lambda *args, **named: None)
    for difference, fault in (({"force": 2e-6}, "2.0e-06 N"), ({"unsolved": 3}, "3 QPs were not")):
        found = check.Check(0.0, 0.0, 0.0, 0, {}, {})._replace(**difference)
        instead(monkeypatch, export, "compare_with_live", lambda *known, found=found: found)
        assert call(monkeypatch, "export", run, "--seconds", "0.1") == 1
        assert fault in capsys.readouterr().err
        assert list((run / "export").glob("[!.]*")) == []


def test_a_run_is_exported_with_its_own_controller(run):
    own = replace(CONFIG, gait=GaitConfig(stance=24, swing=16), mpc=MpcConfig(friction=0.4))
    kept = to_table(own)
    del kept["mpc"]["effort_reference"]  # of a run from before there was such a setting
    (run / "config.json").write_text(json.dumps({"tune": {"rollout": {"walk": kept}}}))
    assert Run(run).weights_file("best") == run / "weights" / "best.json"
    assert Run(run).controller == own


@pytest.mark.parametrize(
    ("flag", "word", "told"),
    [("--set", "bset", "did you mean 'best'"), ("--prefix", "1st", "must be a name in C")],
)
def test_what_is_refused_is_one_line_and_writes_nothing(monkeypatch, capsys, run, flag, word, told):
    assert told in refused(monkeypatch, capsys, "export", run, flag, word)
    assert not (run / "export").exists()


def filled(folder, text):
    (folder / "gains.j2").write_bytes(text.encode())
    return fill_template(folder / "gains.j2", nominal())


@pytest.mark.parametrize(
    "text", ["a\r\nb {{ Q.euler[0] }}\r\n", "a\nb {{ Q.euler[0] }}\n", "{{ Q.euler[0] }}"]
)
def test_a_filled_template_has_the_line_ends_of_its_file(tmp_path, text):
    number = str(float(nominal().Q.euler[0]))
    assert filled(tmp_path, text) == text.replace("{{ Q.euler[0] }}", number)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{{ 1/0 }}", "division by zero"),
        ("{{ Q. }}", "line 1: "),
        ("{{ Q.yaw[0] }}", "no attribute 'yaw'.*there are Q.euler"),
        ("{{ Q.euler[0] + friction }}", "'friction' is undefined"),
        ("{% macro f() %}{{ f() }}{% endmacro %}{{ f() }}", "recursion"),
        ('{{ cycler.__init__.__globals__.os.popen("touch ran") }}', "unsafe"),
        ("double a[]{{1, 2, 3}};", r"a number or text, got \(1, 2, 3\)"),
        ("{{ Q.euler }}", "a number or text, got"),
    ],
)
def test_what_a_template_cannot_print_is_told_in_one_line(tmp_path, monkeypatch, text, told):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=told) as found:
        filled(tmp_path, text)
    assert len(str(found.value).splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["gains.j2"]
