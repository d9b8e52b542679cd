"""The command line.

`flags` has a class for each command, `parse` reads them, `commands` names the function of each, and
`tune`, `walker`, `walk`, `evaluate`, `propose`, `view` and `doctor` hold the long ones.
"""
