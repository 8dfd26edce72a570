"""What the search found: verdict, contributions, proxies, free curves."""
