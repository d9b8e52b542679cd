"""Searches that only walk: CMA-ES and those it is compared with."""
