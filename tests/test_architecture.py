"""The house: who imports whom, and which outside package enters through which door."""

import ast
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from pretend import python

import hector_jax

ROOT = Path(__file__).parents[1] / "hector_jax"
METHOD = "core robot qp control sim grfm tuning".split()
APPLICATION = "importing own store verdict walk_tuning export report view cli __main__".split()
FLOOR = {room: height for height, room in enumerate([*METHOD, *APPLICATION])}
DOORS = {"mujoco": ("core.headless", "sim.mjx_model"), "pydrake": ("sim.drake",)}
DOORS |= {"pinocchio": ("sim.pinocchio",), "coal": ("sim.pinocchio",)}
DOORS |= {
    "viser": ("view.",),
    "trimesh": ("view.", "importing.meshes"),
    "flax": ("grfm.nets",),
}
DOORS |= {"optax": ("grfm.nets", "tuning.difftune", "tuning.step_rules")}
DOORS |= {"rosbags": ("own.bag",)}
DOORS |= {"jaxopt": ("qp.jaxopt_solver",)}
DOORS |= {"matplotlib": ("report.plots",), "tyro": ("cli.parse",)}
DOORS |= {"jinja2": ("report.report", "export.source", "export.template")}
DOORS |= dict.fromkeys(("cma", "cmaes", "botorch", "torch"), ())
DOORS |= {"hector_jax.importing": ("importing.", "cli.commands")}  # robots of others


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def name_of(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


FILES = [path for path in sorted(ROOT.rglob("*.py")) if path != ROOT / "__init__.py"]
IMPORTS = sorted({(name_of(path), target) for path in FILES for target in imported(path)})


def importers(of):
    return {name for name, target in IMPORTS if f"{target}.".startswith(f"{of}.")}


def room(name):
    return name.removeprefix("hector_jax.").split(".")[0]


def test_imports_point_downwards_and_the_method_draws_nothing():
    inside = [(name, target) for name, target in IMPORTS if target.startswith("hector_jax.")]
    for name, target in inside:
        assert room(target) == room(name) or FLOOR[room(target)] < FLOOR[room(name)], (name, target)
    for package in ("tyro", "jinja2", "matplotlib", "viser"):
        assert not {name for name in importers(package) if room(name) in METHOD}


@pytest.mark.parametrize("package", DOORS)
def test_each_outside_package_has_its_door(package):
    assert not {name for name in importers(package) if not name.startswith(DOORS[package])}


def test_nothing_that_learns_can_reach_the_stand_in_nor_the_package_a_script():
    assert importers("hector_jax.sim.standin") == {"cli.arguments"}
    knowing = {
        path.stem
        for folder in ("experiments", "benchmarks")
        for path in (ROOT.parent / folder).glob("*.py")
        if any(name.startswith("hector_jax.sim.standin") for name in imported(path))
    }
    # foretell counts its intervals there; what it writes for the package is of other plants
    assert knowing == {"robustness", "pictures", "golden", "foretell"}
    scripts = [path.stem for path in (ROOT.parent / "experiments").glob("*.py")]
    assert not [name for name in ("experiments", *scripts) if importers(name)]


def test_every_public_name_is_there_and_importing_the_package_imports_nothing_else():
    found = python("-c", "import sys, hector_jax; print('jax' in sys.modules)")
    assert found.stdout == "False\n"
    assert len(hector_jax.__all__) == len({id(getattr(hector_jax, n)) for n in hector_jax.__all__})
    with pytest.raises(AttributeError, match="no attribute 'tuna'"):
        hector_jax.tuna  # noqa: B018


def definitions(path):
    kinds = ast.FunctionDef | ast.ClassDef
    return (node for node in ast.parse(path.read_text()).body if isinstance(node, kinds))


def test_a_public_name_stands_in_one_module():
    """But for the functions of each phi, flags of commands, and what a process runs."""
    names = [node.name for path in ROOT.rglob("*.py") for node in definitions(path)]
    found = Counter(name for name in names if not name.startswith("_"))
    phi = {"init", "fit", "apply", "with_statistics"}
    of_flags = {"Check", "Robot", "View"}
    assert {name for name, count in found.items() if count > 1} == phi | of_flags


def test_a_function_takes_at_most_five_positional_arguments():
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                names = {arg.arg for arg in node.args.posonlyargs + node.args.args}
                assert len(names - {"self", "cls"}) <= 5, (path.name, node.name)


def test_no_modules_import_each_other_in_a_circle():
    """Also not inside of functions."""
    inside = {name_of(path): set() for path in FILES if path.stem != "__init__"}
    for name, target in IMPORTS:
        if name in inside and (target := target.removeprefix("hector_jax.")) in inside:
            inside[name].add(target)
    TopologicalSorter(inside).prepare()  # raises CycleError
