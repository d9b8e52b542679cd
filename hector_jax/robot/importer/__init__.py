"""Bring robots as others publish them, MJCF or URDF, into the standard form; propose their TOML.

`survey`, `soles` and `stand` find legs, feet and standing pose; `propose` adds the settings by
rules; `elements`, `source` and `rebuild` convert the model; `table` describes the robot and its
likely faults. `hector robot` writes model and TOML in the standard form (see `rebuild`), which is
all that the rest of the package reads. `robot.model` is the only door: a TOML that names another
model has it converted there.
"""
