"""Tasks: environments by what they are for."""
