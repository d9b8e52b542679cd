"""What goes to the robot: weights, the C++ controller's own QP, the exported controller."""

import contextlib
import importlib.util
import io
import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from model import OTHERS
from oracles import exact_solution
from pretend import instead
from scipy.spatial.transform import Rotation

from hector_jax.cli.flags import Tune
from hector_jax.cli.main import main
from hector_jax.cli.parse import as_table
from hector_jax.control.contact import LINE_FRICTION, StateCost
from hector_jax.control.controller import WalkConfig
from hector_jax.control.gait import GaitConfig
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, solve_mpc
from hector_jax.control.reference import Command, named_command
from hector_jax.control.weights import expert, nominal, vector_to_weights, weights_to_vector
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.settings import to_table
from hector_jax.core.trajectory import State, pack_wrench
from hector_jax.export import export
from hector_jax.export.controller import Check, compare_with_live, record
from hector_jax.export.export import (
    PLATFORMS,
    SCHEMA,
    TOLERANCE,
    controller,
    controller_of_run,
    export_controller,
    find_weights,
    load_controller,
    weights_cpp,
)
from hector_jax.qp import QP, Status
from hector_jax.robot.model import load_robot
from hector_jax.store.cache import robot_hash

pytestmark = pytest.mark.usefixtures("on_cpu")
ROBOT, CONFIG = load_robot(), WalkConfig()
EXAMPLE = Path(__file__).parents[1] / "examples" / "run_exported.py"


def random_weights(seed):
    """Twenty-four different numbers, left and right too."""
    draws = np.random.default_rng(seed).uniform(-1, 1, 24)
    return vector_to_weights(weights_to_vector(expert()) * 3.0**draws)


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


# The exported controller


# with numbers of the plan and of the legs
TUNED = CONFIG.with_others(
    expert()._replace(others={"footstep_width": np.array(0.1), "foot_height": np.array(0.11)}),
    OTHERS,
)


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


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["hector", "export", *map(str, arguments)])
    return main()


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """What the command printed for such a run, and the folder that it wrote."""
    run, printed = save_run(tmp_path_factory.mktemp("run")), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        assert call(patch, run, "--seconds", "0.1", "--json") == 0
    return json.loads(printed.getvalue()), run / "export"


@pytest.fixture(scope="module")
def loaded(exported):
    """The exported controller and an example of its arguments."""
    content = (exported[1] / "controller-cpu.jaxexport").read_bytes()
    return load_controller(content), controller(CONFIG, ROBOT, TUNED)[1]


def test_the_loaded_controller_answers_as_the_live_one_did(loaded):
    walked = record(CONFIG, ROBOT, TUNED, command=named_command("s"), seconds=0.4)
    found = compare_with_live(CONFIG, *loaded, walked)
    assert max(found.force, found.moment, found.torque) <= TOLERANCE
    assert found.unsolved == 0
    assert np.abs(walked.wrench.force).max() > 100.0
    assert walked.measurement.state.velocity[-1, 0] > 0.1


def test_measured_yaw_and_anchor_may_be_of_any_turn(loaded):
    command = Command(np.full(2, 4.0), np.array([[0.2, 0.0]] * 2), np.full(2, 0.5 * np.pi))
    walked = record(CONFIG, ROBOT, TUNED, command=command, seconds=2.4)
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
        found = compare_with_live(CONFIG, *loaded, again)
        assert max(found.force, found.moment, found.torque) <= TOLERANCE
        assert found.unsolved == 0


def test_a_yaw_that_is_no_number_is_seen_and_then_forgotten(loaded):
    control, (carry, _, measured, command, anchor) = loaded
    lost = measured | {"euler": np.array([0.0, 0.0, np.nan])}
    torques = []
    for i, now in enumerate([measured, measured, lost, measured]):
        carry, out = control(carry, np.int32(i), now, command, anchor)
        torques.append(np.isfinite(out["torque"]).all())
    assert torques == [True, True, False, True]


