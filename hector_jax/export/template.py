"""The file of numbers of another controller, filled in with weights."""

from pathlib import Path
from typing import Any

from jinja2 import StrictUndefined, TemplateSyntaxError, Undefined
from jinja2.sandbox import SandboxedEnvironment

from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.inputs import InputError, one_line, short_repr


def _printable(value: Any) -> Any:
    """Return what `{{ }}` may print: `a{{1, 2}}` of C++ is a tuple to Jinja, and not meant."""
    if isinstance(value, str | int | float | Undefined):  # undefined names raise when printed
        return value
    raise InputError(f"{{{{ }}}} prints a number or text, got {short_repr(value)}")


def fill_template(template: Path, weights: Weights) -> str:
    """Return the text of a template of Jinja with the numbers of weights.

    The template names them as a weights file does, in the order and the units that it needs, as in
    `Kp = {{ Q.euler[0] }}` or `{{ "%.4f" % (1e3 * R.force[0][2]) }}`. It reaches nothing else.

    Raises:
        InputError: the template cannot be read, fails, or names what the weights do not have.
    """
    names = weights_tree(weights)
    try:
        text = template.read_bytes().decode()
        made = SandboxedEnvironment(
            undefined=StrictUndefined,
            finalize=_printable,
            newline_sequence="\r\n" if "\r\n" in text else "\n",
            keep_trailing_newline=True,
            autoescape=False,
        )
        return made.from_string(text).render(names)
    except TemplateSyntaxError as error:
        raise InputError(f"{template}: line {error.lineno}: {one_line(error)}") from None
    except Exception as error:  # a template is a program: whatever it raises is a fault of its own
        known = ", ".join(f"{part}.{name}" for part in ("Q", "R") for name in names.get(part, ()))
        raise InputError(f"{template}: {one_line(error)}; there are {known}") from None
