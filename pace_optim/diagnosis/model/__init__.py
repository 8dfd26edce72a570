"""What a diagnosis fits: base parameters and effects, and a fitted model of every joint."""
