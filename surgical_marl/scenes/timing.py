"""How time passes in every scene."""

TIMESTEP = 0.0025
"""Physics step in s. docs/physics.md has the stability test that chose it."""
DECIMATION = 8
"""Physics steps a control step unless told otherwise: control at 50 Hz."""
