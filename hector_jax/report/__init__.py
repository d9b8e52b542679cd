"""Tables, figures, films and pages of a run."""
