"""What is computed once and kept, so that a run that is killed goes on where it was.

`cache` keeps a result under a key of all that it depends on; `tunings`, `collection` and `nets` are
the steps that a run keeps in this way; `run` has the files of a run; `setup` is what its steps
share. What grows row by row, as tunings and walks do, is a `core.journal`.
"""
