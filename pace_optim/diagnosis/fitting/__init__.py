"""Fitting many joints and effects side by side."""
