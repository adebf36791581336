"""Episodes for other programs: recorded step by step, and written in the formats of the field (docs/data.md)."""
