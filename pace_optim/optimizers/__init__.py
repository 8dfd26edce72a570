"""CMA-ES and least squares; they see vectors and scores, never a simulator."""
