"""The algorithms that ship, a module each; the module's name is the algorithm's."""
