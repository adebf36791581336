"""Pictures and videos, without OpenGL."""
