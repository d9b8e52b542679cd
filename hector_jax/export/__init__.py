"""Weights and controller as files for a robot's computer.

`source` writes the controller as C, `check` compiles it and compares it with the live one on a
recorded walk; `export` writes all files: C, the weights with their schema, lines for the open C++
controller.
"""
