"""What reaches disk and screen: atomic writes, messages, progress."""