@pytest.mark.parametrize(("weights", "part", "least"), [(nominal, 0, 1.0), (expert, 2, 0.1)])
def test_the_check_notices_other_weights(loaded, weights, part, least):
    """Also those that differ in the numbers of plan and legs alone: the torque tells."""
    other = CONFIG.with_others(weights(), OTHERS)
    walked = record(CONFIG, ROBOT, other, command=named_command("s"), seconds=0.1)
    assert compare_with_live(CONFIG, *loaded, walked)[part] > least


@pytest.mark.parametrize("platform", PLATFORMS)
def test_only_custom_calls_with_a_guarantee_are_in_it(exported, platform):
    content = (exported[1] / f"controller-{platform}.jaxexport").read_bytes()
    found = jax.export.deserialize(bytearray(content))
    assert found.platforms == (platform,)
    assert not found.disabled_safety_checks
    calls = set(re.findall(r"custom_call @(\w+)", found.mlir_module()))
    assert calls
    assert all(name.startswith(("lapack_", "cusolver_", "cu_lu_")) for name in calls), calls


def test_weights_that_fall_and_another_device_are_refused(monkeypatch):
    limp = TUNED._replace(Q=jax.tree.map(lambda w: 1e-6 * w, nominal().Q))
    with pytest.raises(ValueError, match="fall"):
        record(CONFIG, ROBOT, limp, command=named_command("straight"), seconds=0.2)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match="JAX_PLATFORMS=cpu"):
        export_controller(CONFIG, ROBOT, expert())


# The command


@pytest.fixture
def run(tmp_path):
    return save_run(tmp_path)


def test_the_command_writes_files_that_run_without_us(capsys, exported, tmp_path):
    card, folder = exported
    files = (
        "check.npz controller-cpu.jaxexport controller-cuda.jaxexport controller.json weights.cpp "
    )
    files += "weights.json weights.schema.json"
    assert sorted(path.name for path in folder.glob("[!.]*")) == files.split()
    assert json.loads((folder / "controller.json").read_text()) == card
    assert card["check"]["force"] <= TOLERANCE
    assert card["check"]["plan_ms"]["p50"] > 0.0
    schema = json.loads((folder / SCHEMA).read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(json.loads((folder / "weights.json").read_text()), schema)
    jax.tree.map(np.testing.assert_array_equal, load_weights(folder / "weights.json"), TUNED)

    spec = importlib.util.spec_from_file_location("run_exported", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main(folder)
    assert "1200 calls" in capsys.readouterr().out
    changed = shutil.copytree(folder, tmp_path / "changed")
    (changed / "controller-cpu.jaxexport").write_bytes(b"another")
    with pytest.raises(SystemExit, match="does not have the sha256"):
        example.main(changed)


def test_what_differs_from_the_live_controller_is_not_written(monkeypatch, capsys, run):
    for part in ("export_controller", "record", "load_controller"):
        instead(monkeypatch, export, part, lambda *args, **named: None)
    for difference, fault in (({"force": 2e-6}, "2.0e-06 N"), ({"unsolved": 3}, "3 QPs were not")):
        found = Check(0.0, 0.0, 0.0, 0, {}, {})._replace(**difference)
        instead(monkeypatch, export, "compare_with_live", lambda *known, found=found: found)
        assert call(monkeypatch, run) == 1
        assert fault in capsys.readouterr().err
        assert list((run / "export").glob("[!.]*")) == []


def test_a_run_is_exported_with_its_own_controller(run):
    own = replace(CONFIG, gait=GaitConfig(stance=24, swing=16), mpc=MpcConfig(friction=0.4))
    kept = to_table(own)
    del kept["mpc"]["effort_reference"]  # of a run from before there was such a setting
    (run / "config.json").write_text(json.dumps({"tune": {"rollout": {"walk": kept}}}))
    assert find_weights(run, "best") == run / "weights" / "best.json"
    assert controller_of_run(run) == own
    path = run / "weights" / "best.json"
    assert find_weights(path, "best") == path


def test_a_set_that_is_not_there_is_one_line_and_writes_nothing(monkeypatch, capsys, run):
    assert call(monkeypatch, run, "--set", "bset") == 2
    assert re.match("hector: .*did you mean 'best'", capsys.readouterr().err.splitlines()[-1])
    assert not (run / "export").exists()
