"""The file of numbers of another controller, filled in with weights."""

from pathlib import Path

from jinja2 import Environment, StrictUndefined, TemplateError, TemplateSyntaxError

from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.inputs import InputError, one_line


def fill_template(template: Path, weights: Weights) -> str:
    """Return the text of a template of Jinja with the numbers of weights.

    The template names them as a weights file does, in the order and the units that it needs, as in
    `Kp = {{ Q.euler[0] }}` or `{{ "%.4f" % (1e3 * R.force[0][2]) }}`.

    Raises:
        InputError: the template cannot be read, or names what the weights do not have.
    """
    names = weights_tree(weights)
    made = Environment(undefined=StrictUndefined, keep_trailing_newline=True, autoescape=False)
    try:
        return made.from_string(template.read_text()).render(names)
    except TemplateSyntaxError as error:
        raise InputError(f"{template}: line {error.lineno}: {one_line(error)}") from None
    except (TemplateError, TypeError, ValueError, UnicodeDecodeError, OSError) as error:
        known = ", ".join(f"{part}.{name}" for part in ("Q", "R") for name in names.get(part, ()))
        raise InputError(f"{template}: {one_line(error)}; there are {known}") from None
