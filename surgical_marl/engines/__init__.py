"""What runs environments: `mjx` is the reference."""
