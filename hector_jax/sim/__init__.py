"""Walks in physics engines: worlds, plants and the closed loop.

`world` and `standin` draw plants, `sensing` what the controller measures; `walk` is the loop in
MuJoCo C, `parallel` in MJX, `drake` and `pinocchio` are plants of other engines; `engine` chooses.
`walker` is a program of the user as an engine, `walk_file` reads its logs, `log_check` says what of
them no weights can mend, `leg_check` what is wrong with joints and feet. `diagnosis` says why a
walk fell, `margin` which delay the loops bear.
"""
