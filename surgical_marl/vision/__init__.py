"""Pictures of endoscopes."""
