"""What a result was made with: versions, machine, commit, and a hash of the code itself."""

import ast
import hashlib
import os
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax
import jax.numpy as jnp

NUMERIC = ("jax", "jaxlib", "mujoco", "numpy")  # packages that decide the numbers of a result
# modules that decide none
_NO_NUMBERS = (
    "control.weights_file",
    "core.console",
    "core.environment",
    "core.files",
    "core.inputs",
    "core.runtime",
    "core.tree_file",
)
_PACKAGES = (
    "hector-jax",
    "jax",
    "jaxlib",
    "flax",
    "numpy",
    "mujoco",
    "mujoco-mjx",
    "cmaes",
    "scikit-learn",
)
_ROOT = Path(__file__).parents[1]


@cache  # every file's card asks for them
def versions() -> dict[str, str]:
    """Versions of Python and of those packages that shape our numbers and are installed."""
    installed = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            installed[package] = version(package)
        except PackageNotFoundError:
            continue
    return installed


def environment() -> dict[str, str]:
    """What the numbers were made with: versions, platform, device and, if known, the commit."""
    details = versions() | {
        "platform": f"{platform.system()} {platform.machine()}",
        "cores": str(os.cpu_count()),
        "device": jax.default_backend(),
        "precision": str(jnp.asarray(0.0).dtype),
    }
    commit = _commit(_ROOT.parent)
    return details | ({"commit": commit} if commit else {})


def _commit(folder: Path) -> str:
    """Commit of the checkout in `folder`, marked where files differ from it; empty elsewhere."""
    if not (folder / ".git").exists():  # an installed package may lie inside some other checkout
        return ""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        changed = " with changes" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("describe", "--tags", "--always", "--abbrev=40", "--long") + changed
    except (OSError, subprocess.SubprocessError):
        return ""


@cache
def code_hash(*modules: str) -> str:
    """Hash (12 hexadecimal digits) of the code and the packages that decide a result's numbers.

    Hashed are the syntax trees of the modules and of all of this package that they import, without
    docstrings, and the versions of JAX, MuJoCo and NumPy. Comments, layout and what only reads,
    writes and prints void nothing.

    Args:
        modules: names such as `sim.walk`, relative to this package.
    """
    trees: dict[str, str] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in trees or name in _NO_NUMBERS:
            continue
        tree = ast.parse(_source(name).read_bytes())
        waiting += _imported(tree)
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list) and body and _is_text(body[0]):
                body.pop(0)
        trees[name] = ast.dump(tree)
    numeric = {name: version(name) for name in NUMERIC}
    return hashlib.sha256(repr((sorted(trees.items()), numeric)).encode()).hexdigest()[:12]


def _source(module: str) -> Path:
    path = _ROOT.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(tree: ast.Module) -> list[str]:
    """Modules of this package that a module imports, relative to it."""
    package, modules = f"{_ROOT.name}.", []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith(package):
            module = f"{node.module}."[len(package) :]
            names = [f"{module}{alias.name}" for alias in node.names]
            modules += [name for name in names if _source(name).exists()] + [module[:-1]] * bool(
                module
            )
    return modules


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)
