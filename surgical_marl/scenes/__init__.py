"""Arms mounted in a world, as one MuJoCo model."""
