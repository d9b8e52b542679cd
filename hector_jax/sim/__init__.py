"""Walks in physics engines: worlds, plants and the closed loop.

`world` and `standin` draw plants, `sensing` what the controller measures; `walk` is the loop in
MuJoCo C, `parallel` in MJX, `drake` and `pinocchio` are plants of other engines; `engine` chooses.
`leg_check` says what is wrong with joints and feet, `diagnosis` why a walk fell, `margin` which
delay the loops bear, `live` walks for a page. `programs` keeps the compiled programs of few robots
at a time.
"""
