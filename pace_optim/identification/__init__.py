"""The parts of a fit: what it begins with, its optimizers, and what it concludes."""
