"""Which effects are worth a refit, and from where."""
