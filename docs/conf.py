"""The site: Markdown and docstrings in, pages that need no network out (`make docs`)."""

import importlib
import inspect
import pkgutil
import re
from importlib import metadata
from pathlib import Path
from types import ModuleType

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

import hector_jax

project = "hector_jax"
author = "hector_jax"
release = metadata.version("hector-jax")
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
html_theme = "furo"
html_title = f"hector_jax {release}"
html_show_sphinx = False
exclude_patterns = ["_build", "jupyter_execute", "**.ipynb_checkpoints"]

nb_execution_mode = "off"  # tests execute the notebooks; the site shows what is committed
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True  # a default is shown as the code has it, not as a path of here
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
default_role = "code"  # docstrings put names between single backticks

html_math_renderer = "mathml"  # drawn by the browser itself: no script, no font from elsewhere

PACKAGES = {  # in this order: title and purpose of each page of the reference
    "core": ("Types and geometry", "What every other package uses. SI units, world frame."),
    "robot": ("Robot", "The body: its file, kinematics and single rigid body."),
    "qp": ("Quadratic programs", "Solver, status and derivative ([explained](../qp.md))."),
    "control": ("Controller", "Weights, gait, reference, footholds, MPC and legs; pure JAX."),
    "sim": ("Simulation", "The robot in MuJoCo, one walk at a time or in batches."),
    "grfm": ("Ground reaction net", "phi: the map from command to effect, its data and training."),
    "tuning": ("Tuning", "Rollout, loss and Gauss-Newton steps, for one problem or for many."),
    "store": ("Store", "What is computed once and kept: walks, nets, tunings, runs."),
    "verdict": ("Verdict", "Walks of weight sets, scores and their statistics."),
    "importing": ("Importing", "Robots that others publish, in one standard form."),
    "own": ("Your own controller", "Logs, programs and plans that are not of this project."),
    "walk_tuning": ("Tuning on walks", "The tuning whose value is walks; their logs and record."),
    "export": ("Export", "Weights and controller as files for a robot's computer."),
    "report": ("Report", "Tables and pictures of a run."),
    "view": ("View", "Films, and pages in the browser."),
}
PUBLIC = {  # of packages without `__all__`, in whichever of their modules they are defined
    "core": "State Wrench Load Trajectory InputError setup_jax",
    "robot": "Robot load_robot Description foot_poses foot_jacobians inverse_legs linearise",
    "sim": "Imperfections ideal hfs hfs_varied standin Job walk Engine choose_engine",
    "grfm": "Window Effect Phi as_effect load_net save_net TrainConfig train",
    "tuning": """RolloutConfig rollout LossTerm losses with_alphas TuneConfig Evaluation Tuning
        PlanInputs Planned tune descend""",
    "store": "Run load_walks",
    "verdict": "Score score Verdict make_verdict",
    "importing": "propose_robot files_of",
    "own": "program_of Walker walker_engine compare_plans compare_calls",
    "walk_tuning": "Campaign WalkTuning tune_on_walks",
    "export": "export",
    "report": "compare_runs",
    "view": "write_film",
}
MENU = {  # of the site: pages by caption, in this order
    "Start": "start concepts tutorial notebooks/tune notebooks/phi",
    "Guides": """howto/weights howto/trajectory howto/robot howto/falls howto/loss howto/walks
        howto/own howto/numbers export export-cpp howto/hardware howto/engines howto/gpu
        howto/outputs howto/troubleshooting""",
    "Results": "results reading limits performance",
    "Method": "theory theory-additions qp paper",
    "Reference": "commands robot-toml extending reference/hector_jax reference/*",
    "Contributing": "decisions reliability",
}
_ROLE = re.compile(r"\{(?:func|class|mod|meth)\}`(hector_jax[\w.]*)`")
logger = logging.getLogger(__name__)
aliases: dict[str, str] = {}  # of names that pages link to: the name that the reference has

_FIELD = re.compile(r"^    (\w+): [^#\n]*?  # (.+)$", re.MULTILINE)
_CODE = re.compile(r"(`[^`]*`)")


