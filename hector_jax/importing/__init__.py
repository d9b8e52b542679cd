"""Propose the settings of a robot that others publish, MJCF or URDF, and say what is likely wrong.

`survey`, `soles` and `stand` find legs, feet and standing pose; `propose` adds the settings by
rules, and writes the model in the standard form that `hector_jax.robot` defines; `table` describes
the robot, `remarks` its likely faults.
"""
