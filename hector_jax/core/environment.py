"""Provenance of a result: versions, machine, commit and a hash of the code."""

import ast
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax
import jax.numpy as jnp

from hector_jax.core.numerics import without_our_flags

# modules that do not affect numerical results
_NO_NUMBERS = (
    "control.weights_file core.cluster core.console core.environment core.files core.identity"
    " core.inputs core.journal core.pool core.runtime core.tree_file store.cache"
    " store.run store.setup"
).split()
_NUMERICS = "core.numerics"  # JAX's options, on which all numbers depend
# imported names whose package has another name or brings another package that computes
_PACKAGES_OF = {
    "jax": ("jax", "jaxlib"),
    "mujoco": ("mujoco", "mujoco-mjx"),
    "pinocchio": ("pin",),
    "pydrake": ("drake",),
}
_NO_NUMBER_PACKAGES = ("jaxtyping", "msgspec")  # of types and files
_PACKAGES = (
    "hector-jax jax jaxlib jaxopt flax optax numpy scipy mujoco mujoco-mjx drake pin"
).split()
_ROOT = Path(__file__).parents[1]


@cache  # called for the card of every file
def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that affect results."""
    return {"python": platform.python_version()} | _installed(_PACKAGES)


def _installed(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of those packages that are installed."""
    installed = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            installed[package] = version(package)
    return installed


def environment() -> dict[str, str]:
    """Return versions, platform, device, precision and, if available, the commit."""
    details = versions() | {
        "platform": f"{platform.system()} {platform.machine()}",
        "cores": str(os.cpu_count()),
        "device": jax.default_backend(),
        "precision": str(jnp.asarray(0.0).dtype),
    }
    commit = _commit(_ROOT.parent)
    return details | ({"commit": commit} if commit else {})


def _commit(folder: Path) -> str:
    """Return the commit of the checkout in `folder`, marked if files changed; "" if it is none."""
    if not (folder / ".git").exists():  # an installed package may lie inside another checkout
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
def code_hash(modules: tuple[str, ...]) -> str:
    """Return a hash (12 hexadecimal digits) of the code and packages that determine a result.

    It covers the syntax trees, without docstrings, of the modules, of every module of this package
    that they import and of the one that sets JAX's options, the versions of all other packages
    that these import, and XLA_FLAGS. Comments, layout and modules that only read, write and print
    do not change it.

    Args:
        modules: names such as `sim.walk`, relative to this package.
    """
    trees: dict[str, str] = {}
    pending, packages = [_NUMERICS, *modules], set[str]()
    while pending:
        name = pending.pop()
        if name in trees or name in _NO_NUMBERS:
            continue
        trees[name], imported, others = _syntax(_source(name).read_bytes())
        pending += imported
        packages |= others
    flags = without_our_flags(os.environ.get("XLA_FLAGS", ""))
    content = sorted(trees.items()), _installed(sorted(packages)), flags
    return hashlib.sha256(repr(content).encode()).hexdigest()[:12]


@cache  # most modules are in the hashes of several results
def _syntax(source: bytes) -> tuple[str, list[str], set[str]]:
    """Return the syntax tree of a module, without docstrings, and what it imports.

    Returns:
        The tree as text, the modules of this package and the other packages that it imports.
    """
    tree = ast.parse(source)
    names, package = set(imported_names(tree)), f"{_ROOT.name}."
    own = [name.removeprefix(package) for name in sorted(names) if name.startswith(package)]
    others = {name.partition(".")[0] for name in names}
    others -= {_ROOT.name, *sys.stdlib_module_names, *_NO_NUMBER_PACKAGES}
    for node in ast.walk(tree):
        match getattr(node, "body", None):
            case [ast.Expr(ast.Constant(str())), *_] as body:
                body.pop(0)
    modules = [name for name in own if _source(name).exists()]  # other names are no modules
    packages = {package for name in others for package in _PACKAGES_OF.get(name, (name,))}
    return ast.dump(tree), modules, packages


def _source(module: str) -> Path:
    path = _ROOT.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def imported_names(tree: ast.Module) -> Iterator[str]:
    """Yield the full names of all that a module imports, and of the modules that it is from."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (str(node.module), *(f"{node.module}.{x.name}" for x in node.names))
