"""Gradient tuning of a walking biped's model predictive controller in JAX."""
