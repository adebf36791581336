"""Learning: multi-agent PPO on rsl_rl, the training loop, settings and trained policies."""
