"""Pictures and films, without OpenGL."""
