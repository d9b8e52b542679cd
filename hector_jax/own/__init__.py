"""Walks that this project does not simulate: another controller, another simulator, a robot.

`walk_file` reads a log, `walk_log` gives its loss, `log_check` says what of it no weights can fix,
`parity` how far a twin's plans are from its. `program` calls a program of the user: one that walks
is an engine (`walker`), of one that plans (`planner`) a tuning takes the slopes.
"""
