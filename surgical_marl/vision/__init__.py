"""What endoscopes see."""
