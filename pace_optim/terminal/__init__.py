"""What reaches disk and screen: options, messages, progress."""
