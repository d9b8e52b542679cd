"""Tuning on walks, of a simulator or of a robot.

`campaign` has the settings; in the folder of `walks`, proposals of `hector_jax.search` and logs of
their walks alternate; `walk_log` reads a log and gives its loss; `reported_walks` takes the logs of
walks made elsewhere.
"""
