"""The robot: its model file, kinematics and single rigid body.

`description` is the TOML of a robot, `model` what the MPC needs of it. `elements`, `source` and
`rebuild` bring the MJCF or URDF that a description names into one standard form.
"""
