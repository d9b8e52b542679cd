"""Weights and controller as files for a robot's computer.

`controller` makes the controller one compiled function and compares it with the live one on a
recorded walk; `export` writes it, the weights with their schema, and a C++ header.
"""
