"""Search on walks, without derivatives: CMA-ES."""
