"""Tasks and algorithms by name: shipped classes, classes of installed packages, and registered ones."""
