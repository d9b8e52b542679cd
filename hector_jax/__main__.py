"""`python -m hector_jax` is the console script `hector`."""

import sys

from hector_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
