"""Time steps of every scene."""

TIMESTEP = 0.0025
"""Physics step in s. docs/physics.md has the stability test behind this choice."""
DECIMATION = 8
"""Default number of physics steps per control step: control at 50 Hz."""
