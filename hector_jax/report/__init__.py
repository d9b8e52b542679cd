"""Tables, figures and pages of Markdown of a run.

`run` writes the report of a tuning, `matrix` that of an evaluation, `compare` sets runs side by
side; `plots` draws.
"""
