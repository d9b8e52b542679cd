"""The console script `hector`: run a command and return its exit code.

Results go to stdout, progress messages to stderr. Exit codes: 0 done; 1 something is broken:
`hector doctor` found it, a worker process was killed, a disk is full, or a fault of this program
with its traceback; 2 bad input: one line gives the value, its place and what was expected; 130
interrupted; 141 standard output was closed; 143 terminated.
"""

import json
import logging
import sys
import warnings
from functools import cache, partial

from hector_jax.core.inputs import InputError, outside_packages

try:
    with outside_packages():
        from hector_jax.cli.flags import Doctor, Export
        from hector_jax.cli.parse import check_flags, from_line, resolve_latest
        from hector_jax.core.console import Broken, exit_code, say, say_if_slow
        from hector_jax.core.runtime import start_jax
except InputError as error:
    print(f"hector: {error}", file=sys.stderr)
    sys.exit(2)


def _run() -> None:
    args = resolve_latest(from_line(sys.argv[1:]))
    check_flags(args)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # hides messages about its cache
    say_once = cache(say)  # MuJoCo repeats what it finds in a robot's file each time it reads it
    warnings.showwarning = lambda message, *where, **_: say_once(f"warning: {message}")
    try:
        with say_if_slow("loading JAX and MuJoCo"):
            start_jax(on_cpu=isinstance(args, Export))  # a walk is quicker there
            with outside_packages():  # after the flags: `hector --help` answers at once
                from hector_jax.cli import commands
    except InputError as error:
        if not isinstance(args, Doctor):
            raise
        if args.json:
            print(json.dumps({"faults": [str(error)]}))
        raise Broken(str(error)) from None
    commands.run(args)


main = partial(exit_code, "hector", _run)
"""Run the console script and return its exit code."""

if __name__ == "__main__":
    sys.exit(main())
