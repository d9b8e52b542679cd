"""The console script `hector`: flags in, exit code out.

Results go to stdout, everything said while waiting to stderr. Exit codes: 0 done, 2 bad input (one
line says what, where and what was expected), 130 interrupted.
"""

import sys

import tyro

from hector_jax.console import exit_code
from hector_jax.flags import Command
from hector_jax.runtime import setup_jax

_ABOUT = (
    "Gradient tuning of a walking biped's model predictive controller. "
    "The whole way, from data to verdict: hector tune --traj straight"
)


def main() -> int:
    """Entry of the console script."""
    positional = (tyro.conf.PositionalRequiredArgs,)  # `hector export RUN`
    args = tyro.cli(Command, prog="hector", description=_ABOUT, config=positional)
    setup_jax()
    from hector_jax import commands  # after the flags: `hector --help` answers at once

    return exit_code("hector", lambda: commands.run(args))


if __name__ == "__main__":
    sys.exit(main())
