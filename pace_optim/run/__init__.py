"""A run's folder: settings, result, history, replay."""
