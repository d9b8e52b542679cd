"""Metrics, figures, video and report."""
