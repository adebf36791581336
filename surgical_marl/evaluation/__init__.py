"""Evaluation that others can repeat: fixed goals, metrics in millimetres, confidence intervals (docs/evaluation.md)."""
