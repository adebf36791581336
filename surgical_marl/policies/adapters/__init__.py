"""Adapters that ship: a module for each, found by its name."""
