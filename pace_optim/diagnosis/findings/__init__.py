"""The report of a diagnosis: result, advice, next experiment."""
