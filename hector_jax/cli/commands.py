"""What each command of `hector` does with its flags (flags.py)."""

from functools import singledispatch
from typing import Any

from hector_jax.cli import data, judging, looking, machines, tuning


@singledispatch
def run(args: Any) -> None:
    """Do what the flags of a command ask for.

    Raises:
        InputError: one line that says what is wrong with the input.
    """
    raise NotImplementedError(type(args))


for _command in (
    data.collect,
    data.train,
    data.grfm,
    tuning.tune,
    tuning.search,
    judging.evaluate,
    judging.walk,
    judging.table,
    judging.compare,
    looking.view_run,
    looking.replay_dump,
    looking.tensorboard,
    machines.export_controller,
    machines.examine,
):
    run.register(_command)
