"""What acts: networks, the oracle and policies that need no learning."""
