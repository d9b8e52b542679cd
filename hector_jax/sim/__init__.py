"""The high-fidelity world."""
