"""DiffTune."""
