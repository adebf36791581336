"""What another package adds to surgical-marl."""
