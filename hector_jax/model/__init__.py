"""What the body does under forces."""
