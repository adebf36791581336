"""Reports of runs as one HTML file: settings, curves of training, evaluation."""
