"""Scripts of experiments/ refuse what they cannot use, before anything is computed."""

from pathlib import Path

import pytest

from hector_jax.core.console import exit_code
from hector_jax.core.files import WriteError
from hector_jax.core.inputs import InputError

FOLDER = Path(__file__).parents[1] / "experiments"


def failing(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code"),
    [(InputError("no\nsuch thing"), 2), (WriteError("full"), 1), (KeyboardInterrupt(), 130)],
)
def test_a_script_ends_in_one_line_and_a_code(capsys, error, code):
    assert exit_code("race", failing(error)) == code
    told = capsys.readouterr().err
    assert told.startswith("race: ")
    assert told.count("\n") == 1


@pytest.mark.parametrize("error", [ValueError("zip() argument 2 is shorter"), OSError("odd")])
def test_a_fault_of_the_program_keeps_its_traceback(error):
    with pytest.raises(type(error), match=str(error)[:5]):
        exit_code("race", failing(error))
