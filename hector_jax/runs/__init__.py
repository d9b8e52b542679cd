"""What a run computes, stores and reads again."""
