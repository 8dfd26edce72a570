"""One joint at a time: its simulation along a measured motion, and the fits of models with effects."""
