"""The house: who imports whom, and which outside package enters through which door."""

import ast
import importlib.util
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import hector_jax
from hector_jax.store import nets

ROOT = Path(__file__).parents[1] / "hector_jax"
METHOD = "core robot qp control sim grfm tuning search".split()
APPLICATION = "importing store verdict walk_tuning export report cli __main__".split()
FLOOR = {room: height for height, room in enumerate([*METHOD, *APPLICATION])}
DOORS = {
    "mujoco": ("core.headless", "sim.mjx_model"),
    "pydrake": ("sim.drake",),
    "pinocchio": ("sim.pinocchio",),
    "coal": ("sim.pinocchio",),
    "viser": ("report.view",),
    "trimesh": ("report.view",),
    "flax": ("grfm.nets",),
    "optax": ("grfm.nets", "tuning.difftune", "tuning.step_rules", "search.few_walks"),
    "jaxopt": ("qp.jaxopt_solver",),
    "cmaes": ("search.",),
    "tinygp": ("search.few_walks",),
    "cma": (),
    "botorch": (),
    "torch": (),
    "matplotlib": ("report.plots",),
    "jinja2": ("report.report",),
    "tyro": ("cli.parse",),
}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            for alias in node.names:
                if (ROOT.parent / node.module.replace(".", "/") / f"{alias.name}.py").exists():
                    yield f"{node.module}.{alias.name}"


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        if name:
            yield from ((name, target) for target in imported(path))


IMPORTS = sorted(set(modules()))


def room(name: str) -> str:
    return name.split(".")[0]


def test_every_room_has_a_floor():
    assert {room(name) for name, _ in IMPORTS} <= set(FLOOR)


def test_imports_point_downwards():
    wrong = [
        (name, target)
        for name, target in IMPORTS
        if target.startswith("hector_jax.")
        for below in [room(target.removeprefix("hector_jax."))]
        if below != room(name) and FLOOR[below] >= FLOOR[room(name)]
    ]
    assert not wrong


@pytest.mark.parametrize("package", DOORS)
def test_each_outside_package_has_its_door(package):
    inside = {name for name, target in IMPORTS if target.split(".")[0] == package}
    assert {name for name in inside if not name.startswith(DOORS[package])} == set()


def test_robots_of_others_come_in_by_one_door():
    inside = {name for name, target in IMPORTS if target.startswith("hector_jax.importing")}
    assert {name for name in inside if not name.startswith("importing")} == {"cli.commands"}


def test_the_method_takes_no_settings_of_a_command_and_draws_nothing():
    application = {f"hector_jax.{room}" for room in APPLICATION}
    outside = {"tyro", "jinja2", "matplotlib", "viser"}
    wrong = [
        (name, target)
        for name, target in IMPORTS
        if room(name) in METHOD
        and (target.split(".")[0] in outside or ".".join(target.split(".")[:2]) in application)
    ]
    assert not wrong


def test_nothing_that_learns_or_searches_can_reach_the_stand_in():
    inside = {name for name, target in IMPORTS if target.startswith("hector_jax.sim.standin")}
    assert inside == {"cli.arguments"}


def test_of_the_scripts_only_those_with_verdicts_reach_the_stand_in():
    scripts = [
        p for room in ("experiments", "benchmarks") for p in (ROOT.parent / room).glob("*.py")
    ]
    knowing = {
        f"{path.parent.name}.{path.stem}"
        for path in scripts
        if any(name.startswith("hector_jax.sim.standin") for name in imported(path))
    }
    experiments = {f"experiments.{name}" for name in ("robustness", "pictures")}
    assert knowing == experiments | {"benchmarks.golden"}


def definitions(path):
    kinds = ast.FunctionDef | ast.ClassDef
    return (node for node in ast.parse(path.read_text()).body if isinstance(node, kinds))


