"""What is told of it: result, advice, next experiment."""