def _imported(module: str) -> ModuleType | None:
    """A module; None where a package is not installed that it needs, of an extra engine."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("hector_jax"):
            raise
        logger.info("reference: %s is left out, %s", module, error)
        return None


def _public(package: str) -> list[str]:
    """Names of a package's `__all__`; without one, those of PUBLIC."""
    package = importlib.import_module(package)
    if hasattr(package, "__all__"):
        return [f"{package.__name__}.{name}" for name in package.__all__]
    names = PUBLIC.get(package.__name__.split(".")[-1], "").split()
    inside = pkgutil.walk_packages(package.__path__, f"{package.__name__}.") if names else ()
    modules = filter(None, (_imported(module.name) for module in inside))
    home = {name: package.__name__ for name in names}  # where it is not found there is a warning
    for module in modules:
        for name in names:
            if getattr(vars(module).get(name), "__module__", None) == module.__name__:
                home[name] = module.__name__
    return [f"{home[name]}.{name}" for name in names]


def _resolve(name: str) -> tuple[str, object]:
    """The object behind a dotted name, and the name of the place that defines it."""
    for at in range(name.count(".") + 1, 0, -1):
        module, *inside = name.rsplit(".", name.count(".") + 1 - at)
        try:
            value = importlib.import_module(module)
        except ModuleNotFoundError:
            continue
        for part in inside:
            value = getattr(value, part)
        is_defined = inside and getattr(value, "__qualname__", None) == inside[-1]
        return (f"{value.__module__}.{inside[-1]}" if is_defined else name), value
    raise AttributeError(name)


def _entry(name: str, value: object) -> str:
    """The directive that documents an object."""
    if inspect.ismodule(value):
        return f".. automodule:: {name}"
    if inspect.isclass(value):
        return f".. autoclass:: {name}\n   :members:"
    if callable(value):
        return f".. autofunction:: {name}"
    return f".. autodata:: {name}\n   :no-value:"


def _blocks(entries: list[str]) -> str:
    return "\n".join(f"```{{eval-rst}}\n{entry}\n```\n" for entry in entries)


def _summary(value: object) -> str:
    doc = inspect.getdoc(value) or ""
    return doc.split("\n\n")[0].replace("\n", " ").replace("|", "\\|")


def _write_reference(app) -> None:
    """One page for the names of `hector_jax`, and one for each package.

    A page documents the public names of its package (`_public`) and the other names that pages
    link to. A name that does not exist is a warning, which fails the build.
    """
    folder = Path(app.srcdir) / "reference"
    folder.mkdir(exist_ok=True)
    cited = {
        name
        for path in Path(app.srcdir).rglob("*.md")
        if not {"_build", "reference"} & set(path.parts)
        for name in _ROLE.findall(path.read_text())
    }
    top = _public("hector_jax")
    public = [name for package in PACKAGES for name in _public(f"hector_jax.{package}")]
    pages: dict[str, list[str]] = {package: [] for package in PACKAGES}
    documented: dict[str, str] = {}  # name by the place of definition
    rows, others = [], []
    for name in dict.fromkeys([*public, *sorted(cited), *top]):
        try:
            home, value = _resolve(name)
        except AttributeError:
            logger.warning("reference: there is no %s", name)
            continue
        if home not in documented:
            documented[home] = name if name not in top else home
            package = home.split(".")[1]
            page = pages[package] if package in pages else others
            page.append(_entry(documented[home], value))
        aliases[name] = documented[home]
        if name in top:
            row = f"{{py:obj}}`{name.split('.')[-1]} <{documented[home]}>`"
            rows.append(f"| {row} | {_summary(value)} |")
    head = ["# Public names of hector_jax", "", inspect.getdoc(hector_jax) or "", ""]
    if rows:
        head += ["| name | what it is |", "|---|---|", *rows, ""]
    head += ["| package | content |", "|---|---|"]
    head += [f"| [hector_jax.{name}]({name}.md) | {text} |" for name, (_, text) in PACKAGES.items()]
    texts = {"hector_jax": "\n".join([*head, "", ""]) + _blocks(others)}
    for package, entries in pages.items():
        title, purpose = PACKAGES[package]
        texts[package] = f"# {title}: `hector_jax.{package}`\n\n{purpose}\n\n{_blocks(entries)}"
    for path in folder.glob("*.md"):
        if path.stem not in texts:
            path.unlink()
    for name, text in texts.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text() != text:  # an unchanged page is not read again
            path.write_text(text)


