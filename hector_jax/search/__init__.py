"""Which weights to walk next, from the walks so far: by a grounded model and a surrogate."""
