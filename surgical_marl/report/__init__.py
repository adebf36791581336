"""Reports of runs: what was trained, how it went and how well it does, as one HTML file."""
