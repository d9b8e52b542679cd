"""The learned map from command to effect (phi)."""
