"""The C controller in programs of others: its calls, compilers, CMake, a robot that is held."""

import ctypes
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import jax
import mujoco
import numpy as np
import pytest
from compiled import CONFIG, TUNED, WARNINGS, assert_same, needs_cc, source_of
from model import EXAMPLES, OTHERS, QUADRUPED, ROBOT

from hector_jax.control.contact import (
    BOX_FRICTION,
    FRICTION,
    LINE_FRICTION,
    TWIST,
)
from hector_jax.control.controller import walk_config
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import shipped
from hector_jax.core.environment import versions
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import tree_hash
from hector_jax.export import check
from hector_jax.export.check import (
    compare_with_live,
    compile_controller,
)
from hector_jax.export.source import with_prefix
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import ideal

pytestmark = pytest.mark.usefixtures("on_cpu")
HERE = Path(__file__).parent
HUMANOID = load_robot(EXAMPLES / "humanoid" / "robot.toml")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The compiled controller of the tuned weights."""
    needs_cc()
    return compile_controller(source_of(TUNED), tmp_path_factory.mktemp("c"), *WARNINGS)


@pytest.fixture(scope="module")
def own_tests(library):
    """The functions of exported_calls.c, compiled beside a controller, by their names."""
    words = [*"cc -std=c99 -O2 -fPIC -shared -I. -o calls.so".split(), HERE / "exported_calls.c"]
    subprocess.run([*words, "controller.c", "-lm"], cwd=library.parent, check=True)
    return ctypes.CDLL(str(library.parent / "calls.so"))


CALLS = re.findall(r"^int test_(\w+)\(", (HERE / "exported_calls.c").read_text(), re.MULTILINE)


@pytest.mark.parametrize("name", CALLS)
def test_calls_of_the_controller(own_tests, name):
    """Each returns the line of its first failure."""
    assert getattr(own_tests, f"test_{name}")() == 0


def test_the_plug_in_of_ros2_control_walks_as_the_controller_does(tmp_path):
    """With stand-ins of the headers of ROS, in MuJoCo: also parameters, watchdog, lost inputs."""
    needs_cc()
    home = Path(mujoco.__path__[0])
    if shutil.which("g++") is None or not list(home.glob("libmujoco.so*")):
        pytest.skip("there is no C++ compiler or no libmujoco.so")
    own = (HERE / "exported_ros2.cpp").read_text()
    for file, text in with_prefix(source_of(shipped()) | {"test.cpp": own}, "left").items():
        write_file(tmp_path / file, text.encode())
    folder = tmp_path / "ros2_control"
    flags = f"-std=c++17 -O2 -Wall -Wextra -Werror -I. -I{HERE}/ros2 -I{home}/include"
    linked = [*home.glob("libmujoco.so*"), f"-Wl,-rpath,{home}"]
    files = "test.cpp ros2_control/left_ros2.cpp left.o -o ros2"
    subprocess.run("cc -std=c99 -O2 -c left.c".split(), cwd=tmp_path, check=True)
    words = ["g++", *flags.split(), *files.split(), *linked]
    subprocess.run(words, cwd=tmp_path, check=True)
    words = [tmp_path / "ros2", ROBOT.description.model]
    said = subprocess.run(words, capture_output=True, text=True)
    assert (said.returncode, said.stderr) == (0, ""), said.stdout
    x, y, height = map(float, re.search(r"x (\S+) y (\S+) height (\S+)", said.stdout).groups())
    assert (x, y, height) == pytest.approx((0.5, 0.28, ROBOT.standing_height), abs=0.1)
    (kind,) = ElementTree.parse(folder / "plugins.xml").getroot()
    assert (kind.get("type"), kind.get("name")) == ("left_ros2::Walk", "left_ros2/Walk")
    assert ElementTree.parse(folder / "package.xml").findtext("name") == "left_ros2"
    assert "project(left_ros2 " in (folder / "CMakeLists.txt").read_text()
    text = (folder / "parameters.yaml").read_text()
    given = dict(re.findall(r"^    (\w+): (.*)$", text, re.MULTILINE))
    assert (given["type"], json.loads(given["R_force"])) == (
        "left_ros2/Walk",
        np.ravel(shipped().R.force).tolist(),
    )


def test_two_exports_with_prefixes_are_used_by_one_file(tmp_path):
    needs_cc()
    both = {"left": TUNED, "right": CONFIG.with_others(nominal(), OTHERS)}
    for prefix, weights in both.items():
        for file, text in with_prefix(source_of(weights), prefix).items():
            write_file(tmp_path / file, text.encode())
    code = """#include "left.h"
    #include "right.h"
    static struct left a;
    static struct right b;
    int main(void) {
        left_init(&a), right_init(&b);
        return LEFT_FEET != RIGHT_FEET || a.next.Q[0] == b.next.Q[0];
    }
    """
    (tmp_path / "main.c").write_text(code)
    words = ["cc", "-std=c99", *WARNINGS, *"main.c left.c right.c -lm -o main".split()]
    subprocess.run(words, cwd=tmp_path, check=True)
    assert subprocess.run(["./main"], cwd=tmp_path).returncode == 0
    assert "controller" not in (tmp_path / "CMakeLists.txt").read_text()
    for wrong in ("", "1st", "a b", "Left", "a-b"):
        with pytest.raises(InputError, match="--prefix must be a name in C"):
            with_prefix({}, wrong)


COMPILERS = {
    "gcc": "-fanalyzer -Wdouble-promotion",
    "clang": "-Wdouble-promotion",
    "g++": "-x c++ -include cstdint -fsyntax-only",  # the header
    "arm-none-eabi-gcc": "-mcpu=cortex-m7 -mthumb",
    "aarch64-linux-gnu-gcc": "",
}


@pytest.mark.parametrize("name", COMPILERS)
def test_compilers_have_nothing_to_say(library, name):
    if shutil.which(name) is None:
        pytest.skip(f"there is no {name}")
    more = "-Wpedantic -Wshadow -Wvla -Wsign-conversion -Wcast-align -Wcast-qual".split()
    file, standard = ("controller.h", []) if name == "g++" else ("controller.c", ["-std=c99"])
    flags = ["-Wall", "-Wextra", "-Wconversion", "-Werror", *more, *COMPILERS[name].split()]
    words = [name, *standard, "-O2", *flags, "-c", file, "-o", os.devnull]
    subprocess.run(words, cwd=library.parent, check=True)


def test_an_int_of_32_bits_may_be_a_long(library):
    """As on 32-bit processors, whose compiler then refuses its address for that of an int."""
    code = '#include <stdint.h>\n#define int32_t long\n#include "controller.c"\n'
    words = "cc -std=c99 -Wall -Werror -fsyntax-only -x c -".split()
    subprocess.run(words, cwd=library.parent, input=code, text=True, check=True)


def test_the_header_says_the_size_the_stack_and_where_it_is_from(library):
    header = (library.parent / "controller.h").read_text()
    size = ctypes.c_size_t.in_dll(ctypes.CDLL(str(library)), "controller_size").value
    assert abs(float(re.search(r"controller c; // (\d+) kB", header)[1]) - 1e-3 * size) <= 2.0
    assert f"hector_jax {versions()['hector-jax']}, Apache-2.0" in header
    assert tree_hash(ROBOT) in header
    for line in re.search(r"struct controller_estimate \{(.*?)\};", header, re.DOTALL)[
        1
    ].splitlines():
        assert not line or re.search(r"/\* .*\[\S+\].* \*/", line)


def test_the_source_has_all_digits_in_single_precision_too(library):
    with jax.enable_x64(False):
        assert source_of(TUNED)["controller.c"] == (library.parent / "controller.c").read_text()


CONSUMER = """cmake_minimum_required(VERSION 3.15)
project(use LANGUAGES C)
find_package(controller REQUIRED)
file(WRITE use.c "#include <controller.h>
static struct controller c;
int main(void) { controller_init(&c); return c.next.Q[0] <= 0.0; }")
add_executable(use use.c)
target_link_libraries(use hector::controller)
enable_testing()
add_test(NAME use COMMAND use)
"""


def test_cmake_installs_it_for_another_project(library, tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("there is no CMake")
    needs, place = tmp_path / "consumer", f"-DCMAKE_PREFIX_PATH={tmp_path}/there"
    needs.mkdir()
    (needs / "CMakeLists.txt").write_text(CONSUMER)
    for words in (
        ["-S", library.parent, "-B", "made"],
        ["--build", "made"],
        ["--install", "made", "--prefix", "there"],
        ["-S", "consumer", "-B", "used", place],
        ["--build", "used"],
    ):
        done = subprocess.run(["cmake", *words], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert subprocess.run([tmp_path / "used" / "use"]).returncode == 0


def test_friction_in_a_box_and_twist_are_exported_too(tmp_path):
    needs_cc()
    of_line = tuple(
        part for part in CONFIG.mpc.constraints if part not in (FRICTION, LINE_FRICTION)
    )
    config = replace(CONFIG, mpc=MpcConfig(constraints=(*of_line, BOX_FRICTION, TWIST)))
    job = Job(expert(), named_command("c"), ideal(), 0.4)
    recorded = check.record(config, ROBOT, job)
    library = compile_controller(source_of(expert(), config), tmp_path)
    assert_same(compare_with_live(config, ROBOT, library, recorded))


@pytest.mark.parametrize("robot", [ROBOT, QUADRUPED], ids=["hector", "quadruped"])
def test_the_inertia_of_the_motors_is_exported_too(tmp_path, robot):
    needs_cc()
    own = walk_config(robot)
    armature = tuple(np.linspace(0.01, 0.02, len(own.legs.kp)).tolist())
    config = replace(own, legs=replace(own.legs, armature=armature))
    job = Job(nominal(robot), named_command("c"), ideal(robot.description), 0.4)
    recorded = check.record(config, robot, job)
    library = compile_controller(source_of(nominal(robot), config, robot), tmp_path)
    assert_same(compare_with_live(config, robot, library, recorded))
    (tmp_path / "plain").mkdir()  # a library is loaded once from a path
    plain = compile_controller(source_of(nominal(robot), own, robot), tmp_path / "plain")
    assert compare_with_live(config, robot, plain, recorded).torque > 0.1  # [N m]


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """exported_held.c with the shipped weights."""
    needs_cc()
    home, folder = Path(mujoco.__path__[0]), tmp_path_factory.mktemp("held")
    libraries = list(home.glob("libmujoco.so*"))
    if not libraries:
        pytest.skip("this MuJoCo has no libmujoco.so")
    for file, text in source_of(shipped()).items():
        write_file(folder / file, text.encode())
    words = ["cc", "-std=c99", "-O2", f"-I{home}/include", "-I.", HERE / "exported_held.c"]
    words += ["controller.c", *libraries, f"-Wl,-rpath,{home}", "-lm", "-o", "held"]
    subprocess.run(words, cwd=folder, check=True)
    return folder / "held"


def run_calls(folder, program, robot, *words):
    """The output of exported_PROGRAM.c with a robot's controller and a file of how it stands."""
    needs_cc()
    file = HERE / f"exported_{program}.c"
    source = source_of(nominal(robot), walk_config(robot), robot)
    for name, text in source.items():
        write_file(folder / name, text.encode())
    estimates = np.zeros(1500, check.layout_of(robot).estimate)
    estimates["position"] = robot.com_offset + np.array([0.0, 0.0, robot.trunk_height])
    estimates["joints"] = robot.standing_joints
    estimates.tofile(folder / "estimates")
    own = [] if "controller.c" in file.read_text() else ["controller.c"]
    flags = "cc -std=c99 -O2 -Wall -Wextra -Werror -I. -o program".split()
    subprocess.run([*flags, file, *own, "-lm"], cwd=folder, check=True)
    words = ["./program", *words, "estimates"]
    said = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert (said.returncode, said.stderr) == (0, ""), said.stdout
    return said.stdout


of_robots = pytest.mark.parametrize(
    "robot",
    [ROBOT, QUADRUPED, pytest.param(HUMANOID, marks=pytest.mark.slow)],
    ids=["hector", "quadruped", "humanoid"],
)


@of_robots
def test_random_calls_break_no_rule(tmp_path, robot):
    """No torque beyond its limit, no wrench outside its rows, no trace of a refused call."""
    said = run_calls(tmp_path, "fuzz", robot, "20000", "1")
    for kind, seen in (("calls", (0, 1, 6, 8)), ("plans", (0, 1))):
        counts = [int(x) for x in re.search(rf"{kind} by status (.*)", said)[1].split()]
        assert all(counts[status] > 100 for status in seen)
    assert float(re.search("outermost wrench (.*)", said)[1]) <= 1e-9


@of_robots
def test_a_push_delays_no_call_that_holds(tmp_path, robot):
    said = run_calls(tmp_path, "time", robot)
    longest = [float(time) for time in re.findall(r"hold \S+ (\S+)", said)]
    assert len(longest) == 2
    assert max(longest) < 0.05  # [ms]


HOLDS = [("stand", s, up) for s in (2, 5, 10, 30) for up in (0.02, 0.05, 0.15)]
HOLDS += [("turn", s, 0.0) for s in (2, 4, 6, 8, 10)]
QUICK = (("stand", 10, 0.02), ("turn", 6, 0.0))


@pytest.mark.parametrize(
    "hold", [pytest.param(h, marks=() if h in QUICK else pytest.mark.slow) for h in HOLDS]
)
def test_a_robot_that_a_hand_held_walks_on(held, hold):
    words = [held, ROBOT.description.model, *map(str, hold)]
    said = subprocess.run(words, capture_output=True, text=True)
    assert (said.returncode, said.stderr) == (0, ""), said.stdout
