"""Things that move: arms, rigid bodies, and systems of plug-ins."""