def _add_menu(app, docname: str, source: list[str]) -> None:
    """Add the menu to the page that is read first; a plain viewer would show it as code."""
    if docname == "index":
        options = ":hidden:\n:glob:\n"
        for caption, pages in MENU.items():
            names = "\n".join(pages.split())
            source[0] += f"\n```{{toctree}}\n:caption: {caption}\n{options}\n{names}\n```\n"


def _by_other_name(app, env, node, content) -> nodes.reference | None:
    """A link to a name that is documented under another one."""
    target = aliases.get(node.get("reftarget"))
    if target is None or target == node["reftarget"]:
        return None
    python = env.get_domain("py")
    return python.resolve_xref(
        env, node["refdoc"], app.builder, node["reftype"], target, node, content
    )


def _inline(translator, node) -> None:
    translator.body.append(tex2mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _block(translator, node) -> None:
    number = f'<span class="eqno" style="float: right">({node["number"]})</span>'
    ids = "".join(f' id="{name}"' for name in node["ids"][:1])
    formula = tex2mathml(node.astext(), as_block=True)
    style = ' style="overflow-x: auto; overflow-y: hidden"'
    translator.body.append(f"<div{ids}{style}>{number * bool(node['number'])}{formula}</div>")
    raise nodes.SkipNode


def _plain(text: str) -> str:
    """Escape in a docstring's line what reStructuredText would take for markup."""
    parts = _CODE.split(text)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"([*|\\])", r"\\\1", parts[i])
        parts[i] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", parts[i])
        if i and re.match(r"\w", parts[i]):  # `Net`s
            parts[i] = "\\ " + parts[i]
    return "".join(parts)


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _as_rst(app, what, name, obj, options, lines: list[str]) -> None:
    """Turn indented formulas into literal blocks, and comments of fields into their description."""
    result: list[str] = []
    literal: int | None = None  # the indent that a literal block has at least
    for i, line in enumerate(lines):
        if line.strip() and literal is not None and _indent(line) < literal:
            literal = None
        after_gap = i > 1 and line.strip() and not lines[i - 1].strip()
        if literal is None and after_gap:
            before = next(one for one in reversed(lines[: i - 1]) if one.strip())
            if _indent(line) >= _indent(before) + 4:
                literal = _indent(line)
                result += [" " * _indent(before) + "::", ""]
        result.append(line if literal is not None or ">>>" in line else _plain(line))
    fields = getattr(obj, "_fields", ()) or getattr(obj, "__dataclass_fields__", ())
    if what == "class" and fields:
        source = inspect.getsource(obj)
        described = [(name, text) for name, text in _FIELD.findall(source) if name in fields]
        if described:
            result += [
                "",
                "Attributes:",
                *(f"    {n}: {_plain(text)}" for n, text in described),
                "",
            ]
    lines[:] = result


def _short(app, what, name, obj, options, signature, returns) -> tuple:
    """Arrays have the name that the code uses; paths are relative to the repository."""
    root = Path(hector_jax.__file__).parents[1]
    names = {"jaxlib._jax.Array": "Array", "PosixPath(": "Path(", f"{root}/": ""}

    def short(text: str | None) -> str | None:
        for long, name in names.items():
            text = text and text.replace(long, name)
        return text

    return short(signature), short(returns)


def _skip(app, what, name, obj, skip, options) -> bool | None:
    return True if type(obj).__name__ == "_tuplegetter" else None


def setup(app) -> None:
    """Register the reference, the renderer of formulas and the hooks on docstrings."""
    app.connect("builder-inited", _write_reference)
    app.connect("source-read", _add_menu)
    nothing = lambda translator, node: None  # noqa: E731
    app.add_html_math_renderer("mathml", (_inline, nothing), (_block, nothing))
    app.connect("missing-reference", _by_other_name)
    app.connect("autodoc-process-docstring", _as_rst, priority=400)
    app.connect("autodoc-process-signature", _short)
    app.connect("autodoc-skip-member", _skip)
