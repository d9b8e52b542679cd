"""What the controller decides."""
