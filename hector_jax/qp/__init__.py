"""Quadratic programs and their derivative."""
