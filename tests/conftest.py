"""Shared set-up of the tests: 64 bits and the compilation cache, before the first array."""

from hector_jax.runtime import setup_jax

setup_jax()
