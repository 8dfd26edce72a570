"""Whether a candidate is better, alike or worse on held-out recordings."""
