"""Tables, figures, films and pages of a run.

`run` writes the report of a tuning, `matrix` that of an evaluation, `compare` sets runs side by
side; `plots` draws, `video` and `render` film, `view` serves the page in the browser.
"""
