"""What is wrong with a log, named before anything is searched."""
