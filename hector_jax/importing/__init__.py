"""Convert a robot that others publish, MJCF or URDF, to the standard form of `robot.checks`.

`published` and `elements` read the file, `survey`, `soles` and `stand` find legs, feet and standing
pose, or `draft` has them of a TOML; `convert` and `rebuild` write the model, `propose` adds the
settings by rules. `table` describes the robot, `remarks` its likely faults.
"""
