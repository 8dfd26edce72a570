"""Which motion to record: the signals, and the design of a session."""
