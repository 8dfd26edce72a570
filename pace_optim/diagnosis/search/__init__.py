"""The search for missing effects, round by round."""
