"""How far a result can be trusted: error bars, other solutions, consistency, warnings."""
