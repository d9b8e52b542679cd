"""The robot: its model file, kinematics and single rigid body.

`description` is the TOML of a robot, `checks` the standard form of its model, `model` what the MPC
needs of it. `importing` brings the MJCF or URDF of others into that form, once.
"""
