"""The site: Markdown and docstrings in, pages that need no network out (`make docs`)."""

import inspect
import pkgutil
import re
from importlib import metadata
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

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
autodoc_default_options = {"members": True}
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
default_role = "code"  # docstrings put names between single backticks

html_math_renderer = "mathml"  # drawn by the browser itself: no script, no font from elsewhere

_FIELD = re.compile(r"^    (\w+): [^#]*?  # (.+)$", re.MULTILINE)
_CODE = re.compile(r"(`[^`]*`)")


def _write_reference(app) -> None:
    """A page for each room and one for what stands above them; none is missing."""
    rooms: dict[str, list[str]] = {}
    for module in pkgutil.walk_packages(hector_jax.__path__, "hector_jax."):
        _, room, *inside = module.name.split(".")
        rooms.setdefault(room if inside or module.ispkg else "hector_jax", []).append(module.name)
    folder = Path(app.srcdir) / "reference"
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.md"):
        if path.stem not in rooms:
            path.unlink()
    for room, names in rooms.items():
        parts = [f"## `{n}`\n\n```{{eval-rst}}\n.. automodule:: {n}\n```\n" for n in sorted(names)]
        text = "\n".join([f"# {room}\n", *parts])
        path = folder / f"{room}.md"
        if not path.exists() or path.read_text() != text:  # an unchanged page is not read again
            path.write_text(text)


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
    """A docstring's line with what reStructuredText would take for markup escaped."""
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
    """Formulas that stand apart become literal blocks, comments beside fields become their text."""
    found: list[str] = []
    literal: int | None = None  # the indent that a literal block has at least
    for i, line in enumerate(lines):
        if line.strip() and literal is not None and _indent(line) < literal:
            literal = None
        after_gap = i > 1 and line.strip() and not lines[i - 1].strip()
        if literal is None and after_gap:
            before = next(one for one in reversed(lines[: i - 1]) if one.strip())
            if _indent(line) >= _indent(before) + 4:
                literal = _indent(line)
                found += [" " * _indent(before) + "::", ""]
        found.append(line if literal is not None or ">>>" in line else _plain(line))
    fields = getattr(obj, "_fields", ()) or getattr(obj, "__dataclass_fields__", ())
    if what == "class" and fields:
        told = [(n, text) for n, text in _FIELD.findall(inspect.getsource(obj)) if n in fields]
        if told:
            found += ["", "Attributes:", *(f"    {n}: {_plain(text)}" for n, text in told), ""]
    lines[:] = found


def _short(app, what, name, obj, options, signature, returns) -> tuple:
    """Arrays are called what the code calls them."""
    short = lambda text: text and text.replace("jaxlib._jax.Array", "Array")  # noqa: E731
    return short(signature), short(returns)


def _skip(app, what, name, obj, skip, options) -> bool | None:
    return True if type(obj).__name__ == "_tuplegetter" else None


def setup(app) -> None:
    """Register the reference, the renderer of formulas and the hooks on docstrings."""
    app.connect("builder-inited", _write_reference)
    nothing = lambda translator, node: None  # noqa: E731
    app.add_html_math_renderer("mathml", (_inline, nothing), (_block, nothing))
    app.connect("autodoc-process-docstring", _as_rst, priority=400)
    app.connect("autodoc-process-signature", _short)
    app.connect("autodoc-skip-member", _skip)
