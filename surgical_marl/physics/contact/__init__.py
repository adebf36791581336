"""Contact: shapes, collision detection, contact patches, Coulomb friction, grips."""
