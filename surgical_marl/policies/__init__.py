"""Policies: networks, the oracle and policies that need no learning."""
