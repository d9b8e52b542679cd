"""What each command of `hector` does with its flags (flags.py)."""

from functools import singledispatch
from typing import Any

from hector_jax.cli import data, doctor, evaluate, export, robot, search, tune, view


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
    tune.tune,
    search.search,
    evaluate.evaluate,
    evaluate.walk,
    evaluate.compare,
    robot.examine_robot,
    view.view_run,
    view.replay_dump,
    view.tensorboard,
    export.export_controller,
    doctor.doctor,
):
    run.register(_command)
