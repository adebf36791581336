"""Base classes, options and helpers of tasks."""
