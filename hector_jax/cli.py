"""The console script `hector`: flags in, exit code out.

Results go to stdout, everything said while waiting to stderr. Exit codes: 0 done, 2 bad input (one
line says what, where and what was expected), 1 a worker process was killed, 130 interrupted, 143
terminated.
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
    args = tyro.cli(Command, prog="hector", description=_ABOUT)

    def work() -> None:
        setup_jax()
        from hector_jax import commands  # after the flags: `hector --help` answers at once

        commands.run(args)

    return exit_code("hector", work)


if __name__ == "__main__":
    sys.exit(main())
