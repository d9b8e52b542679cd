"""Steps of a run, and the artefacts that they store and read again."""
