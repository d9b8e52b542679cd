"""Tuning on walks, of a simulator or of a robot.

`campaign` has the settings, `best_set` those of the set `best`; `walks` is the loop and its folder;
`slopes` and `moved` have its slopes, `kept` the commands that it keeps; `added_logs` takes the logs
of walks made elsewhere, `forecasts` what they foretell.
"""