def test_a_public_name_stands_in_one_module():
    """But for the functions of each phi, flags of commands, and what a process runs."""
    found = Counter(
        node.name
        for path in ROOT.rglob("*.py")
        for node in definitions(path)
        if not node.name.startswith("_")
    )
    phi, of_flags = {"init", "fit", "apply", "with_statistics"}, {"Robot", "Verdict", "View"}
    assert {name for name, count in found.items() if count > 1} == phi | of_flags | {"main"}


def test_a_function_takes_at_most_five_positional_arguments():
    many = [
        f"{path.name}: {node.name}"
        for path in ROOT.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
        if len([a for a in node.args.posonlyargs + node.args.args if a.arg not in ("self", "cls")])
        > 5
    ]
    assert many == []


def test_the_package_imports_no_script():
    scripts = {path.stem for path in (ROOT.parent / "experiments").glob("*.py")} | {"experiments"}
    assert not [(name, target) for name, target in IMPORTS if target.split(".")[0] in scripts]


def test_scripts_use_nothing_private_of_the_package():
    wrong = []
    for path in sorted((ROOT.parent / "experiments").glob("*.py")):
        tree = ast.parse(path.read_text())
        names = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("hector_jax"):
                names |= {alias.asname or alias.name: alias.name for alias in node.names}
                wrong += [(path.name, part) for part in node.module.split(".") if part[0] == "_"]
        wrong += [(path.name, name) for name in names.values() if name.startswith("_")]
        wrong += [
            (path.name, f"{node.value.id}.{node.attr}")
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
            # the public methods of a NamedTuple begin with an underscore
            if node.value.id in names and node.attr.startswith("_")
            if node.attr not in ("_asdict", "_fields", "_make", "_replace")
        ]
    assert not wrong


def test_every_public_name_is_there_and_importing_the_package_imports_nothing_else():
    words = [sys.executable, "-c", "import sys, hector_jax; print('jax' in sys.modules)"]
    assert subprocess.run(words, capture_output=True, text=True).stdout == "False\n"
    assert len(hector_jax.__all__) == len({id(getattr(hector_jax, n)) for n in hector_jax.__all__})
    with pytest.raises(AttributeError, match="no attribute 'tuna'"):
        hector_jax.tuna  # noqa: B018


WRITERS = ("write_text", "write_bytes", "savefig", "save", "savez", "move")
# into memory, into a folder that is removed, or nowhere
NOT_LEFT = {"export.export: savez", "report.plots.style: savefig", "core.tree_file: open"}
NOT_LEFT |= {"report.video: write_bytes", "report.render: save", "report.view: open"}


def writes(tree):
    """The names of calls that write a file."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        name = node.func.id if isinstance(node.func, ast.Name) else name
        words = [
            x.value for x in (*node.args, *(k.value for k in node.keywords)) if hasattr(x, "value")
        ]
        if name in WRITERS or (name == "open" and {"w", "x", "a", "wb", "xb", "ab"} & set(words)):
            yield name


def test_a_file_is_written_in_one_step_or_not_at_all():
    """By `core.files`, so that no part of one is left where a disk gets full."""
    found = {
        f"{'.'.join(path.relative_to(ROOT).with_suffix('').parts)}: {name}"
        for path in ROOT.rglob("*.py")
        for name in writes(ast.parse(path.read_text()))
    }
    assert {x for x in found if not x.startswith("core.files: ")} == NOT_LEFT


def test_what_scripts_import_inside_functions_is_there_too():
    missing = []
    for folder in ("benchmarks", "experiments", "examples", "hector_jax"):
        for path in (ROOT.parent / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                    "hector_jax"
                ):
                    module = importlib.import_module(node.module)
                    missing += [
                        f"{path.name}: {node.module}.{alias.name}"
                        for alias in node.names
                        if not hasattr(module, alias.name)
                        and not importlib.util.find_spec(f"{node.module}.{alias.name}")
                    ]
    assert missing == []


def test_what_both_engines_compute_is_in_the_key_of_their_walks():
    assert {"sim.walk", "sim.parallel"} <= set(nets.COLLECTION_CODE)
